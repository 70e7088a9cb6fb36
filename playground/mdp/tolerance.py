"""DM Control's building block of rewards: how near a number is to where it should be, in [0, 1]."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp

from playground.errors import lookup

# S(distance; value), with S(0) = 1 and S(1) = value.
Sigmoid = Callable[[jax.Array, float], jax.Array]


def _cut(distance: jax.Array, fall: Callable[[jax.Array], jax.Array]) -> jax.Array:
  """Returns `fall` of a scaled distance, and 0 from a scaled distance of 1 on."""
  return jnp.where(jnp.abs(distance) < 1, fall(distance), 0.0)


SIGMOIDS: dict[str, Sigmoid] = {
  "gaussian": lambda d, v: jnp.exp(-0.5 * jnp.square(d * math.sqrt(-2 * math.log(v)))),
  "hyperbolic": lambda d, v: 1 / jnp.cosh(d * math.acosh(1 / v)),
  "long_tail": lambda d, v: 1 / (jnp.square(d * math.sqrt(1 / v - 1)) + 1),
  "reciprocal": lambda d, v: 1 / (jnp.abs(d) * (1 / v - 1) + 1),
  "cosine": lambda d, v: _cut(d * math.acos(2 * v - 1) / math.pi, lambda s: (1 + jnp.cos(math.pi * s)) / 2),
  "linear": lambda d, v: _cut(d * (1 - v), lambda s: 1 - s),
  "quadratic": lambda d, v: _cut(d * math.sqrt(1 - v), lambda s: 1 - jnp.square(s)),
  "tanh_squared": lambda d, v: 1 - jnp.square(jnp.tanh(d * math.atanh(math.sqrt(1 - v)))),
}
_MAY_REACH_ZERO = ("cosine", "linear", "quadratic")


def tolerance(
  x: jax.Array,
  bounds: tuple[float, float] = (0.0, 0.0),
  margin: float = 0.0,
  sigmoid: str = "gaussian",
  value_at_margin: float = 0.1,
) -> jax.Array:
  """Returns 1 where `x` lies within `bounds` (inclusive), falling with the distance to them. Elementwise.

  The same family as `dm_control.utils.rewards.tolerance` (Tassa et al. 2018).

  Args:
    x: any shape.
    bounds: (lower, upper), either may be infinite.
    margin: the distance at which the result is `value_at_margin`; 0 makes it 0 everywhere outside.
    sigmoid: shape of the fall, a key of `SIGMOIDS`.
    value_at_margin: in [0, 1) for cosine, linear and quadratic, in (0, 1) for the others.

  Raises:
    ValueError: bounds in the wrong order, a negative margin, an unknown sigmoid or a value out of its range.
  """
  lower, upper = bounds
  if lower > upper:
    raise ValueError(f"tolerance: lower bound {lower} is above upper bound {upper}.")
  if margin < 0:
    raise ValueError(f"tolerance: margin={margin} is negative.")
  inside = (lower <= x) & (x <= upper)
  if margin == 0:
    return jnp.where(inside, 1.0, jnp.zeros_like(x))
  fall = lookup(SIGMOIDS, sigmoid, "tolerance: sigmoid")
  lowest_allowed = value_at_margin >= 0 if sigmoid in _MAY_REACH_ZERO else value_at_margin > 0
  if not (lowest_allowed and value_at_margin < 1):
    allowed = "[0, 1)" if sigmoid in _MAY_REACH_ZERO else "(0, 1)"
    raise ValueError(f"tolerance: value_at_margin={value_at_margin} must lie in {allowed} for {sigmoid!r}.")
  distance = jnp.where(x < lower, lower - x, x - upper) / margin
  # Inside the bounds the distance is negative, where a sigmoid may not be defined: keep its gradient finite.
  return jnp.where(inside, 1.0, fall(jnp.where(inside, 0.0, distance), value_at_margin))
