"""Reasons to end an episode. A new one is a function here and its name and threshold in `env.termination`."""

from collections.abc import Callable

import jax

from playground.mdp.legged import Context


def fall(c: Context, threshold: float) -> jax.Array:
  """The base's upward axis points below `threshold` (its world z; 0 is lying on the side). Paper: inverted."""
  return c.sensor("upvector")[2] < threshold


TERMINATIONS: dict[str, Callable[[Context, float], jax.Array]] = {"fall": fall}
