"""Termination terms: reasons to end an episode, each a bool of shape []."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from playground.errors import ConfigError
from playground.limits import AtLeast0, Limit, Share
from playground.mdp.context import StepContext, root_qpos
from playground.mdp.legged import LeggedContext
from playground.mdp.manipulators import ArmContext, HandContext
from playground.text import format_value

Bounds = Sequence[float | None]


def nonfinite_state(c: StepContext) -> jax.Array:
  """Some position or velocity is not a finite number."""
  return ~(jnp.isfinite(c.data.qpos).all() & jnp.isfinite(c.data.qvel).all())


def upvector_below(c: LeggedContext, limit: float) -> jax.Array:
  """The world z of the base's upward axis is below the limit; 0 is lying on the side. Paper: inverted."""
  return c.sensor("upvector")[2] < limit


def power_above(c: StepContext, limit: AtLeast0) -> jax.Array:
  """The actuators' power, sum |tau_j qd_j|, is above the limit, W. Paper: 400 W, then down to 200 W."""
  return jnp.abs(c.data.actuator_force * c.joint_vel).sum() > limit


def joint_pos_out_of_limit(c: StepContext, margin: AtLeast0 = 0.0) -> jax.Array:
  """Some joint is more than the margin outside its range, rad."""
  lower, upper = c.robot.joint_range
  return ((c.joint_pos < lower - margin) | (c.joint_pos > upper + margin)).any()


def joint_pos_out_of_soft_limits(c: StepContext, soft_limit_factor: Share) -> jax.Array:
  """Some joint is outside its range shrunk about its centre by the factor."""
  lower, upper = c.robot.joint_range
  centre, reach = (lower + upper) / 2, (upper - lower) / 2 * soft_limit_factor
  return ((c.joint_pos < centre - reach) | (c.joint_pos > centre + reach)).any()


def joint_pos_out_of_target_range(c: LeggedContext, margin: AtLeast0 = 0.0) -> jax.Array:
  """Some joint is more than the margin outside the range of its targets, rad."""
  lower, upper = c.robot.target_range
  return ((c.joint_pos < lower - margin) | (c.joint_pos > upper + margin)).any()


def base_height_below(c: LeggedContext, limit: float) -> jax.Array:
  """The base site is less than the limit above the world's z = 0, m."""
  return c.base_height < limit


def terrain_out_of_bounds(c: LeggedContext, distance_buffer: AtLeast0 = 1.0) -> jax.Array:
  """The base is nearer to the edge of the terrain's height field than the buffer, m, or beyond; never on flat ground.

  With `time_out: true` a robot that reaches the edge has not fallen (Isaac Lab).
  """
  model = c.robot.mj_model
  field = model.geom_dataid[c.robot.find("geom", "floor")]
  if field < 0:
    return jnp.array(False)
  return (jnp.abs(root_qpos(c)[:2]) > model.hfield_size[field, :2] - distance_buffer).any()


def fatal_contact(c: LeggedContext, count: int = 0) -> jax.Array:
  """There are more than `count` of the contacts that `fatal_contact` of the robot's YAML lists."""
  return c.robot.touching(c.data, "fatal_contact").sum() > count


def leg_contact(c: LeggedContext) -> jax.Array:
  """A part of a supporting leg other than its foot touches the floor (task Stand)."""
  return c.robot.touching(c.data, "leg_contact").any()


def cube_height_below(c: HandContext, limit: float) -> jax.Array:
  """The cube's centre is below the limit, world z, m."""
  return c.sensor("cube_position")[2] < limit


def body_out_of_bounds(c: ArmContext, body: str, low: Bounds, high: Bounds) -> jax.Array:
  """A body's x, y or z is below `low` or above `high`, m; null is no bound."""
  return _outside(c.body_pos(body), low, high)


def site_out_of_bounds(c: ArmContext, site: str, low: Bounds, high: Bounds) -> jax.Array:
  """A site's x, y or z is below `low` or above `high`, m; null is no bound."""
  return _outside(c.site_pos(site), low, high)


def illegal_contact(c: ArmContext, geoms: Sequence[str]) -> jax.Array:
  """A contact sensor of one of the geoms reports a contact."""
  return jnp.concatenate([c.robot.touching(c.data, geom) for geom in geoms]).any()


def object_at_goal(c: ArmContext) -> jax.Array:
  """The object is at the goal."""
  return c.at_goal


def _outside(position: jax.Array, low: Bounds, high: Bounds) -> jax.Array:
  is_bound = lambda bound: bound is None or Limit().allows(bound)
  if not all(isinstance(end, list | tuple) and len(end) == 3 and all(map(is_bound, end)) for end in (low, high)):
    given = f"low={format_value(low)} and high={format_value(high)}"
    raise ConfigError(f"{given} must have a number or null for each of x, y and z.")
  lower = np.array([-np.inf if bound is None else bound for bound in low])
  upper = np.array([np.inf if bound is None else bound for bound in high])
  return ((position < lower) | (position > upper)).any()
