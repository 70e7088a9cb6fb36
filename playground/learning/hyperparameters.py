"""Hyperparameters of the algorithms: the `agent` section as dataclasses.

Each number has its limit beside it, which composition checks (`playground.config.limits`). Nothing here needs JAX.

Other packages add algorithms through an entry point of the group `playground.agents`. It names the dataclass, in a
module that imports no JAX; the dataclass names the algorithm (docs/add-an-algorithm.md).
"""

import dataclasses
import functools
import importlib.metadata
import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar, Literal

from playground.errors import ConfigError, UnknownNameError, nearest
from playground.limits import SHARE, SIZES, Limit, at_least_0, count, positive
from playground.settings import build

ENTRY_POINTS = "playground.agents"
ELSEWHERE = {"rsl_rl_ppo": " RSL-RL trains through its own runner: docs/rsl-rl.md."}  # agents of earlier versions
SCHEDULE = ("num_timesteps", "num_evals", "num_resets_per_eval")
MOST_EVALS = 10_000
_MOST = 2**31 - 1  # transitions on a device: they are drawn by int32

# Settings of several classes.
ActivationName = Literal["swish", "relu", "elu", "tanh", "gelu"]
Activation = Annotated[ActivationName, "of the hidden layers"]
Discounting = Annotated[float, SHARE, "discount of one policy step"]
RewardScaling = Annotated[float, positive(), "factor on rewards"]
ActorSizes = Annotated[Sequence[int], SIZES, "units of the actor's hidden layers"]
PolicyObsKey = Annotated[str, "observation group that the actor reads"]
ValueObsKey = Annotated[str, "observation group that the critic reads; privileged_state for an asymmetric pair"]
ValueDtype = Annotated[
  Literal["auto", "bfloat16", "float32"],
  "of the critic's hidden activations; auto is bfloat16 on a GPU, float32 elsewhere",
]


@dataclasses.dataclass(frozen=True, kw_only=True)
class AgentConfig:
  """Hyperparameters of every algorithm, which the trainer reads. Subclasses are frozen dataclasses, too.

  Attributes:
    algorithm: the class of the algorithm, `module:name`.
    traced: numbers that are arguments of the compiled program, not constants: another value needs no compilation, and
      agents of one program may differ in them. No Python branch may depend on one, and a constructor cannot read it.
    schedule: keys of how often the compiled functions are called, which none of the functions reads: another value
      needs no compilation.
  """

  algorithm: ClassVar[str]
  traced: ClassVar[tuple[str, ...]] = ()
  schedule: ClassVar[tuple[str, ...]] = ()

  num_timesteps: Annotated[
    int, count(1, 1e12), "environment steps in all, action repeats counted, to within one batch"
  ] = 50_000_000
  num_evals: Annotated[int, count(1, MOST_EVALS), "evaluations, those before and after training included"] = 10
  num_resets_per_eval: Annotated[
    int, count(0, 1000), "resets of all environments between two evaluations; 0 is never"
  ] = 0
  num_envs: Annotated[int, count(1, 2**24), "environments in parallel, over all devices"] = 2048
  num_eval_envs: Annotated[int, count(1, 2**24), "environments of an evaluation"] = 128
  normalize_observations: Annotated[bool, "whether observations are scaled to mean 0 and standard deviation 1"] = True
  deterministic_eval: Annotated[
    bool, "whether eval/episode_reward is of the mode of the policy, and eval/sampled/... of samples; else the reverse"
  ] = False

  @property
  def steps_per_update(self) -> int:
    """Returns the policy steps of one training step, over all environments and devices."""
    return self.num_envs

  @property
  def prefill_updates(self) -> int:
    """Returns the number of first training steps that only collect."""
    return 0

  @property
  def random_episode_ages(self) -> bool:
    """Whether a reset of all environments sets each episode's elapsed time to a random number of steps."""
    return False

  def check(self, num_devices: int) -> None:
    """Raises ConfigError for sizes that do not fit each other, or do not divide evenly over the devices."""
    for name in ("num_envs", "num_eval_envs", "batch_size"):
      size = getattr(self, name, 0)
      if size % num_devices:
        raise ConfigError(f"agent.{name}={size} must be a multiple of the number of devices, {num_devices}.")


