"""PPO of RSL-RL (rsl-rl-lib 5) as one of our algorithms: its learning in torch, everything around it ours.

The training state is of JAX arrays under the names that torch gives its parameters, so that evaluation, checkpoints,
resuming and export are those of every algorithm, and need no torch. A training step lends the state to torch
(`rsl_rl_torch.py`), which steps our environments through `playground.adapters.rsl_rl`.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from playground.envs.base import PIXELS, Env, Observation, State
from playground.envs.wrappers import ModelFields
from playground.errors import ConfigError, nearest
from playground.hardware.mesh import AXIS, jit_on_mesh
from playground.learning.hyperparameters import RslRlNetworkConfig, RslRlPPOConfig
from playground.learning.learner import SPEC, Learner, Metrics, TrainState, report
from playground.learning.networks import Actor, ActorCriticParams, ObservationSize
from playground.learning.rollout import EpisodeSums, NonfiniteCapture, episode_sums

_ACTIVATIONS = ("elu", "relu", "swish", "tanh")  # the same function here and there under the same name
_EPSILON = 1e-2  # that RSL-RL adds to an observation's deviation
_SMALLEST_STD = 1e-6  # of an action, in RSL-RL


class GaussianActorCritic(Actor):
  """RSL-RL's networks: MLPs under torch's names, a Gaussian of the actions with a deviation of its own, clipped.

  Inputs and precision are those of all our actors; the two networks' parameters, normalisers and sizes are not.
  """

  squashed = False

  def __init__(
    self,
    obs_size: ObservationSize,
    action_size: int,
    config: RslRlNetworkConfig,
    precision: str | None = None,
    normalize: bool = True,
  ):
    """Builds the networks; see `Actor` for the arguments and errors."""
    entries = obs_size if isinstance(obs_size, Mapping) else {"state": (obs_size,)}
    if any(entry.startswith(PIXELS) for entry in entries):
      raise ConfigError("agent=rsl_rl_ppo reads no pictures: choose agent=ppo, or env.vision.enable=false.")
    if config.activation not in _ACTIVATIONS:
      allowed = ", ".join(_ACTIVATIONS) + "." + nearest(config.activation, _ACTIVATIONS)
      raise ConfigError(f"agent.network.activation={config.activation!r} must be one of {allowed}")
    both = "privileged_state" if "privileged_state" in entries else "state"
    config = dataclasses.replace(config, value_obs_key=config.value_obs_key or both)
    super().__init__(obs_size, action_size, config.policy_hidden_layer_sizes, config, precision)  # pyright: ignore
    inputs = {"policy": self.obs_sizes[self.policy_obs_key][-1], "value": self.obs_sizes[self.value_obs_key][-1]}
    self.inputs, self.normalize, self.init_noise_std = inputs, normalize, config.init_noise_std
    self.sizes = {
      "policy": [inputs["policy"], *config.policy_hidden_layer_sizes, action_size],
      "value": [inputs["value"], *config.value_hidden_layer_sizes, 1],
    }

  def init(self, key: jax.Array) -> ActorCriticParams:
    """Parameters as torch draws them for its linear layers: uniform within 1 / sqrt(number of inputs)."""
    policy_key, value_key = jax.random.split(key)
    std = {"distribution.std_param": jnp.full(self.action_size, self.init_noise_std)}
    policy = _init_mlp(policy_key, self.sizes["policy"]) | std
    return ActorCriticParams(policy, _init_mlp(value_key, self.sizes["value"]))

  def init_normalizer(self) -> Any:
    """RSL-RL's running statistics of what actor and critic see, by its own names."""
    if not self.normalize:
      return {"policy": {}, "value": {}}
    names = {"_mean": jnp.zeros, "_var": jnp.ones, "_std": jnp.ones}
    of = lambda size: {f"obs_normalizer.{name}": make((1, size)) for name, make in names.items()}
    return {net: of(size) | {"obs_normalizer.count": jnp.zeros((), jnp.int32)} for net, size in self.inputs.items()}

  def act(
    self, policy: Any, normalizer: Any, obs: Observation, key: jax.Array, deterministic: bool = False
  ) -> jax.Array:
    """Actions in [-1, 1], [..., action_size], sampled or (deterministic) the mean."""
    params, seen = self.mlp(policy, normalizer)
    hidden = self.select(obs)[self.policy_obs_key]
    if seen is not None:
      hidden = (hidden - seen[0]) / seen[1]
    with self.at_precision():
      for i in range(len(params)):
        hidden = hidden @ params[f"hidden_{i}"]["kernel"] + params[f"hidden_{i}"]["bias"]
        hidden = self.activation(hidden) if i < len(params) - 1 else hidden
    if not deterministic:
      std = jnp.maximum(policy["distribution.std_param"], _SMALLEST_STD)
      hidden += std * jax.random.normal(key, hidden.shape)
    return jnp.clip(hidden, -1.0, 1.0)

  def mlp(self, policy: Any, normalizer: Any) -> tuple[dict[str, Any], tuple[jax.Array, jax.Array] | None]:
    layer = lambda i: {"kernel": policy[f"mlp.{2 * i}.weight"].T, "bias": policy[f"mlp.{2 * i}.bias"]}
    params = {f"hidden_{i}": layer(i) for i in range(len(self.sizes["policy"]) - 1)}
    if not normalizer or not normalizer["policy"]:
      return params, None
    mean, std = (normalizer["policy"][f"obs_normalizer.{name}"][0] for name in ("_mean", "_std"))
    return params, (mean, std + _EPSILON)


