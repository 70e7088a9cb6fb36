"""Actors and critics on Brax's networks and distributions, with observation normalisation."""

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
from brax.training import networks as brax_networks
from brax.training.acme import running_statistics, specs
from brax.training.distribution import NormalTanhDistribution
from brax.training.types import UInt64
from flax import linen, struct
from jax.typing import DTypeLike

from playground.envs.base import PIXELS, Observation, observation_groups
from playground.errors import ConfigError, nearest
from playground.hardware.mesh import AXIS
from playground.learning.cnn import ESTIMATOR, Activation, PixelNetwork, check_cnn
from playground.learning.hyperparameters import (
  ActivationName,
  C51NetworkConfig,
  CNNConfig,
  NetworkConfig,
  REPPONetworkConfig,
  SoftNetworkConfig,
)
from playground.pytree import PyTree

ACTIVATIONS: dict[ActivationName, Activation] = {name: getattr(linen, name) for name in get_args(ActivationName)}

MIN_STD = 1e-3  # of actions before squashing
MAX_TERMS = 2**21  # in the sums of observation statistics

Normalizer = running_statistics.RunningStatisticsState
ObservationSize = int | Mapping[str, tuple[int, ...]]


@struct.dataclass
class Count:
  """A number below 2**64, of two uint32 halves.

  Brax's `UInt64` does the arithmetic, but moves its halves to the device whenever JAX rebuilds a tree that has one, a
  fetched one too: threads that write results would then use the device while it trains.
  """

  hi: Any
  lo: Any


def update_normalizer(normalizer: Normalizer, obs: Mapping[str, jax.Array]) -> Normalizer:
  """Adds observations, [..., D] each, of all devices to the statistics, by Brax's Welford algorithm.

  In float32 a sum of 2**24 equal terms no longer grows. So after `MAX_TERMS` updates count and sum are halved, and from
  then on older observations count less.
  """
  if not obs:
    return normalizer
  count: Any = normalizer.count
  counted = normalizer.replace(count=UInt64(count.hi, count.lo))  # pyright: ignore[reportCallIssue]
  updated: Any = running_statistics.update(counted, obs, pmap_axis_name=AXIS)
  hi, lo = updated.count.hi, updated.count.lo
  samples = jax.tree.leaves(obs)[0].size // jax.tree.leaves(updated.mean)[0].size * jax.lax.axis_size(AXIS)
  full = hi * 2.0**32 + lo >= samples * float(MAX_TERMS)
  kept = jax.tree.map(lambda total: jnp.where(full, total / 2, total), updated.summed_variance)
  half = Count(jnp.where(full, hi >> 1, hi), jnp.where(full, lo >> 1 | hi << 31, lo))
  return updated.replace(count=half, summed_variance=kept)


