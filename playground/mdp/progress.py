"""Rewards that pay for progress alone: staying at a place, or going back and forth, earns nothing."""

import jax
import jax.numpy as jnp


def progress(potential: jax.Array, best: jax.Array) -> tuple[jax.Array, jax.Array]:
  """What a potential gains over its best so far in the episode.

  Args:
    potential: of the present state, any shape.
    best: the highest before it; at the start of an episode that of the start, or 0.

  Returns:
    The gain, 0 where the best stays unsurpassed, and the new best.
  """
  return jnp.maximum(potential - best, 0.0), jnp.maximum(potential, best)
