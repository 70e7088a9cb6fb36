"""Actor and critic on Brax's networks and distributions, with observation normalisation."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import networks as brax_networks
from flax import linen, struct

from playground.envs.base import Observation
from playground.errors import ConfigError, nearest

ACTIVATIONS = {"swish": linen.swish, "relu": linen.relu, "elu": linen.elu, "tanh": linen.tanh, "gelu": linen.gelu}

Normalizer = running_statistics.RunningStatisticsState
ObservationSize = int | Mapping[str, tuple[int, ...]]


class ActorCriticParams(struct.PyTreeNode):
  """Parameters of the two networks."""

  policy: Any
  value: Any


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
  """Sizes and inputs of actor and critic, two separate MLPs (Brax's names and defaults)."""

  policy_hidden_layer_sizes: Sequence[int] = (32, 32, 32, 32)
  value_hidden_layer_sizes: Sequence[int] = (256, 256, 256, 256, 256)
  activation: str = "swish"
  policy_obs_key: str = "state"  # entry of a dict observation that the actor sees
  value_obs_key: str = "state"  # entry that the critic sees, "privileged_state" for an asymmetric pair
  value_dtype: str = "auto"  # of the critic's hidden activations; auto is bfloat16 on a GPU, float32 elsewhere


class Critic(linen.Module):
  """Brax's value MLP with its hidden layers computed in `dtype`; parameters and output are float32.

  Writing and reading the hidden activations is most of what an update costs on a GPU. The actor stays in float32: the
  loss compares its log-probabilities with those at acting time.
  """

  hidden_layer_sizes: Sequence[int]
  activation: Callable[[jax.Array], jax.Array]
  dtype: Any

  @linen.compact
  def __call__(self, obs: jax.Array) -> jax.Array:
    init, hidden = jax.nn.initializers.lecun_uniform(), obs
    for i, size in enumerate(self.hidden_layer_sizes):
      hidden = self.activation(linen.Dense(size, dtype=self.dtype, kernel_init=init, name=f"hidden_{i}")(hidden))
    last = linen.Dense(1, dtype=jnp.float32, kernel_init=init, name=f"hidden_{len(self.hidden_layer_sizes)}")
    return last(hidden)[..., 0]


class ActorCritic:
  """A tanh-squashed Gaussian actor and a value network.

  Observations are dicts of arrays with any leading axes; a task's flat observation counts as {"state": obs}.
  """

  def __init__(self, obs_size: ObservationSize, action_size: int, config: NetworkConfig, precision: str | None = None):
    """Builds the networks.

    Args:
      obs_size: the task's `observation_size`.
      action_size: length of the action vector.
      config: sizes and inputs.
      precision: matrix-product precision of the networks ('highest', 'tensorfloat32', 'bfloat16'), None for the
        process's default.

    Raises:
      ConfigError: unknown activation, or an observation entry the task does not have.
    """
    if config.activation not in ACTIVATIONS:
      allowed = ", ".join(ACTIVATIONS) + "." + nearest(config.activation, ACTIVATIONS)
      raise ConfigError(f"agent.network.activation={config.activation!r} must be one of {allowed}")
    if config.value_dtype not in ("auto", "bfloat16", "float32"):
      raise ConfigError(f"agent.network.value_dtype={config.value_dtype!r} must be one of auto, bfloat16, float32.")
    sizes = obs_size if isinstance(obs_size, Mapping) else {"state": (obs_size,)}
    for name in ("policy_obs_key", "value_obs_key"):
      key = getattr(config, name)
      if key not in sizes:
        entries = ", ".join(sizes) + "." + nearest(key, sizes)
        raise ConfigError(f"agent.network.{name}={key!r} must be an entry of the task's observation: {entries}")
    self.config = config
    self.precision = precision
    self.obs_keys = tuple(sorted({config.policy_obs_key, config.value_obs_key}))
    self._sizes = {key: sizes[key] for key in self.obs_keys}
    auto = "bfloat16" if jax.default_backend() == "gpu" else "float32"
    self.value_dtype = auto if config.value_dtype == "auto" else config.value_dtype
    self._critic = Critic(
      tuple(config.value_hidden_layer_sizes), ACTIVATIONS[config.activation], jnp.dtype(self.value_dtype)
    )
    self._networks = brax_networks.make_ppo_networks(
      dict(sizes),
      action_size,
      policy_hidden_layer_sizes=tuple(config.policy_hidden_layer_sizes),
      activation=ACTIVATIONS[config.activation],
      policy_obs_key=config.policy_obs_key,
    )
    self.distribution = self._networks.parametric_action_distribution

  def init(self, key: jax.Array) -> ActorCriticParams:
    policy, value = jax.random.split(key)
    obs = jnp.zeros((1, *self._sizes[self.config.value_obs_key]))
    return ActorCriticParams(self._networks.policy_network.init(policy), self._critic.init(value, obs))

  def init_normalizer(self) -> Normalizer:
    shapes = {key: specs.Array(size, jnp.dtype("float32")) for key, size in self._sizes.items()}
    state = running_statistics.init_state(shapes)  # pyright: ignore[reportArgumentType]
    # Python numbers are weakly typed: a loop over them would be traced, and compiled, a second time.
    count = jax.tree.map(lambda x: jnp.asarray(x, jnp.uint32), state.count)
    return state.replace(count=count, std_eps=jnp.asarray(state.std_eps, jnp.float32))

  def select(self, obs: Observation) -> dict[str, jax.Array]:
    """The entries of an observation that actor or critic reads."""
    entries = obs if isinstance(obs, Mapping) else {"state": obs}
    return {key: entries[key] for key in self.obs_keys}

  def logits(self, policy_params: Any, obs: Mapping[str, jax.Array]) -> jax.Array:
    """Parameters of the action distribution, [..., 2 * action_size], for normalised observations."""
    with jax.default_matmul_precision(self.precision or jax.config.jax_default_matmul_precision):
      return self._networks.policy_network.apply(None, policy_params, obs[self.config.policy_obs_key])

  def value(self, value_params: Any, obs: Mapping[str, jax.Array]) -> jax.Array:
    """State values, [...], for normalised observations."""
    with jax.default_matmul_precision(self.precision or jax.config.jax_default_matmul_precision):
      return self._critic.apply(value_params, obs[self.config.value_obs_key])  # pyright: ignore[reportReturnType]

  def act(
    self, policy: Any, normalizer: Normalizer | None, obs: Observation, key: jax.Array, deterministic: bool = False
  ) -> jax.Array:
    """Actions in [-1, 1], [..., action_size], sampled or (deterministic) the mode."""
    logits = self.logits(policy, normalize(self.select(obs), normalizer))
    return self.distribution.mode(logits) if deterministic else self.distribution.sample(logits, key)


def normalize(obs: Mapping[str, jax.Array], normalizer: Normalizer | None) -> dict[str, jax.Array]:
  """Subtracts the running mean and divides by the running deviation; None leaves the observation as it is."""
  if normalizer is None:
    return dict(obs)
  mean: Any = normalizer.mean
  std: Any = normalizer.std
  return {k: (v - mean[k]) / std[k] for k, v in obs.items()}
