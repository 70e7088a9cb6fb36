"""Hyperparameters of the algorithms: the `agent` section as dataclasses.

Each number has its limit beside it, which composing checks (`playground.config.limits`): so nothing here needs JAX.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Annotated, Any, ClassVar, Self

from playground.errors import ConfigError, UnknownNameError, nearest
from playground.extras import need
from playground.limits import SHARE, SIZES, at_least_0, count, positive

_MOST = 2**31 - 1  # transitions on a device: they are drawn by int32


@dataclasses.dataclass(frozen=True)
class CNNConfig:
  """Layers of a CNN, and what is done before and after them (paper, appendix C.6; Mnih et al., 2015)."""

  channels: Annotated[Sequence[int], SIZES] = (16, 32)
  kernels: Annotated[Sequence[int], SIZES] = (5, 3)  # pixels, square
  strides: Annotated[Sequence[int], SIZES] = (2, 2)
  activation: str = "elu"
  max_pool: bool = True  # the largest of 2 x 2 pixels after each layer
  global_pool: str = "none"  # of the last layer: none (all of it), avg, max, spatial_softmax
  normalize_channels: bool = False  # each channel of a picture to mean 0 and deviation 1


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
  """Sizes and inputs of actor and critic, two separate MLPs (Brax's names and defaults)."""

  policy_hidden_layer_sizes: Annotated[Sequence[int], SIZES] = (32, 32, 32, 32)
  value_hidden_layer_sizes: Annotated[Sequence[int], SIZES] = (256, 256, 256, 256, 256)
  activation: str = "swish"
  policy_obs_key: str = "state"  # entry of a dict observation that the actor sees; "" is none, beside pictures
  value_obs_key: str = "state"  # entry that the critic sees, "privileged_state" for an asymmetric pair
  estimated_obs_key: str = ""  # entry that the actor learns to estimate from pictures, "" is none
  value_dtype: str = "auto"  # of the critic's hidden activations; auto is bfloat16 on a GPU, float32 elsewhere
  cnn: CNNConfig = dataclasses.field(default_factory=CNNConfig)  # for pictures, if the observation has any


@dataclasses.dataclass(frozen=True)
class SoftNetworkConfig:
  """Sizes and inputs of SAC's actor and twin critics (Brax's names and defaults)."""

  hidden_layer_sizes: Annotated[Sequence[int], SIZES] = (256, 256)  # of the actor and of each critic
  activation: str = "relu"
  policy_network_layer_norm: bool = False
  q_network_layer_norm: bool = False
  policy_obs_key: str = "state"  # entry of a dict observation that the actor sees
  value_obs_key: str = "state"  # entry that the critics see, "privileged_state" for an asymmetric pair


@dataclasses.dataclass(frozen=True)
class RslRlNetworkConfig:
  """Sizes and inputs of actor and critic, two separate MLPs."""

  policy_hidden_layer_sizes: Annotated[Sequence[int], SIZES] = (512, 256, 128)
  value_hidden_layer_sizes: Annotated[Sequence[int], SIZES] = (512, 256, 128)
  activation: str = "elu"
  init_noise_std: Annotated[float, positive()] = 1.0  # of the actions at first; learned, the same for every observation
  policy_obs_key: str = "state"  # entry of a dict observation that the actor sees
  value_obs_key: str | None = None  # that the critic sees; None is privileged_state where there is one, else state


@dataclasses.dataclass(frozen=True)
class PPOConfig:
  """Hyperparameters of PPO."""

  num_timesteps: Annotated[int, count(1, 1e12)]  # control steps in all (action repeats counted), to within one batch
  num_evals: Annotated[int, count(1, 10_000)] = 10  # evaluations, those before and after training included
  num_resets_per_eval: Annotated[int, count(0, 1000)] = 0  # resets of all environments between two evaluations
  num_envs: Annotated[int, count(1, 2**24)] = 2048
  num_eval_envs: Annotated[int, count(1, 2**24)] = 128
  unroll_length: Annotated[int, count(1, 100_000)] = 10  # control steps (decisions) of one trajectory
  batch_size: Annotated[int, count(1, 2**24)] = 32  # trajectories of one minibatch
  num_minibatches: Annotated[int, count(1, 100_000)] = 16
  num_updates_per_batch: Annotated[int, count(1, 100_000)] = 2  # passes over the collected trajectories
  learning_rate: Annotated[float, positive(1)] = 1e-4  # Adam's
  max_grad_norm: Annotated[float | None, positive()] = None  # gradients are scaled down to this global norm
  discounting: Annotated[float, SHARE] = 0.9
  gae_lambda: Annotated[float, SHARE] = 0.95
  entropy_cost: Annotated[float, at_least_0()] = 1e-4
  clipping_epsilon: Annotated[float, positive()] = 0.3
  clipping_epsilon_value: Annotated[float | None, positive()] = None  # clips the value loss too, if set
  vf_loss_coefficient: Annotated[float, at_least_0()] = 0.5
  estimation_coefficient: Annotated[float, at_least_0()] = 1.0  # of the error in estimating `network.estimated_obs_key`
  reward_scaling: Annotated[float, positive()] = 1.0
  normalize_observations: bool = False
  normalize_advantage: bool = True
  bootstrap_on_timeout: bool = False  # a time-out pays the discounted value of its state instead of being masked out
  deterministic_eval: bool = False
  init_at_random_ep_len: bool = False  # environments start as old as their draw says, so a batch holds all ages
  augment_pixels: Annotated[int, count(0, 1024)] = (
    0  # largest random shift of a trajectory's images in an update, pixels
  )
  network: NetworkConfig = dataclasses.field(default_factory=NetworkConfig)
  prefill_updates: ClassVar[int] = 0  # training steps that only collect

  @classmethod
  def from_config(cls, config: Any) -> "PPOConfig":
    """Builds it from the `agent` config (a mapping)."""
    return from_config(cls, NetworkConfig, config)

  def steps_per_update(self, action_repeat: int) -> int:
    """Control steps of one training step, over all devices."""
    return self.batch_size * self.num_minibatches * self.unroll_length * action_repeat

  def check(self, num_devices: int) -> None:
    """Raises ConfigError where the sizes do not divide."""
    if (self.batch_size * self.num_minibatches) % self.num_envs:
      raise ConfigError(
        f"agent.batch_size * agent.num_minibatches = {self.batch_size * self.num_minibatches} must be a multiple of "
        f"agent.num_envs={self.num_envs}, so that every environment gives the same number of trajectories."
      )
    check_divisible(self, num_devices)


@dataclasses.dataclass(frozen=True)
class SACConfig:
  """Hyperparameters of SAC."""

  num_timesteps: Annotated[int, count(1, 1e12)]  # control steps in all (action repeats and prefill counted)
  num_evals: Annotated[int, count(1, 10_000)] = 10  # evaluations, those before and after training included
  num_resets_per_eval: Annotated[int, count(0, 1000)] = 0  # resets of all environments between two evaluations
  num_envs: Annotated[int, count(1, 2**24)] = 128
  num_eval_envs: Annotated[int, count(1, 2**24)] = 128
  batch_size: Annotated[int, count(1, 2**24)] = 256  # transitions of one gradient step
  grad_updates_per_step: Annotated[int, count(1, 100_000)] = 1  # gradient steps for each step of all environments
  min_replay_size: Annotated[int, count(0, 2**40)] = 0  # transitions collected before the first gradient step
  max_replay_size: Annotated[int, count(1, 2**40)] = 1_048_576  # transitions kept, the newest
  learning_rate: Annotated[float, positive(1)] = 1e-4  # Adam's, for actor and critics
  alpha_learning_rate: Annotated[float, positive(1)] = 3e-4  # Adam's, for the temperature
  discounting: Annotated[float, SHARE] = 0.9
  tau: Annotated[float, SHARE] = 0.005  # how far the target critics move towards the critics after each gradient step
  reward_scaling: Annotated[float, positive()] = 1.0
  normalize_observations: bool = False
  deterministic_eval: bool = False
  checkpoint_replay: bool = True  # whether checkpoints hold the replay buffer; if not, a resumed run refills it
  network: SoftNetworkConfig = dataclasses.field(default_factory=SoftNetworkConfig)

  @classmethod
  def from_config(cls, config: Any) -> "SACConfig":
    """Builds it from the `agent` config (a mapping)."""
    return from_config(cls, SoftNetworkConfig, config)

  @property
  def prefill_updates(self) -> int:
    """Training steps that only collect."""
    return math.ceil(self.min_replay_size / self.num_envs)

  def steps_per_update(self, action_repeat: int) -> int:
    """Control steps of one training step, over all devices."""
    return self.num_envs * action_repeat

  def check(self, num_devices: int) -> None:
    """Raises ConfigError where the sizes do not go together."""
    check_divisible(self, num_devices)
    for name in ("num_envs", "min_replay_size"):
      if getattr(self, name) > self.max_replay_size:
        size = getattr(self, name)
        raise ConfigError(f"agent.max_replay_size={self.max_replay_size} must not be below agent.{name}={size}.")
    if self.max_replay_size // num_devices > _MOST:
      raise ConfigError(f"agent.max_replay_size={self.max_replay_size} must be at most {_MOST} for each device.")


@dataclasses.dataclass(frozen=True)
class RslRlPPOConfig:
  """Hyperparameters; configs/agent/rsl_rl_ppo.yaml has RSL-RL's names for them."""

  num_timesteps: Annotated[int, count(1, 1e12)]
  num_evals: Annotated[int, count(1, 10_000)] = 10
  num_resets_per_eval: Annotated[int, count(0, 1000)] = 0
  num_envs: Annotated[int, count(1, 2**24)] = 4096
  num_eval_envs: Annotated[int, count(1, 2**24)] = 128
  unroll_length: Annotated[int, count(1, 100_000)] = 24
  num_minibatches: Annotated[int, count(1, 100_000)] = 4
  num_updates_per_batch: Annotated[int, count(1, 100_000)] = 5
  learning_rate: Annotated[float, positive(1)] = 3e-4
  schedule: str = "fixed"  # or adaptive: the learning rate follows `desired_kl`
  desired_kl: Annotated[float, positive()] = 0.01
  max_grad_norm: Annotated[float | None, positive()] = 1.0
  discounting: Annotated[float, SHARE] = 0.99
  gae_lambda: Annotated[float, SHARE] = 0.95
  entropy_cost: Annotated[float, at_least_0()] = 1e-3
  vf_loss_coefficient: Annotated[float, at_least_0()] = 1.0
  clipping_epsilon: Annotated[float, positive()] = 0.2
  clip_value_loss: bool = True
  normalize_observations: bool = True
  deterministic_eval: bool = False
  network: RslRlNetworkConfig = dataclasses.field(default_factory=RslRlNetworkConfig)

  @classmethod
  def from_config(cls, config: Any) -> Self:
    """Builds it from the `agent` config (a mapping)."""
    return from_config(cls, RslRlNetworkConfig, config)

  def check(self, num_devices: int) -> None:
    """Raises ConfigError where RSL-RL is not installed, or cannot train on so many devices."""
    need("rsl-rl", "torch", "rsl_rl")
    if num_devices > 1:
      raise ConfigError(f"agent=rsl_rl_ppo trains on one device and not on {num_devices}: give hardware.devices=1.")


def check_divisible(config: Any, num_devices: int) -> None:
  """Raises ConfigError where environments or batch cannot be divided evenly over the devices."""
  for name in ("num_envs", "num_eval_envs", "batch_size"):
    size = getattr(config, name)
    if size % num_devices:
      raise ConfigError(f"agent.{name}={size} must be a multiple of the number of devices, {num_devices}.")


def from_config(config_class: Callable[..., Any], network_class: Callable[..., Any], config: Any) -> Any:
  """Builds hyperparameters from the `agent` config (a mapping); `name` is not one of them.

  Raises:
    UnknownNameError: a key that the algorithm does not have, such as one of a run that another version has saved.
  """
  values = {k: v for k, v in dict(config).items() if k not in ("name", "network")}
  network = dict(config["network"])
  if "cnn" in network:
    network["cnn"] = _build(CNNConfig, dict(network["cnn"]), "agent.network.cnn")
  return _build(config_class, {**values, "network": _build(network_class, network, "agent.network")}, "agent")


def _build(config_class: Any, values: dict[str, Any], key: str) -> Any:
  known = [field.name for field in dataclasses.fields(config_class)]
  if unknown := [name for name in values if name not in known]:
    raise UnknownNameError(f"{key}.{unknown[0]} does not exist.{nearest(unknown[0], known)}")
  return config_class(**values)


CONFIGS: dict[str, Any] = {"ppo": PPOConfig, "sac": SACConfig, "rsl_rl_ppo": RslRlPPOConfig}  # by agent.name
