"""Delays of sensors and motors: the last values of a signal, and the one that arrives now.

A buffer is an array [steps, ...], newest first, which a task keeps in its `info`; to delay by d steps it needs d + 1.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp


def start(value: jax.Array, steps: int) -> jax.Array:
  """A buffer of `steps` values that are all `value`, as if the signal had been so for long: shape [steps, ...]."""
  return jnp.broadcast_to(value, (steps, *value.shape))


def push(buffer: jax.Array, value: jax.Array) -> jax.Array:
  """The buffer with `value` as its newest; the oldest goes."""
  return jnp.concatenate([value[None].astype(buffer.dtype), buffer[:-1]])


def draw_delay(key: jax.Array, bounds: Sequence[int]) -> jax.Array:
  """A whole number of steps in [bounds[0], bounds[1]], both ends included."""
  low, high = bounds
  return jax.random.randint(key, (), low, high + 1)


def delayed(buffer: jax.Array, steps: int | jax.Array) -> jax.Array:
  """The value of `steps` steps ago; 0 is the newest, and beyond the buffer's end it is the oldest."""
  return buffer[jnp.minimum(steps, len(buffer) - 1)]
