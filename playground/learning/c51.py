"""Distributional twin critics (C51; Bellemare et al., 2017), as FastTD3 and FastSAC train them."""

import math

import jax
import jax.numpy as jnp

from playground.envs.base import Env
from playground.learning.hyperparameters import C51Config
from playground.learning.networks import Actor, Critic, refuse_images, value_dtype
from playground.learning.off_policy import Transition
from playground.pytree import PyTree


class Atoms:
  """Values as distributions over evenly spaced atoms."""

  def __init__(self, low: float, high: float, count: int):
    self.low, self.high, self.step = low, high, (high - low) / (count - 1)
    self.values = jnp.linspace(low, high, count)

  def mean(self, probabilities: jax.Array) -> jax.Array:
    """Returns mean values, [...], of distributions [..., K]."""
    return (probabilities * self.values).sum(axis=-1)

  def project(self, probabilities: jax.Array, reward: jax.Array, discount: jax.Array) -> jax.Array:
    """Distributions of `reward + discount * value`, [..., K], on the atoms; beyond them it is the nearest atom.

    Args:
      probabilities: of the values, [..., K].
      reward: [...].
      discount: of the values, 0 at terminations, [...].
    """
    moved = jnp.clip(reward[..., None] + discount[..., None] * self.values, self.low, self.high)
    place = (moved - self.low) / self.step  # in atoms, [..., K]
    atoms = jnp.arange(len(self.values), dtype=jnp.float32)

    def add(source: jax.Array, total: jax.Array) -> jax.Array:
      """Adds the share that each atom gets of one atom of the value: its two neighbours get all of it."""
      take = lambda x: jax.lax.dynamic_slice_in_dim(x, source, 1, axis=-1)
      return total + take(probabilities) * jax.nn.relu(1 - jnp.abs(take(place) - atoms))

    # One after the other: [..., K, K] would be gigabytes. Eight a pass, for each pass reads and writes the total.
    return jax.lax.fori_loop(0, len(atoms), add, jnp.zeros_like(probabilities), unroll=8)


class C51Networks(Actor):
  """An actor and two distributional critics, whose layers are one batched product each."""

  def __init__(self, env: Env, config: C51Config, precision: str | None, agent: str):
    """Builds the networks; `agent` is the algorithm's name.

    Raises:
      ConfigError: a task with images, an unknown activation, or an observation group that the task does not have.
    """
    network, norm = config.network, config.network.layer_norm
    refuse_images(env.observation_size, agent)
    hidden = network.policy_hidden_layer_sizes
    super().__init__(env.observation_size, env.action_size, hidden, network, precision, norm)
    self.atoms = Atoms(config.min_value, config.max_value, config.num_atoms)
    self.value_dtype = value_dtype(network.value_dtype)
    sizes, dtype = tuple(network.q_hidden_layer_sizes), jnp.dtype(self.value_dtype)
    self._critic = Critic(sizes, self.activation, dtype, norm, config.num_atoms)
    self._output_scale = network.policy_output_scale

  def init_policy(self, key: jax.Array) -> PyTree:
    """Parameters of the actor, whose last layer is normal with standard deviation `policy_output_scale`."""
    key, output_key = jax.random.split(key)
    policy = self.policy_network.init(key)
    last = max((name for name in policy["params"] if name.startswith("hidden_")), key=lambda name: int(name[7:]))
    output = policy["params"][last]
    kernel = self._output_scale * jax.random.normal(output_key, output["kernel"].shape)
    return {"params": {**policy["params"], last: {"kernel": kernel, "bias": jnp.zeros_like(output["bias"])}}}

  def init_q(self, key: jax.Array) -> PyTree:
    """Parameters of both critics, each array [2, ...]."""
    length = math.prod(self.obs_sizes[self.value_obs_key]) + self.action_size
    return jax.vmap(lambda key: self._critic.init(key, jnp.zeros((1, length))))(jax.random.split(key))

  def q(self, q_params: PyTree, obs: dict[str, jax.Array], action: jax.Array) -> jax.Array:
    """Logits of both critics' atoms, [2, ..., K], for normalised observations."""
    inputs = jnp.concatenate([obs[self.value_obs_key], action], axis=-1)
    with self.at_precision():
      return jax.vmap(self._critic.apply, (0, None))(q_params, inputs)  # pyright: ignore


def c51_loss(
  params: PyTree,
  target_params: PyTree,
  batch: Transition,
  next_action: jax.Array,
  next_bonus: jax.Array | float,
  use_smaller_q: bool,
  networks: C51Networks,
  config: C51Config,
) -> tuple[jax.Array, tuple[jax.Array, jax.Array, jax.Array]]:
  """Cross-entropy of both critics to the projected distributions of the target critics.

  Args:
    params: the critics'.
    target_params: the target critics'.
    batch: B normalised transitions.
    next_action: on `next_obs`, [B, action_size].
    next_bonus: added to the value of `next_obs`, [B] or 0.
    use_smaller_q: whether both learn from the distribution with the smaller mean; else each from its own.
    networks: the networks the parameters belong to.
    config: `discounting`, `reward_scaling`.

  Returns:
    The loss, and loss, mean value, and share of the targets at the first and last atom.
  """
  atoms = networks.atoms
  following = jax.nn.softmax(networks.q(target_params, batch.next_obs, next_action))
  discount = config.discounting * batch.discount
  reward = config.reward_scaling * batch.reward + discount * next_bonus
  target = atoms.project(following, *jnp.broadcast_arrays(reward, discount, following[..., 0])[:2])
  if use_smaller_q:
    value = atoms.mean(target)
    target = jnp.broadcast_to(jnp.where((value[0] < value[1])[:, None], target[0], target[1]), target.shape)
  logits = networks.q(params, batch.obs, batch.action)
  cross_entropy = -(jax.lax.stop_gradient(target) * jax.nn.log_softmax(logits)).sum(axis=-1)
  loss = (cross_entropy * (1 - batch.nonfinite)).mean(axis=1).sum()
  at_edge = (target[..., 0] + target[..., -1]).mean()  # what was moved there, above all
  return loss, (loss, atoms.mean(jax.nn.softmax(logits)).mean(), at_edge)


def updates_actor(config: C51Config, index: jax.Array, step: jax.Array) -> jax.Array:
  """Whether the actor is updated after the critic update `index` of the training step `step`, []."""
  count = config.grad_updates_per_step
  first = int(count > 1 and config.policy_frequency > 1)
  return (step * count + index) % config.policy_frequency == first
