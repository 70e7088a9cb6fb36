"""Actor and critic on Brax's networks and distributions, with observation normalisation."""

import dataclasses
from collections.abc import Mapping, Sequence
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
    self._networks = brax_networks.make_ppo_networks(
      dict(sizes),
      action_size,
      policy_hidden_layer_sizes=tuple(config.policy_hidden_layer_sizes),
      value_hidden_layer_sizes=tuple(config.value_hidden_layer_sizes),
      activation=ACTIVATIONS[config.activation],
      policy_obs_key=config.policy_obs_key,
      value_obs_key=config.value_obs_key,
    )
    self.distribution = self._networks.parametric_action_distribution

  def init(self, key: jax.Array) -> ActorCriticParams:
    policy, value = jax.random.split(key)
    return ActorCriticParams(self._networks.policy_network.init(policy), self._networks.value_network.init(value))

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
      return self._networks.value_network.apply(None, value_params, obs[self.config.value_obs_key])

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
