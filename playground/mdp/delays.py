"""Delays of sensors and motors: buffers of the last values of a signal.

A buffer is an array [steps, ...], newest first, in the `info` of a task; a delay of d steps needs d + 1 entries.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp


def start(value: jax.Array, steps: int) -> jax.Array:
  """Returns a buffer of `steps` values, all of them `value`, as of a constant signal: shape [steps, ...]."""
  return jnp.broadcast_to(value, (steps, *value.shape))


def push(buffer: jax.Array, value: jax.Array) -> jax.Array:
  """Returns the buffer with `value` as its newest entry and without its oldest."""
  return jnp.concatenate([value[None].astype(buffer.dtype), buffer[:-1]])


def draw_delay(key: jax.Array, bounds: Sequence[int]) -> jax.Array:
  """Draws a whole number of steps in [bounds[0], bounds[1]], both ends included."""
  low, high = bounds
  return jax.random.randint(key, (), low, high + 1)


def delayed(buffer: jax.Array, steps: int | jax.Array) -> jax.Array:
  """Returns the value of `steps` steps ago; 0 is the newest, and beyond the end of the buffer it is the oldest."""
  return buffer[jnp.minimum(steps, len(buffer) - 1)]