class RslRlPPO(Learner):
  """The algorithm for one task, on one device."""

  Config = RslRlPPOConfig

  def __init__(self, env: Env, config: RslRlPPOConfig, mesh: Mesh, network_precision: str | None = None):
    """See `ppo.PPO` for the arguments and errors."""
    networks = GaussianActorCritic(
      env.observation_size, env.action_size, config.network, network_precision, config.normalize_observations
    )
    steps_per_update = config.num_envs * config.unroll_length * env.action_repeat
    super().__init__(env, config, mesh, networks, steps_per_update, TrainState(**SPEC))
    specs = (P(AXIS), P(AXIS), P())
    advance = jit_on_mesh(self._advance, mesh, (*specs, P(AXIS), P(AXIS)), specs)
    self.train = _OnHost(self._train_on_host, advance, self._advance_arguments)
    self._torch: Any = None  # RSL-RL's algorithm, made when it is first needed, and
    self._zeros: EpisodeSums = {}  # sums over nothing

  def notices(self) -> list[str]:
    import torch  # pyright: ignore[reportMissingImports]

    from playground.learning import rsl_rl_torch  # noqa: F401  # takes seconds: now, and not in the first row

    gpu = self.mesh.devices.flat[0].platform == "gpu"
    if gpu and not torch.cuda.is_available():
      what = f"JAX trains on a GPU that torch {torch.__version__} cannot use"
      raise ConfigError(f"{what}: install torch's CUDA build, or give hardware=cpu.")
    return [f"RSL-RL's PPO in torch {torch.__version__}, on {'the GPU' if gpu else 'the CPU'}."]

  def _init(self, key: jax.Array, model: ModelFields) -> TrainState:
    key, net_key, env_key = jax.random.split(key, 3)
    params, env_state = self.networks.init(net_key), self._fresh(env_key, model)
    zeros = lambda: jax.tree.map(jnp.zeros_like, params)
    adam = {"exp_avg": zeros(), "exp_avg_sq": zeros(), "step": jnp.zeros(())}
    return TrainState(
      params=params,
      opt_state=adam | {"learning_rate": jnp.asarray(self.config.learning_rate)},
      normalizer=self.networks.init_normalizer(),
      key=key,
      env_state=env_state,
      capture=NonfiniteCapture.empty(env_state, self.env.action_size, model),
    )

  def _training_step(
    self, state: TrainState, model: ModelFields, advance: Callable[..., Any] | None = None
  ) -> tuple[TrainState, Metrics]:
    """One iteration of RSL-RL's runner, on the host."""
    from playground.adapters.rsl_rl import VecEnv
    from playground.learning.rsl_rl_torch import TorchPPO

    run = advance or self.train.jitted
    capture, sums = state.capture, self._zeros

    def step(env_state: State, action: jax.Array) -> State:
      nonlocal capture, sums
      env_state, capture, sums = run(env_state, capture, sums, action, model)
      return env_state

    groups = {"policy": self.networks.policy_obs_key, "critic": self.networks.value_obs_key}
    env = VecEnv(self.env.unwrapped, state.env_state, step, groups, log=False)
    if self._torch is None:
      self._torch = TorchPPO(env, self.config, self.networks.precision)
      shapes = jax.eval_shape(episode_sums, state.env_state)
      sums = self._zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    key, noise = jax.random.split(state.key)
    learned, metrics = self._torch.training_step(env, (state.params, state.normalizer, state.opt_state), noise)
    learned, key = jax.device_put((learned, key), NamedSharding(self.mesh, P()))
    params, normalizer, opt_state = learned
    after = TrainState(
      params=params, opt_state=opt_state, normalizer=normalizer, key=key, env_state=env.state, capture=capture
    )
    return after, jax.device_get(sums) | metrics | {"learned": np.float32(1)}

  def _train_on_host(
    self, advance: Callable[..., Any], state: TrainState, model: ModelFields, num_updates: Any
  ) -> tuple[TrainState, Metrics]:
    total: dict[str, Any] = {}
    for _ in range(int(num_updates)):
      state, metrics = self._training_step(state, model, advance)
      total = {name: total.get(name, 0) + value for name, value in metrics.items()}
    return state, report(jax.tree.map(jnp.asarray, total))

  def _advance(
    self, env_state: State, capture: NonfiniteCapture, sums: EpisodeSums, action: jax.Array, model: ModelFields
  ) -> tuple[State, NonfiniteCapture, EpisodeSums]:
    """A step of the environments, with the sums over what ended."""
    after = self.env.step(env_state, action, model)
    sums = jax.tree.map(jnp.add, sums, episode_sums(after))
    return after, capture.look(env_state, action, model, after), sums

  def _advance_arguments(self, state: Any, model: ModelFields, num_updates: Any) -> tuple[Any, ...]:
    action = jax.ShapeDtypeStruct((self.config.num_envs, self.env.action_size), jnp.float32)
    return state.env_state, state.capture, jax.eval_shape(episode_sums, state.env_state), action, model


