"""Termination terms of arms at a table, each a bool of shape []."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from playground.limits import Share
from playground.mdp.context import StepContext
from playground.mdp.manipulators import ArmContext

Bounds = Sequence[float | None]


def body_out_of_bounds(c: ArmContext, body: str, low: Bounds, high: Bounds) -> jax.Array:
  """A body's x, y or z is below `low` or above `high`, m; null is no bound."""
  return _outside(c.body_pos(body), low, high)


def site_out_of_bounds(c: ArmContext, site: str, low: Bounds, high: Bounds) -> jax.Array:
  """A site's x, y or z is below `low` or above `high`, m; null is no bound."""
  return _outside(c.site_pos(site), low, high)


def illegal_contact(c: ArmContext, geoms: Sequence[str]) -> jax.Array:
  """A contact sensor of one of the geoms sees a contact."""
  return jnp.concatenate([c.robot.touching(c.data, geom) for geom in geoms]).any()


def joint_pos_out_of_soft_limits(c: StepContext, soft_limit_factor: Share) -> jax.Array:
  """Some joint is outside its range shrunk about its centre by the factor."""
  lower, upper = c.robot.joint_range
  centre, reach = (lower + upper) / 2, (upper - lower) / 2 * soft_limit_factor
  return ((c.joint_pos < centre - reach) | (c.joint_pos > centre + reach)).any()


def object_at_goal(c: ArmContext) -> jax.Array:
  """The object is at the goal."""
  return c.at_goal


def _outside(position: jax.Array, low: Bounds, high: Bounds) -> jax.Array:
  lower = np.array([-np.inf if bound is None else bound for bound in low])
  upper = np.array([np.inf if bound is None else bound for bound in high])
  return ((position < lower) | (position > upper)).any()
