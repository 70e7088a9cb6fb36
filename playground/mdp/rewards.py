"""Reward terms of legged robots, and DM Control's `tolerance` (in `tolerance.py`).

A term is a function of a `Context` and of the keys of `env.reward` that its keyword arguments name; a new one is a
function here and a weight in `env.reward.scales`. Formulas are those of Playground 0.2.0, on which the published
weights were tuned; where the paper (appendix "Locomotion", reward functions) writes another, the term says so.
"""

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from playground.errors import ConfigError, nearest
from playground.mdp.legged import Context
from playground.mdp.lookup import lookup

STILL = 0.01  # a command whose norm is below asks to stand still
Term = Callable[[Context], jax.Array]


def bind(config: Any, functions: Mapping[str, Callable[..., jax.Array]]) -> dict[str, tuple[float, Term]]:
  """Chooses and parametrises terms.

  Args:
    config: `env.reward`: `scales` (weight by name) and the terms' parameters.
    functions: the terms to choose from, by name.

  Returns:
    (weight, term) by name, without those of weight 0.

  Raises:
    UnknownNameError: a weight for a term that does not exist.
    ConfigError: a term's parameter is missing.
  """
  bound = {}
  for name in config.scales:
    function = lookup(functions, name, "env.reward.scales")
    parameters = {}
    for parameter in list(inspect.signature(function).parameters)[1:]:
      if parameter not in config:
        raise ConfigError(f"env.reward.{parameter} is missing: term {name!r} needs it.{nearest(parameter, config)}")
      parameters[parameter] = config[parameter]
    bound[name] = (config.scales[name], _with_parameters(function, parameters))
  return {name: (weight, term) for name, (weight, term) in bound.items() if weight != 0}


def _with_parameters(function: Callable[..., jax.Array], parameters: dict[str, Any]) -> Term:
  return lambda c: function(c, **parameters)


def tracking_lin_vel(c: Context, tracking_sigma: float) -> jax.Array:
  """exp(-|command_xy - v_xy|² / sigma), v the base's velocity in its own frame."""
  error = jnp.square(c.command[:2] - c.sensor("linvel")[:2]).sum()
  return jnp.exp(-error / tracking_sigma)


def tracking_ang_vel(c: Context, tracking_sigma: float) -> jax.Array:
  """exp(-(command_yaw - w_z)² / sigma), w the gyro's reading."""
  return jnp.exp(-jnp.square(c.command[2] - c.sensor("gyro")[2]) / tracking_sigma)


def lin_vel_z(c: Context) -> jax.Array:
  """v_z², v the base's velocity in the world frame."""
  return jnp.square(c.sensor("global_linvel")[2])


def ang_vel_xy(c: Context) -> jax.Array:
  """w_x² + w_y², w the base's angular velocity in the world frame."""
  return jnp.square(c.sensor("global_angvel")[:2]).sum()


def orientation(c: Context) -> jax.Array:
  """up_x² + up_y², up the base's upward axis in the world frame."""
  return jnp.square(c.sensor("upvector")[:2]).sum()


def dof_pos_limits(c: Context, soft_limit_factor: float) -> jax.Array:
  """Sum over joints of how far q lies outside the soft limits: the range shrunk about its centre by the factor."""
  lower, upper = c.robot.joint_range
  centre, reach = (lower + upper) / 2, (upper - lower) / 2 * soft_limit_factor
  return _outside(c.joint_pos, centre - reach, centre + reach)


def dof_pos_limits_scaled(c: Context, soft_limit_factor: float) -> jax.Array:
  """As `dof_pos_limits`, with the limits themselves times the factor.

  Playground 0.2.0's Go1 joystick. It widens a range at any limit whose sign is the inner side's: the Go1's knee may go
  up to -0.844, where the hard limit is -0.888.
  """
  lower, upper = c.robot.joint_range * soft_limit_factor
  return _outside(c.joint_pos, lower, upper)


def _outside(x: jax.Array, lower: jax.Array, upper: jax.Array) -> jax.Array:
  return (jnp.maximum(lower - x, 0) + jnp.maximum(x - upper, 0)).sum()


def pose(c: Context, pose_weights: list[float] | None) -> jax.Array:
  """exp(-sum_j weight_j (q_j - default_j)²); None weighs all joints 1. (Paper: no weights, exp(-|q - default|²).)"""
  error = jnp.square(c.joint_pos - c.robot.default_pose)
  return jnp.exp(-(error if pose_weights is None else error * jnp.array(pose_weights)).sum())


def termination(c: Context) -> jax.Array:
  """1 in the step that terminates the episode."""
  return c.done.astype(jnp.float32)


def stand_still(c: Context) -> jax.Array:
  """Sum |q - default| while the command is to stand still. (Paper: k |command_xy|.)"""
  return jnp.abs(c.joint_pos - c.robot.default_pose).sum() * (jnp.linalg.norm(c.command) < STILL)


def torques(c: Context) -> jax.Array:
  """|tau|_2 + |tau|_1. (Paper: |tau|².)"""
  return jnp.linalg.norm(c.data.actuator_force) + jnp.abs(c.data.actuator_force).sum()


def action_rate(c: Context) -> jax.Array:
  """|action - last action|²."""
  return jnp.square(c.action - c.info["last_act"]).sum()


def energy(c: Context) -> jax.Array:
  """Sum |qd_j| |tau_j|, W. (Paper: |qd * tau|.)"""
  return (jnp.abs(c.joint_vel) * jnp.abs(c.data.actuator_force)).sum()


def feet_clearance(c: Context, max_foot_height: float) -> jax.Array:
  """Sum over feet of |z - height| sqrt(|v_xy|): a moving foot should be at swing height. (Paper: (z - height)².)"""
  speed = jnp.linalg.norm(c.feet_velocity[:, :2], axis=-1)
  return (jnp.abs(c.feet_height - max_foot_height) * jnp.sqrt(speed)).sum()


def feet_height(c: Context, max_foot_height: float) -> jax.Array:
  """Sum over feet that touch down of (peak / height - 1)², peak the highest z of the swing; 0 when standing."""
  error = jnp.square(c.info["swing_peak"] / max_foot_height - 1)
  return (error * c.first_contact).sum() * _moving(c)


def feet_slip(c: Context) -> jax.Array:
  """Sum over feet in contact of |v_xy|²; 0 when standing."""
  return (jnp.square(c.feet_velocity[:, :2]).sum(axis=-1) * c.contact).sum() * _moving(c)


def feet_air_time(c: Context, min_air_time: float) -> jax.Array:
  """Sum over feet that touch down of air time - min, s; 0 when standing. (Paper: clipped to [0, max - min].)"""
  return ((c.info["feet_air_time"] - min_air_time) * c.first_contact).sum() * _moving(c)


def _moving(c: Context) -> jax.Array:
  return jnp.linalg.norm(c.command) > STILL


REWARDS: dict[str, Callable[..., jax.Array]] = {
  f.__name__: f
  for f in (
    tracking_lin_vel, tracking_ang_vel, lin_vel_z, ang_vel_xy, orientation, dof_pos_limits, pose, termination,
    stand_still, torques, action_rate, energy, feet_clearance, feet_height, feet_slip, feet_air_time,
  )
}  # fmt: skip
# Playground 0.2.0's slips, for `env.parity=true`.
PARITY_REWARDS = REWARDS | {"dof_pos_limits": dof_pos_limits_scaled}