@dataclasses.dataclass(frozen=True)
class _OnHost:
  """A function of the host around a jitted one. Traced, lowered and compiled ahead of time, it is as that one is.

  Attributes:
    function: takes the jitted (or compiled) one, then its own arguments.
    jitted: what is compiled.
    arguments: of `jitted`, as shapes, for the arguments of `function`.
  """

  function: Callable[..., Any]
  jitted: Any
  arguments: Callable[..., tuple[Any, ...]]
  out_info = None

  def __call__(self, *args: Any) -> Any:
    return self.function(self.jitted, *args)

  def trace(self, *args: Any) -> Self:
    return dataclasses.replace(self, jitted=self.jitted.trace(*self.arguments(*args)))

  def lower(self) -> Self:
    return dataclasses.replace(self, jitted=self.jitted.lower())

  def compile(self) -> Self:
    return dataclasses.replace(self, jitted=self.jitted.compile())


def _init_mlp(key: jax.Array, sizes: Sequence[int]) -> dict[str, jax.Array]:
  params = {}
  for i, (fan_in, fan_out) in enumerate(pairwise(sizes)):
    weight_key, bias_key = jax.random.split(jax.random.fold_in(key, i))
    draw = lambda key, shape, bound=1 / math.sqrt(fan_in): jax.random.uniform(key, shape, minval=-bound, maxval=bound)
    params |= {f"mlp.{2 * i}.weight": draw(weight_key, (fan_out, fan_in)), f"mlp.{2 * i}.bias": draw(bias_key, fan_out)}
  return params