class Actor:
  """A tanh-squashed Gaussian actor; its observation groups, normaliser and precision are also the critics'.

  Observations are dicts of arrays with any leading axes; a task's flat observation counts as {"state": obs}. Actor
  and critic both read images (`pixels/...`, [..., H, W, C] uint8), with separate CNNs.

  Attributes:
    cnn: layers for images; None without images.
    obs_limit: clip range of normalised vectors; None without a limit.
  """

  def __init__(
    self,
    obs_size: ObservationSize,
    action_size: int,
    hidden_layer_sizes: Sequence[int],
    config: NetworkConfig | SoftNetworkConfig | REPPONetworkConfig | C51NetworkConfig,
    precision: str | None = None,
    layer_norm: bool = False,
  ):
    """Builds the actor.

    Args:
      obs_size: the task's `observation_size`.
      action_size: length of the action vector.
      hidden_layer_sizes: of the actor.
      config: activation and inputs.
      precision: matrix-product precision of the networks ('highest', 'tensorfloat32', 'bfloat16'), None for the
        process's default.
      layer_norm: whether the actor's hidden layers are normalised.

    Raises:
      ConfigError: unknown activation, or an observation group that the task does not have.
    """
    sizes = obs_size if isinstance(obs_size, Mapping) else {"state": (obs_size,)}
    self.pixel_sizes = {key: sizes[key] for key in sorted(sizes) if key.startswith(PIXELS)}
    self.estimated_obs_key: str = getattr(config, "estimated_obs_key", "")
    if self.estimated_obs_key and not (self.pixel_sizes and hidden_layer_sizes):
      raise ConfigError(
        f"agent.network.estimated_obs_key={self.estimated_obs_key!r} is estimated from images by the first layer of "
        "agent.network.policy_hidden_layer_sizes: this run lacks one of them."
      )
    vectors = [key for key in sizes if key not in self.pixel_sizes]
    for name in ("policy_obs_key", "value_obs_key", "estimated_obs_key"):
      key, optional = getattr(config, name, ""), bool(self.pixel_sizes) or name == "estimated_obs_key"
      if key not in vectors and not (key == "" and optional):
        what = "an entry of the task's observation" + " that is no image" * bool(self.pixel_sizes)
        entries = ", ".join(vectors) + "." + nearest(key, vectors)
        raise ConfigError(f"agent.network.{name}={key!r} must be {what}: {entries}")
    if self.estimated_obs_key and self.estimated_obs_key == config.policy_obs_key:
      raise ConfigError(
        f"agent.network.estimated_obs_key={self.estimated_obs_key!r} is what the actor reads: estimate another entry, "
        'or have it read images alone (agent.network.policy_obs_key="").'
      )
    self.obs_limit: float | None = getattr(config, "clip_observations", None)
    self.precision = precision
    self.action_size = action_size
    self.activation, self.activation_name = ACTIVATIONS[config.activation], config.activation
    self.policy_obs_key, self.value_obs_key = config.policy_obs_key, config.value_obs_key
    self.obs_keys = tuple(sorted({config.policy_obs_key, config.value_obs_key, self.estimated_obs_key} - {""}))
    self.obs_sizes = {key: sizes[key] for key in self.obs_keys}
    self.distribution = NormalTanhDistribution(event_size=action_size, min_std=MIN_STD)
    self.cnn: CNNConfig | None = None
    if self.pixel_sizes:
      assert isinstance(config, NetworkConfig)
      self.cnn = config.cnn
      init = linen.initializers.orthogonal(0.2)
      sizes = tuple(hidden_layer_sizes)
      estimated = math.prod(self.obs_sizes[self.estimated_obs_key]) if self.estimated_obs_key else 0
      params = self.distribution.param_size
      self._actor = self._on_pixels(config.cnn, sizes, params, output_init=init, estimate_size=estimated)
    else:
      self.policy_network = brax_networks.make_policy_network(
        self.distribution.param_size,
        dict(sizes),
        hidden_layer_sizes=tuple(hidden_layer_sizes),
        activation=self.activation,
        layer_norm=layer_norm,
        obs_key=config.policy_obs_key,
      )

  def init_normalizer(self) -> Normalizer:
    shapes = {key: specs.Array(size, jnp.dtype("float32")) for key, size in self.obs_sizes.items()}
    state = running_statistics.init_state(shapes)  # pyright: ignore[reportArgumentType]
    # Python numbers are weakly typed: a loop over them would be traced, and compiled, a second time.
    zero = jnp.zeros((), jnp.uint32)
    return state.replace(count=Count(zero, zero), std_eps=jnp.asarray(state.std_eps, jnp.float32))

  def select(self, obs: Observation) -> dict[str, jax.Array]:
    """Returns the groups of an observation that actor or critic reads."""
    entries = observation_groups(obs)
    return {key: entries[key] for key in (*self.obs_keys, *self.pixel_sizes)}

  def vectors(self, obs: Mapping[str, jax.Array]) -> dict[str, jax.Array]:
    """Returns the vectors of a selected observation, which are normalised, without images."""
    return {key: obs[key] for key in self.obs_keys}

  def logits(self, policy_params: PyTree, obs: Mapping[str, jax.Array]) -> jax.Array:
    """Returns parameters of the action distribution, [..., 2 * action_size], for normalised observations."""
    with self.at_precision():
      if self.pixel_sizes:
        return self._actor.apply(policy_params, *self._seen(obs, self.policy_obs_key))  # pyright: ignore[reportReturnType]
      return self.policy_network.apply(None, policy_params, self._vector(obs, self.policy_obs_key))

  def logits_and_estimate(
    self, policy_params: PyTree, obs: Mapping[str, jax.Array]
  ) -> tuple[jax.Array, jax.Array | None]:
    """Returns `logits`, and the actor's estimate of `estimated_obs_key`, normalised, [..., D]; None without one."""
    if not self.estimated_obs_key:
      return self.logits(policy_params, obs), None
    with self.at_precision():
      seen = self._seen(obs, self.policy_obs_key)
      logits, more = self._actor.apply(policy_params, *seen, mutable=["intermediates"])
      return logits, more["intermediates"]["estimate"][0]  # pyright: ignore[reportReturnType]

  def act(
    self, policy: PyTree, normalizer: Normalizer | None, obs: Observation, key: jax.Array, deterministic: bool = False
  ) -> jax.Array:
    """Returns actions in [-1, 1], [..., action_size], sampled or (deterministic) the mode."""
    logits = self.logits(policy, normalize(self.select(obs), normalizer))
    return self.distribution.mode(logits) if deterministic else self.distribution.sample(logits, key)

  def sample(self, logits: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Samples actions, [..., action_size], and their log-probabilities, [...]; gradients flow through the actions."""
    raw_action = self.distribution.sample_no_postprocessing(logits, key)
    return self.distribution.postprocess(raw_action), self.distribution.log_prob(logits, raw_action)

  def kl(self, old: jax.Array, new: jax.Array) -> jax.Array:
    """KL(old || new), [...], of the Gaussians before squashing, which is that of the actions."""
    before, after = self.distribution.create_dist(old), self.distribution.create_dist(new)
    ratio, distance = before.scale / after.scale, (before.loc - after.loc) / after.scale
    return (0.5 * (jnp.square(ratio) + jnp.square(distance) - 1) - jnp.log(ratio)).sum(axis=-1)

  def mlp(
    self, policy: PyTree, normalizer: Normalizer | None
  ) -> tuple[Mapping[str, PyTree], tuple[np.ndarray, np.ndarray] | None]:
    """Returns Flax layers, mean and std of the vector (None without one or unnormalised), on the host."""
    key = self.policy_obs_key
    statistics: PyTree = normalizer
    layers = {name: layer for name, layer in policy["params"].items() if name != ESTIMATOR}
    return layers, (statistics.mean[key], statistics.std[key]) if key and normalizer is not None else None

  @property
  def policy_inputs(self) -> dict[str, tuple[int, ...]]:
    """Returns the shapes of the actor's inputs: images, then the vector, in the order of its features."""
    key = self.policy_obs_key
    return self.pixel_sizes | ({key: self.obs_sizes[key]} if key else {})

  def _on_pixels(self, cnn: CNNConfig, sizes: Sequence[int], output_size: int, **how: PyTree) -> PixelNetwork:
    check_cnn(cnn)
    return PixelNetwork(cnn, ACTIVATIONS[cnn.activation], tuple(sizes), self.activation, output_size, **how)

  def _seen(self, obs: Mapping[str, jax.Array], key: str) -> tuple[dict[str, jax.Array], jax.Array | None]:
    """Returns the inputs of a network on pixels: images, and the vector `key` unless that is empty."""
    return {name: obs[name] for name in self.pixel_sizes}, self._vector(obs, key) if key else None

  def _vector(self, obs: Mapping[str, jax.Array], key: str) -> jax.Array:
    """Returns the group `key` of a normalised observation, clipped to the limit."""
    return obs[key] if self.obs_limit is None else jnp.clip(obs[key], -self.obs_limit, self.obs_limit)

  def _example(self) -> dict[str, jax.Array]:
    """Returns an observation of zeros, a batch of one."""
    images = {key: jnp.zeros((1, *size), jnp.uint8) for key, size in self.pixel_sizes.items()}
    return images | {key: jnp.zeros((1, *size)) for key, size in self.obs_sizes.items()}

  def at_precision(self) -> AbstractContextManager[None]:
    """Returns a context in which matrix products have the networks' precision."""
    return jax.default_matmul_precision(self.precision or jax.config.jax_default_matmul_precision)


class ActorCriticParams(struct.PyTreeNode):
  """Parameters of the two networks."""

  policy: PyTree
  value: PyTree


class Critic(linen.Module):
  """Brax's MLP with its hidden layers computed in `dtype`; parameters and output, [..., output_size], are float32.

  Writing and reading hidden activations is most of the cost of an update on a GPU. The first layer stays in float32:
  advantages are differences of neighbouring states' values, which rounded observations would blur. The actor stays in
  float32, too: the loss compares its log-probabilities with those at acting time.
  """

  hidden_layer_sizes: Sequence[int]
  activation: Callable[[jax.Array], jax.Array]
  dtype: DTypeLike
  layer_norm: bool = False
  output_size: int = 1

  @linen.compact
  def __call__(self, inputs: jax.Array) -> jax.Array:
    init, hidden = jax.nn.initializers.lecun_uniform(), inputs
    for i, size in enumerate(self.hidden_layer_sizes):
      dtype = jnp.float32 if i == 0 else self.dtype
      hidden = self.activation(linen.Dense(size, dtype=dtype, kernel_init=init, name=f"hidden_{i}")(hidden))
      if self.layer_norm:
        hidden = linen.LayerNorm(dtype=self.dtype)(hidden)
    name = f"hidden_{len(self.hidden_layer_sizes)}"
    return linen.Dense(self.output_size, dtype=jnp.float32, kernel_init=init, name=name)(hidden)


def value_dtype(name: str) -> str:
  """Returns the type of a critic's hidden activations for `agent.network.value_dtype`."""
  auto = "bfloat16" if jax.default_backend() == "gpu" else "float32"
  return auto if name == "auto" else name


class ActorCritic(Actor):
  """An actor and a value network, as PPO trains them."""

  def __init__(self, obs_size: ObservationSize, action_size: int, config: NetworkConfig, precision: str | None = None):
    """Builds the networks; see `Actor` for the arguments and errors."""
    super().__init__(obs_size, action_size, config.policy_hidden_layer_sizes, config, precision)
    self.init_std = config.init_std
    self._output = "output" if self.pixel_sizes else f"hidden_{len(config.policy_hidden_layer_sizes)}"  # of the actor
    self.value_dtype = value_dtype(config.value_dtype)
    sizes, dtype = tuple(config.value_hidden_layer_sizes), jnp.dtype(self.value_dtype)
    if self.pixel_sizes:
      self._critic = self._on_pixels(config.cnn, sizes, 1, dtype=dtype)
    else:
      self._critic = Critic(sizes, self.activation, dtype)

  def init(self, key: jax.Array) -> ActorCriticParams:
    policy, value = jax.random.split(key)
    if self.pixel_sizes:
      actor, critic = (self._seen(self._example(), key) for key in (self.policy_obs_key, self.value_obs_key))
      return ActorCriticParams(self._at_std(self._actor.init(policy, *actor)), self._critic.init(value, *critic))
    obs = jnp.zeros((1, *self.obs_sizes[self.value_obs_key]))
    return ActorCriticParams(self._at_std(self.policy_network.init(policy)), self._critic.init(value, obs))

  def _at_std(self, policy: PyTree) -> PyTree:
    """Returns a new actor whose last biases give its actions the standard deviation `init_std`."""
    if self.init_std is None:
      return policy
    layers = policy["params"]
    layer = layers[self._output]
    bias = layer["bias"].at[self.action_size :].set(math.log(math.expm1(self.init_std - MIN_STD)))  # softplus, inverted
    return {"params": layers | {self._output: layer | {"bias": bias}}}

  def value(self, value_params: PyTree, obs: Mapping[str, jax.Array]) -> jax.Array:
    """Returns state values, [...], for normalised observations."""
    with self.at_precision():
      pixels = bool(self.pixel_sizes)
      seen = self._seen(obs, self.value_obs_key) if pixels else (self._vector(obs, self.value_obs_key),)
      return self._critic.apply(value_params, *seen)[..., 0]  # pyright: ignore


class SoftActorCriticParams(struct.PyTreeNode):
  """The parameters of SAC's optimiser. The order matters: the critics come first, see `SAC.learn`.

  Attributes:
    q: parameters of the twin critics, each array [2, ...].
    policy: of the actor.
    log_alpha: logarithm of the temperature, [].
  """

  q: PyTree
  policy: PyTree
  log_alpha: jax.Array


class SoftActorCritic(Actor):
  """An actor and two action-value networks, whose layers are one batched product each.

  Attributes:
    batched: whether several evaluations of the critics are one batched product, too. That is faster on a GPU, where
      the number of kernels counts; elsewhere arithmetic counts, of which it does half as much again.
  """

  def __init__(
    self, obs_size: ObservationSize, action_size: int, config: SoftNetworkConfig, precision: str | None = None
  ):
    """Builds the networks; see `Actor` for the arguments and errors."""
    refuse_images(obs_size, "sac")
    self.batched = jax.default_backend() == "gpu"
    sizes, norm = tuple(config.hidden_layer_sizes), config.policy_network_layer_norm
    super().__init__(obs_size, action_size, sizes, config, precision, norm)
    self._critic = brax_networks.MLP([*sizes, 1], self.activation, layer_norm=config.q_network_layer_norm)

  def init(self, key: jax.Array) -> SoftActorCriticParams:
    policy, q = jax.random.split(key)
    length = math.prod(self.obs_sizes[self.value_obs_key]) + self.action_size
    q = jax.vmap(lambda key: self._critic.init(key, jnp.zeros((1, length))))(jax.random.split(q))
    return SoftActorCriticParams(q, self.policy_network.init(policy), jnp.zeros(()))

  def q(self, q_params: PyTree, obs: Mapping[str, jax.Array], action: jax.Array) -> jax.Array:
    """Returns the values of both critics, [2, ...], for normalised observations and actions [..., action_size]."""
    inputs = jnp.concatenate([obs[self.value_obs_key], action], axis=-1)
    with self.at_precision():
      return jax.vmap(self._critic.apply, (0, None))(q_params, inputs)[..., 0]  # pyright: ignore[reportIndexIssue, reportCallIssue, reportArgumentType]

  def q_each(self, *evaluations: tuple[PyTree, Mapping[str, jax.Array], jax.Array]) -> tuple[jax.Array, ...]:
    """Returns `q` of several (parameters, observations, actions), all of the same shape."""
    if not self.batched:
      return tuple(self.q(*evaluation) for evaluation in evaluations)
    return tuple(jax.vmap(self.q)(*jax.tree.map(lambda *x: jnp.stack(x), *evaluations)))


def refuse_images(obs_size: ObservationSize, agent: str) -> None:
  """Raises ConfigError for a task with images, which this agent does not read."""
  if isinstance(obs_size, Mapping) and any(key.startswith(PIXELS) for key in obs_size):
    raise ConfigError(f"agent={agent} reads no images: choose agent=ppo, or env.vision.enable=false.")


def normalize(obs: Mapping[str, jax.Array], normalizer: Normalizer | None) -> dict[str, jax.Array]:
  """Subtracts the running mean and divides by the running std; images and, with None, all groups stay."""
  if normalizer is None:
    return dict(obs)
  mean: PyTree = normalizer.mean
  std: PyTree = normalizer.std
  return {k: (v - mean[k]) / std[k] if k in mean else v for k, v in obs.items()}
