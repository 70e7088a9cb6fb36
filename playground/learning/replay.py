"""Replay: a ring of transitions on the device, of fixed size, drawn from uniformly."""

import math

import jax
import jax.numpy as jnp
from flax import struct
from jax.flatten_util import ravel_pytree
from jax.sharding import PartitionSpec as P

from playground.hardware.mesh import AXIS
from playground.pytree import PyTree


class Replay(struct.PyTreeNode):
  """What a buffer holds.

  Attributes:
    data: one row of numbers for each transition, [slots, num_envs, width]; a slot takes one step of all environments.
    inserted: steps put in so far, []; beyond `slots` they replace the oldest.
  """

  data: jax.Array
  inserted: jax.Array


# Each device keeps the transitions of its own environments.
REPLAY_SPEC = Replay(data=P(None, AXIS), inserted=P())  # pyright: ignore[reportArgumentType]


class ReplayBuffer:
  """Puts transitions in and draws them; pure functions on `Replay`, each device on its share of the environments."""

  def __init__(self, max_size: int, num_envs: int, example: PyTree, saved: bool = True):
    """Sizes an empty buffer.

    Args:
      max_size: transitions at most, rounded down to whole steps of all environments.
      num_envs: environments, over all devices.
      example: one transition, a tree of float32 arrays or their shapes.
      saved: whether the newest checkpoint holds the transitions; else a resumed run collects them anew.
    """
    self.max_size, self.saved = max_size, saved
    row, unravel = ravel_pytree(jax.tree.map(lambda x: jnp.zeros(x.shape, jnp.float32), example))
    self.slots, self.num_envs, self.width = max_size // num_envs, num_envs, row.size
    self._ravel = jax.vmap(lambda tree: ravel_pytree(tree)[0])
    self._unravel = jax.vmap(unravel)

  @property
  def size(self) -> int:
    """Transitions it can hold, over all devices."""
    return self.slots * self.num_envs

  @property
  def nbytes(self) -> int:
    """Memory of all of them, over all devices."""
    return 4 * self.size * self.width

  def init(self, num_envs: int) -> Replay:
    """An empty buffer for a device's share of the environments."""
    return Replay(jnp.zeros((self.slots, num_envs, self.width)), jnp.zeros((), jnp.int32))

  def insert(self, replay: Replay, transitions: PyTree) -> Replay:
    """Puts in one step of all environments, a tree of [num_envs, ...], in the place of the oldest if it is full."""
    rows = self._ravel(transitions)
    data = jax.lax.dynamic_update_slice_in_dim(replay.data, rows[None], replay.inserted % self.slots, 0)
    return Replay(data, replay.inserted + 1)

  def sample(self, replay: Replay, key: jax.Array, shape: tuple[int, ...]) -> PyTree:
    """Draws transitions, a tree of [*shape, ...], each of those held with the same probability."""
    rows = replay.data.reshape(-1, self.width)
    held = self.held(replay) * replay.data.shape[1]
    drawn = jax.random.randint(key, (math.prod(shape),), 0, held)
    transitions = self._unravel(rows.at[drawn].get(mode="promise_in_bounds"))
    return jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), transitions)

  def sample_windows(self, replay: Replay, key: jax.Array, shape: tuple[int, ...], length: int) -> PyTree:
    """Draws successive transitions of one environment each, a tree of [length, *shape, ...].

    All that are held whole have the same probability; there must be one: no window crosses the newest transition.
    """
    slots, num_envs = replay.data.shape[:2]
    start_key, env_key = jax.random.split(key)
    held = self.held(replay)
    oldest = jnp.where(replay.inserted > slots, replay.inserted % slots, 0)
    start = oldest + jax.random.randint(start_key, (math.prod(shape),), 0, held - length + 1)
    env = jax.random.randint(env_key, (math.prod(shape),), 0, num_envs)
    rows = replay.data[(start + jnp.arange(length)[:, None]) % slots, env]
    transitions = self._unravel(rows.reshape(-1, self.width))
    return jax.tree.map(lambda x: x.reshape(length, *shape, *x.shape[1:]), transitions)

  def held(self, replay: Replay) -> jax.Array:
    """Slots in use, []: the first ones."""
    return jnp.minimum(replay.inserted, self.slots)