@dataclasses.dataclass(frozen=True, kw_only=True)
class OnPolicyConfig(AgentConfig):
  """Hyperparameters of on-policy algorithms."""

  unroll_length: Annotated[int, count(1, 100_000), "policy steps of one trajectory"] = 20
  num_minibatches: Annotated[int, count(1, 100_000), "minibatches of an epoch"] = 32
  num_updates_per_batch: Annotated[int, count(1, 100_000), "epochs over the collected trajectories"] = 4
  learning_rate: Annotated[float, positive(1), "of Adam"] = 3e-4
  discounting: Discounting = 0.99
  gae_lambda: Annotated[float, SHARE, "decay of advantages (GAE), or of λ-returns, over later steps"] = 0.95
  reward_scaling: RewardScaling = 1.0
  init_at_random_ep_len: Annotated[
    bool, "whether a reset gives environments random ages, so that a batch holds all parts of episodes"
  ] = False

  @property
  def random_episode_ages(self) -> bool:
    return self.init_at_random_ep_len


@dataclasses.dataclass(frozen=True, kw_only=True)
class OffPolicyConfig(AgentConfig):
  """Hyperparameters of algorithms that learn from a replay buffer."""

  batch_size: Annotated[int, count(1, 2**24), "transitions of one gradient step"] = 512
  grad_updates_per_step: Annotated[int, count(1, 100_000), "gradient steps for each step of all environments"] = 8
  num_steps: Annotated[int, count(1, 100), "policy steps whose rewards a target holds before the critic's value"] = 1
  discounting: Discounting = 0.99
  tau: Annotated[float, SHARE, "how far the target critics move towards the critics after each critic update"] = 0.005
  reward_scaling: RewardScaling = 1.0
  min_replay_size: Annotated[int, count(0, 2**40), "transitions collected before the first gradient step"] = 8192
  max_replay_size: Annotated[
    int, count(1, 2**40), "transitions kept over all devices, the newest; a run prints their memory"
  ] = 1_048_576
  checkpoint_replay: Annotated[
    bool, "whether the newest checkpoint holds the buffer, for an exact resume; else it is refilled"
  ] = True
  mirror_augmentation: Annotated[
    bool, "whether a random half of the drawn transitions are their left-right mirror images (robots on legs)"
  ] = False
  replay_dtype: Annotated[
    Literal["float32", "bfloat16"], "of observations and actions in the buffer; bfloat16 takes half of the memory"
  ] = "float32"

  @property
  def prefill_updates(self) -> int:
    return math.ceil(self.min_replay_size / self.num_envs)

  def check(self, num_devices: int) -> None:
    super().check(num_devices)
    for name, least in (("num_envs", self.num_envs), ("min_replay_size", self.min_replay_size)):
      if least > self.max_replay_size:
        raise ConfigError(f"agent.max_replay_size={self.max_replay_size} must not be below agent.{name}={least}.")
    if self.max_replay_size // num_devices > _MOST:
      raise ConfigError(f"agent.max_replay_size={self.max_replay_size} must be at most {_MOST} for each device.")
    if self.num_steps > 1 and min(self.prefill_updates, self.max_replay_size // self.num_envs) < self.num_steps:
      raise ConfigError(
        f"agent.num_steps={self.num_steps}: agent.min_replay_size={self.min_replay_size} and agent.max_replay_size="
        f"{self.max_replay_size} must hold so many steps of agent.num_envs={self.num_envs} environments."
      )


@dataclasses.dataclass(frozen=True)
class CNNConfig:
  """Layers of a CNN, with the processing before and after them (paper, appendix C.6; Mnih et al., 2015)."""

  channels: Annotated[Sequence[int], SIZES, "of each layer"] = (16, 32)
  kernels: Annotated[Sequence[int], SIZES, "pixels, square, of each layer"] = (5, 3)
  strides: Annotated[Sequence[int], SIZES, "pixels, of each layer"] = (2, 2)
  activation: Annotated[ActivationName, "of each layer"] = "elu"
  max_pool: Annotated[bool, "whether each layer is followed by the maximum of 2 x 2 pixels"] = True
  global_pool: Annotated[Literal["none", "avg", "max", "spatial_softmax"], "of the last layer; none is all of it"] = (
    "none"
  )
  normalize_channels: Annotated[
    bool, "whether each channel of an image is scaled to mean 0 and standard deviation 1"
  ] = False


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
  """Sizes and inputs of actor and critic, two separate MLPs (Brax's names and defaults)."""

  policy_hidden_layer_sizes: ActorSizes = (32, 32, 32, 32)
  value_hidden_layer_sizes: Annotated[Sequence[int], SIZES, "units of the critic's hidden layers"] = (256,) * 5
  activation: Activation = "swish"
  policy_obs_key: Annotated[
    str, 'observation group that the actor reads; "" reads images alone, where env.vision gives any'
  ] = "state"
  value_obs_key: ValueObsKey = "state"
  estimated_obs_key: Annotated[str, 'observation group that the actor learns to estimate from images; "" is none'] = ""
  clip_observations: Annotated[
    float | None, positive(), "largest input of actor and critic, after normalisation; null: it is not clipped"
  ] = None
  init_std: Annotated[
    float | None, Limit(0.01, 10), "standard deviation of a new actor's actions before squashing; null: about 0.7"
  ] = None
  value_dtype: ValueDtype = "auto"
  cnn: Annotated[CNNConfig, "of actor and critic each, for images"] = dataclasses.field(default_factory=CNNConfig)


@dataclasses.dataclass(frozen=True)
class SoftNetworkConfig:
  """Sizes and inputs of SAC's actor and twin critics (Brax's names and defaults)."""

  hidden_layer_sizes: Annotated[Sequence[int], SIZES, "units of the hidden layers, of the actor and of each critic"] = (
    256,
    256,
  )
  activation: Activation = "relu"
  policy_network_layer_norm: Annotated[bool, "whether the actor has layer normalisation"] = False
  q_network_layer_norm: Annotated[bool, "whether the critics have layer normalisation"] = True
  policy_obs_key: PolicyObsKey = "state"
  value_obs_key: ValueObsKey = "state"


@dataclasses.dataclass(frozen=True, kw_only=True)
class PPOConfig(OnPolicyConfig):
  """Hyperparameters of PPO."""

  algorithm = "playground.learning.ppo:PPO"
  schedule = SCHEDULE
  traced = (
    "learning_rate",
    "discounting",
    "gae_lambda",
    "entropy_cost",
    "clipping_epsilon",
    "vf_loss_coefficient",
    "reward_scaling",
  )

  batch_size: Annotated[int, count(1, 2**24), "trajectories of one minibatch"] = 1024
  max_grad_norm: Annotated[
    float | None, positive(), "gradients are scaled down to this global norm; null: they are not"
  ] = None
  entropy_cost: Annotated[float, at_least_0(), "factor on the entropy bonus"] = 1e-2
  clipping_epsilon: Annotated[float, positive(), "clip range of the ratio of probabilities"] = 0.3
  dual_clip: Annotated[
    float | None, positive(), "largest ratio of probabilities that a negative advantage counts with; null: any"
  ] = None
  clipping_epsilon_value: Annotated[
    float | None, positive(), "clip range of the value loss; null: it is not clipped"
  ] = None
  vf_loss_coefficient: Annotated[float, at_least_0(), "factor on the value loss"] = 0.5
  estimation_coefficient: Annotated[
    float, at_least_0(), "factor on the error (Huber) in estimating network.estimated_obs_key"
  ] = 1.0
  targets: Annotated[
    Literal["minibatch", "epoch"], "when targets and advantages are computed; advantages are then normalised"
  ] = "minibatch"
  clip_advantages: Annotated[
    float | None, positive(), "largest advantage, after any normalisation; null: they are not clipped"
  ] = None
  normalize_value_targets: Annotated[
    bool, "whether errors of the critic are divided by the running standard deviation of its targets"
  ] = False
  value_huber_delta: Annotated[
    float | None, positive(), "error of the critic from which on its loss is linear; null: it is squared"
  ] = None
  desired_kl: Annotated[
    float | None, positive(), "KL divergence that the learning rate is adapted to; null: it is constant"
  ] = None
  min_learning_rate: Annotated[float, positive(1), "of the adapted learning rate"] = 1e-5
  max_learning_rate: Annotated[float, positive(1), "of the adapted learning rate"] = 1e-2
  max_kl: Annotated[
    float | None, positive(), "KL divergence of a minibatch from which on an update makes no gradient step; null: any"
  ] = None
  normalize_advantage: Annotated[bool, "whether advantages are normalised in each minibatch"] = True
  bootstrap_on_timeout: Annotated[
    bool, "whether a time-out adds the discounted value of its state; else it is masked out"
  ] = False
  mirror_augmentation: Annotated[
    bool, "whether every step is learned from its left-right mirror image, too (robots on legs)"
  ] = False
  augment_pixels: Annotated[
    int, count(0, 1024), "largest random shift of a trajectory's images in an update, pixels"
  ] = 0
  network: Annotated[NetworkConfig, "actor and critic"] = dataclasses.field(default_factory=NetworkConfig)

  @property
  def steps_per_update(self) -> int:
    return self.batch_size * self.num_minibatches * self.unroll_length

  def check(self, num_devices: int) -> None:
    if (self.batch_size * self.num_minibatches) % self.num_envs:
      product = f"agent.batch_size * agent.num_minibatches = {self.batch_size} * {self.num_minibatches}"
      raise ConfigError(
        f"agent.num_envs={self.num_envs} does not divide {product} = {self.batch_size * self.num_minibatches}: choose "
        "sizes so that every environment gives the same number of trajectories."
      )
    if self.dual_clip is not None and self.dual_clip <= 1 + self.clipping_epsilon:
      raise ConfigError(
        f"agent.dual_clip={self.dual_clip:g} must be above 1 + agent.clipping_epsilon = {1 + self.clipping_epsilon:g}."
      )
    low, high = self.min_learning_rate, self.max_learning_rate
    if self.desired_kl is not None and not low <= self.learning_rate <= high:
      raise ConfigError(
        f"agent.learning_rate={self.learning_rate:g} must be from agent.min_learning_rate={low:g} to "
        f"agent.max_learning_rate={high:g}, between which agent.desired_kl adapts it."
      )
    super().check(num_devices)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SACConfig(OffPolicyConfig):
  """Hyperparameters of SAC."""

  algorithm = "playground.learning.sac:SAC"
  schedule = SCHEDULE
  traced = ("learning_rate", "alpha_learning_rate", "discounting", "tau", "reward_scaling")

  num_timesteps: Annotated[int, count(1, 1e12), "environment steps in all, action repeats and prefill counted"] = (
    5_000_000
  )
  num_envs: int = 128
  learning_rate: Annotated[float, positive(1), "of Adam, for actor and critics"] = 1e-3
  alpha_learning_rate: Annotated[
    float, positive(1), "of Adam, for the temperature, which holds the entropy at half a nat per action below zero"
  ] = 3e-4
  network: Annotated[SoftNetworkConfig, "actor and critics"] = dataclasses.field(default_factory=SoftNetworkConfig)


@dataclasses.dataclass(frozen=True)
class REPPONetworkConfig:
  """Sizes and inputs of REPPO's actor and critic."""

  hidden_layer_sizes: ActorSizes = (512, 512)
  q_hidden_layer_size: Annotated[int, count(1, 65536), "units of each of the critic's hidden layers"] = 512
  activation: Annotated[ActivationName, "of the actor's hidden layers"] = "swish"
  min_std: Annotated[float, positive(), "smallest standard deviation of actions before squashing"] = 0.1
  policy_obs_key: PolicyObsKey = "state"
  value_obs_key: ValueObsKey = "state"


@dataclasses.dataclass(frozen=True, kw_only=True)
class REPPOConfig(OnPolicyConfig):
  """Hyperparameters of REPPO; the defaults are the published ones for DM Control.

  The published batch is of 1024 environments and 128 steps; this one, as large, is simulated faster.
  """

  algorithm = "playground.learning.reppo:REPPO"
  schedule = SCHEDULE
  traced = ("learning_rate", "discounting", "gae_lambda", "reward_scaling", "target_entropy")

  num_envs: int = 4096
  deterministic_eval: bool = True
  unroll_length: int = 32
  num_minibatches: int = 64
  num_updates_per_batch: int = 8
  max_grad_norm: Annotated[float, positive(), "gradients of actor and critic are each scaled down to this norm"] = 0.5
  min_value: Annotated[float, Limit(), "lowest bin of the critic; the bins must hold the discounted return"] = 0.0
  max_value: Annotated[float, Limit(), "highest bin of the critic"] = 150.0
  num_bins: Annotated[int, count(2, 10_000), "bins of the critic's distribution"] = 151
  auxiliary_coefficient: Annotated[
    float, at_least_0(), "factor on the critic's loss in predicting the next reward and embedding"
  ] = 1.0
  kl_bound: Annotated[float, positive(), "largest KL divergence of a state's policy from the one that collected"] = 0.1
  target_entropy: Annotated[float, Limit(), "of the policy, nats an action"] = -0.5
  initial_temperature: Annotated[float, positive(), "factor on the entropy bonus at first"] = 0.01
  initial_kl_multiplier: Annotated[float, positive(), "factor on the KL divergence at first"] = 0.01
  init_at_random_ep_len: bool = True
  network: Annotated[REPPONetworkConfig, "actor and critic"] = dataclasses.field(default_factory=REPPONetworkConfig)

  @property
  def steps_per_update(self) -> int:
    return self.num_envs * self.unroll_length

  def check(self, num_devices: int) -> None:
    super().check(num_devices)
    if (self.num_envs // num_devices * self.unroll_length) % self.num_minibatches:
      raise ConfigError(
        f"agent.num_envs * agent.unroll_length = {self.steps_per_update} must be a multiple of "
        f"agent.num_minibatches={self.num_minibatches} on each of {num_devices} devices."
      )
    _check_values(self.min_value, self.max_value)


@dataclasses.dataclass(frozen=True)
class C51NetworkConfig:
  """Sizes and inputs of an actor and twin distributional critics; the defaults are FastTD3's."""

  policy_hidden_layer_sizes: ActorSizes = (512, 256, 128)
  q_hidden_layer_sizes: Annotated[Sequence[int], SIZES, "units of each critic's hidden layers"] = (1024, 512, 256)
  activation: Activation = "relu"
  layer_norm: Annotated[bool, "whether the hidden layers, of actor and critics, are normalised"] = False
  policy_output_scale: Annotated[float, at_least_0(), "standard deviation of the actor's last weights at first"] = 0.01
  policy_obs_key: PolicyObsKey = "state"
  value_obs_key: ValueObsKey = "state"
  value_dtype: ValueDtype = "auto"


@dataclasses.dataclass(frozen=True, kw_only=True)
class C51Config(OffPolicyConfig):
  """Hyperparameters of algorithms with distributional critics and a replay buffer."""

  num_envs: int = 1024
  policy_frequency: Annotated[int, count(1, 100_000), "the actor is updated with every n-th critic update"] = 2
  min_replay_size: int = 10_240
  learning_rate: Annotated[float, positive(1), "of AdamW, for actor and critics"] = 3e-4
  weight_decay: Annotated[float, at_least_0(), "of AdamW"] = 0.1
  min_value: Annotated[float, Limit(), "lowest atom of the critics; the atoms must hold the discounted return"] = -150.0
  max_value: Annotated[float, Limit(), "highest atom of the critics"] = 150.0
  num_atoms: Annotated[int, count(2, 10_000), "atoms of the critics' distributions"] = 101
  network: Annotated[C51NetworkConfig, "actor and critics"] = dataclasses.field(default_factory=C51NetworkConfig)

  def check(self, num_devices: int) -> None:
    super().check(num_devices)
    _check_values(self.min_value, self.max_value)


@dataclasses.dataclass(frozen=True, kw_only=True)
class FastTD3Config(C51Config):
  """Hyperparameters of FastTD3; the defaults are those of public runs on DM Control."""

  algorithm = "playground.learning.fast_td3:FastTD3"
  schedule = SCHEDULE
  traced = ("learning_rate", "discounting", "tau", "reward_scaling")

  deterministic_eval: Annotated[bool, "has no effect: the policy is deterministic"] = True
  batch_size: int = 32_768
  grad_updates_per_step: Annotated[int, count(1, 100_000), "critic updates for each step of all environments"] = 2
  tau: float = 0.1
  min_noise: Annotated[
    float, at_least_0(), "standard deviation of the exploration noise in the quietest environment"
  ] = 0.001
  max_noise: Annotated[float, at_least_0(), "and in the noisiest"] = 0.4
  policy_noise: Annotated[float, at_least_0(), "standard deviation of the noise on next actions in targets"] = 0.001
  noise_clip: Annotated[float, at_least_0(), "largest noise on next actions in targets"] = 0.5
  use_smaller_q: Annotated[
    bool, "whether targets are of the critic with the smaller value (clipped double Q-learning); else each its own"
  ] = True

  def check(self, num_devices: int) -> None:
    super().check(num_devices)
    if self.max_noise < self.min_noise:
      raise ConfigError(f"agent.max_noise={self.max_noise} must not be below agent.min_noise={self.min_noise}.")


@dataclasses.dataclass(frozen=True)
class FastSACNetworkConfig(C51NetworkConfig):
  """Sizes and inputs of FastSAC's actor and twin critics."""

  q_hidden_layer_sizes: Sequence[int] = (768, 384, 192)
  activation: ActivationName = "swish"
  layer_norm: bool = True
  policy_output_scale: float = 0.0
  min_log_std: Annotated[
    float, Limit(), "logarithm of the smallest standard deviation of actions before squashing; the first is the middle"
  ] = -5.0
  max_log_std: Annotated[float, Limit(), "logarithm of the largest"] = 0.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class FastSACConfig(C51Config):
  """Hyperparameters of FastSAC: the published ones, and FastTD3's where those are for robots alone."""

  algorithm = "playground.learning.fast_sac:FastSAC"
  schedule = SCHEDULE
  traced = ("learning_rate", "alpha_learning_rate", "discounting", "tau", "reward_scaling", "target_entropy")

  deterministic_eval: bool = True
  batch_size: int = 8192
  policy_frequency: int = 4
  tau: float = 0.125
  weight_decay: float = 0.001
  alpha_learning_rate: Annotated[float, positive(1), "of Adam, for the temperature"] = 3e-4
  initial_temperature: Annotated[float, positive(), "factor on the entropy bonus at first"] = 0.001
  target_entropy: Annotated[
    float, Limit(), "of the policy, nats an action in [-1, 1]; that of a standard deviation of 0.15 is -0.48"
  ] = -0.48
  network: Annotated[FastSACNetworkConfig, "actor and critics"] = dataclasses.field(
    default_factory=FastSACNetworkConfig
  )

  def check(self, num_devices: int) -> None:
    super().check(num_devices)
    low, high = self.network.min_log_std, self.network.max_log_std
    if high < low:
      raise ConfigError(f"agent.network.max_log_std={high} must not be below agent.network.min_log_std={low}.")


def _check_values(low: float, high: float) -> None:
  if not low <= 0 <= high or low == high:
    raise ConfigError(f"agent.min_value={low} and agent.max_value={high} must hold 0 between them.")


def config_class(name: str) -> type[AgentConfig]:
  """Returns the dataclass of an `agent.name`, ours or that of another package.

  Raises:
    UnknownNameError: no such algorithm.
    ConfigError: the entry point of another package does not work.
  """
  if name in _BUILT_IN:
    return _BUILT_IN[name]
  points = _entry_points()
  if name not in points:
    known = ", ".join(agent_names())
    near = ELSEWHERE.get(name) or nearest(name, agent_names())
    raise UnknownNameError(f"agent.name={name} does not exist: choose from {known}.{near}")
  try:
    found = points[name].load()
  except Exception as error:  # any error of an outside package
    what = f"{type(error).__name__}: {error}"
    raise ConfigError(f"agent={name}: entry point {name!r} of {ENTRY_POINTS} cannot be loaded, {what}.") from error
  if not (isinstance(found, type) and issubclass(found, AgentConfig)):
    raise ConfigError(f"agent={name}: {points[name].value} must be a dataclass that inherits from AgentConfig.")
  return found


def read_config(agent: Mapping[str, object]) -> AgentConfig:
  """Builds the dataclass of an `agent` section (a mapping with `name`).

  Raises:
    UnknownNameError: no such algorithm, or a key that it does not have, such as one that another version has saved.
    ConfigError: the entry point of another package does not work.
  """
  return build(config_class(str(agent["name"])), {k: value for k, value in agent.items() if k != "name"}, "agent")


def agent_names() -> list[str]:
  """Returns every `agent.name`: ours, then those of other packages."""
  return [*_BUILT_IN, *(name for name in _entry_points() if name not in _BUILT_IN)]


_BUILT_IN: dict[str, type[AgentConfig]] = {
  "ppo": PPOConfig,
  "sac": SACConfig,
  "reppo": REPPOConfig,
  "fast_td3": FastTD3Config,
  "fast_sac": FastSACConfig,
}


@functools.cache
def _entry_points() -> Mapping[str, importlib.metadata.EntryPoint]:
  points = {point.name: point for point in importlib.metadata.entry_points(group=ENTRY_POINTS)}
  for name in sorted(points.keys() & _BUILT_IN):
    warnings.warn(f"Entry point {name!r} of {ENTRY_POINTS} is not used: give it another name than ours.", stacklevel=2)
  return points
