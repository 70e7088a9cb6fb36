"""Replay: a ring of transitions on the device, of fixed size, drawn from uniformly."""

import functools
import math

import jax
import jax.numpy as jnp
from flax import struct
from jax.flatten_util import ravel_pytree
from jax.sharding import PartitionSpec as P
from jax.typing import DTypeLike

from playground.hardware.mesh import AXIS
from playground.pytree import PyTree


class Replay(struct.PyTreeNode):
  """The content of a buffer.

  Attributes:
    data: one row for each transition, [slots, num_envs, columns]; a slot takes one step of all environments. A column
      is a float32 number or, in a buffer of bfloat16, the 16 bits of one or half of those of a float32.
    inserted: steps inserted so far, []; beyond `slots` they replace the oldest.
  """

  data: jax.Array
  inserted: jax.Array


# Each device keeps the transitions of its own environments.
REPLAY_SPEC = Replay(data=P(None, AXIS), inserted=P())  # pyright: ignore[reportArgumentType]


class ReplayBuffer:
  """Inserts and samples transitions; pure functions on `Replay`, each device on its share of the environments."""

  def __init__(self, max_size: int, num_envs: int, example: PyTree, saved: bool = True, dtype: DTypeLike = jnp.float32):
    """Computes the size of the buffer.

    Args:
      max_size: largest number of transitions, rounded down to whole steps of all environments.
      num_envs: environments, over all devices.
      example: one transition, a tree of float32 arrays or their shapes.
      saved: whether the newest checkpoint holds the transitions; else a resumed run starts with an empty buffer.
      dtype: float32, or bfloat16 to keep arrays at half of the memory; single numbers (rewards, flags) stay float32.
    """
    self.max_size, self.saved = max_size, saved
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, jnp.float32), example)
    row, unravel = ravel_pytree(zeros)
    self.slots, self.num_envs, self.width = max_size // num_envs, num_envs, row.size
    ravel = lambda tree: ravel_pytree(tree)[0]
    if jnp.dtype(dtype) == jnp.bfloat16:
      ravel, unravel = _bits, functools.partial(_from_bits, zeros)
    self._row = jax.eval_shape(ravel, zeros)
    self._ravel, self._unravel = jax.vmap(ravel), jax.vmap(unravel)

  @property
  def size(self) -> int:
    """Returns the capacity in transitions, over all devices."""
    return self.slots * self.num_envs

  @property
  def nbytes(self) -> int:
    """Returns the memory of the full buffer, over all devices, bytes."""
    return self.size * self._row.size * self._row.dtype.itemsize

  def init(self, num_envs: int) -> Replay:
    """Returns an empty buffer for a device's share of the environments."""
    return Replay(jnp.zeros((self.slots, num_envs, *self._row.shape), self._row.dtype), jnp.zeros((), jnp.int32))

  def insert(self, replay: Replay, transitions: PyTree) -> Replay:
    """Inserts one step of all environments, a tree of [num_envs, ...]; a full buffer drops the oldest."""
    rows = self._ravel(transitions)
    data = jax.lax.dynamic_update_slice_in_dim(replay.data, rows[None], replay.inserted % self.slots, 0)
    return Replay(data, replay.inserted + 1)

  def sample(self, replay: Replay, key: jax.Array, shape: tuple[int, ...]) -> PyTree:
    """Draws stored transitions uniformly, a tree of [*shape, ...]."""
    rows = replay.data.reshape(-1, *self._row.shape)
    held = self.held(replay) * replay.data.shape[1]
    drawn = jax.random.randint(key, (math.prod(shape),), 0, held)
    transitions = self._unravel(rows.at[drawn].get(mode="promise_in_bounds"))
    return jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), transitions)

  def sample_windows(self, replay: Replay, key: jax.Array, shape: tuple[int, ...], length: int) -> PyTree:
    """Draws successive transitions of one environment each, a tree of [length, *shape, ...].

    All complete windows have the same probability, and there must be one; no window crosses the newest transition.
    """
    slots, num_envs = replay.data.shape[:2]
    start_key, env_key = jax.random.split(key)
    held = self.held(replay)
    oldest = jnp.where(replay.inserted > slots, replay.inserted % slots, 0)
    start = oldest + jax.random.randint(start_key, (math.prod(shape),), 0, held - length + 1)
    env = jax.random.randint(env_key, (math.prod(shape),), 0, num_envs)
    rows = replay.data[(start + jnp.arange(length)[:, None]) % slots, env]
    transitions = self._unravel(rows.reshape(-1, *self._row.shape))
    return jax.tree.map(lambda x: x.reshape(length, *shape, *x.shape[1:]), transitions)

  def held(self, replay: Replay) -> jax.Array:
    """Returns the number of used slots, which are the first ones, []."""
    return jnp.minimum(replay.inserted, self.slots)


def _bits(tree: PyTree) -> jax.Array:
  """Encodes one transition as 16-bit words, [columns]: arrays rounded to bfloat16, single numbers as float32."""
  leaves = [x.astype(jnp.bfloat16) if x.ndim else x for x in jax.tree.leaves(tree)]
  return jnp.concatenate([jax.lax.bitcast_convert_type(x, jnp.uint16).ravel() for x in leaves])


def _from_bits(example: PyTree, words: jax.Array) -> PyTree:
  """Decodes words to the float32 transition, of the structure and shapes of `example`."""
  leaves, structure = jax.tree.flatten(example)
  found, start = [], 0
  for leaf in leaves:
    count, shape, dtype = (leaf.size, leaf.shape, jnp.bfloat16) if leaf.ndim else (2, (2,), jnp.float32)
    part = words[start : start + count].reshape(shape)
    found.append(jax.lax.bitcast_convert_type(part, dtype).astype(jnp.float32))
    start += count
  return jax.tree.unflatten(structure, found)
