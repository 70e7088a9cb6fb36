"""Reasons to end an episode. A new one is a function here and its name and threshold in `env.termination`.

A threshold of null switches the reason off.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from playground.mdp.legged import Context


def fall(c: Context, threshold: float) -> jax.Array:
  """The base's upward axis points below `threshold` (its world z; 0 is lying on the side). Paper: inverted."""
  return c.sensor("upvector")[2] < threshold


def power(c: Context, threshold: float) -> jax.Array:
  """The motors' power, sum |tau_j qd_j|, is above `threshold` W. Paper: 400 W, then down to 200 W."""
  return jnp.abs(c.data.actuator_force * c.joint_vel).sum() > threshold


def joint_limits(c: Context, threshold: float) -> jax.Array:
  """Some joint is more than `threshold` rad outside its range."""
  lower, upper = c.robot.joint_range
  return ((c.joint_pos < lower - threshold) | (c.joint_pos > upper + threshold)).any()


def target_limits(c: Context, threshold: float) -> jax.Array:
  """Some joint is more than `threshold` rad outside the range of its targets."""
  lower, upper = c.robot.target_range
  return ((c.joint_pos < lower - threshold) | (c.joint_pos > upper + threshold)).any()


def low(c: Context, threshold: float) -> jax.Array:
  """The base site is less than `threshold` m above the world's z = 0."""
  return c.base_height < threshold


def fatal_contact(c: Context, threshold: float) -> jax.Array:
  """More than `threshold` of the contacts between the robot's parts that its `fatal_contact` names."""
  return c.robot.touching(c.data, "fatal_contact").sum() > threshold


TERMINATIONS: dict[str, Callable[[Context, float], jax.Array]] = {
  "fall": fall,
  "power": power,
  "joint_limits": joint_limits,
  "target_limits": target_limits,
  "low": low,
  "fatal_contact": fatal_contact,
}
