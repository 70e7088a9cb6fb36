"""Reward terms of joints and motors: where they are, how they move, what they spend (see `rewards.py`)."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp

from playground.mdp.legged import Context

SIDEWAYS = 0.1  # m/s: a command to the side above it lets the hips roll


def dof_pos_limits(c: Context, soft_limit_factor: float) -> jax.Array:
  """Sum over joints of how far q lies outside the soft limits: the range shrunk about its centre by the factor."""
  lower, upper = c.robot.joint_range
  centre, reach = (lower + upper) / 2, (upper - lower) / 2 * soft_limit_factor
  return _outside(c.joint_pos, centre - reach, centre + reach)


def dof_pos_limits_scaled(c: Context, soft_limit_factor: float) -> jax.Array:
  """As `dof_pos_limits`, with the limits themselves times the factor.

  A slip of Playground 0.2.0's Go1 joystick. It widens a range at any limit whose sign is the inner side's: the Go1's
  knee may go up to -0.844, where the hard limit is -0.888.
  """
  lower, upper = c.robot.joint_range * soft_limit_factor
  return _outside(c.joint_pos, lower, upper)


def _outside(x: jax.Array, lower: jax.Array, upper: jax.Array) -> jax.Array:
  return (jnp.maximum(lower - x, 0) + jnp.maximum(x - upper, 0)).sum()


def pose(c: Context, pose_weights: Sequence[float]) -> jax.Array:
  """exp(-sum_j weight_j (q_j - default_j)²). (Paper: no weights, exp(-|q - default|²).)"""
  return jnp.exp(-pose_deviation(c, pose_weights))


def pose_deviation(c: Context, pose_weights: Sequence[float]) -> jax.Array:
  """Sum_j weight_j (q_j - default_j)². (Paper: `pose` without weights.)"""
  return (jnp.square(c.pose_error) * jnp.array(pose_weights)).sum()


def pose_deviation_by_command(c: Context, pose_weights: Sequence[float]) -> jax.Array:
  """As `pose_deviation`; all joints weigh 1 while standing still; hip rolls weigh 0.01 above 0.3 m/s sideways, else 1.

  (Playground 0.2.0, Apollo.)
  """
  weights = jnp.where(c.still, 1.0, jnp.array(pose_weights))
  weights = weights.at[c.robot.joints("hip_rolls")].set(jnp.where(jnp.abs(c.command[1]) > 0.3, 0.01, 1.0))
  return (jnp.square(c.pose_error) * weights).sum()


def pose_when_still(c: Context, pose_sharpness: float) -> jax.Array:
  """exp(-sharpness |q - default|²) while told to stand still, else 1."""
  return jnp.exp(-pose_sharpness * jnp.square(c.pose_error).sum() * c.still)


def hip_splay(c: Context) -> jax.Array:
  """Sum (q - default)² over the hips."""
  return jnp.square(c.pose_error[c.robot.joints("hips")]).sum()


def stand_still(c: Context) -> jax.Array:
  """Sum |q - default|, to be weighed while the command is to stand still. (Paper: k |command_xy|.)"""
  return jnp.abs(c.pose_error).sum()


def stand_still_unless_left(c: Context) -> jax.Array:
  """As `stand_still`, whenever command_y / |command_xy| < 0.1, however large the command is.

  A slip of Playground 0.2.0's Barkour: of (direction, norm) it takes the direction's second component for the norm.
  """
  return stand_still(c) * (c.command[1] / jnp.linalg.norm(c.command[:2]) < 0.1)


def joint_deviation_knee(c: Context) -> jax.Array:
  """Sum |q - default| over the knees."""
  return jnp.abs(c.pose_error[c.robot.joints("knees")]).sum()


def joint_deviation_hip(c: Context) -> jax.Array:
  """Sum |q - default| over hip rolls and yaws; rolls are free while the command is sideways, |command_y| > 0.1 m/s."""
  hips, rolls = (jnp.abs(c.pose_error[c.robot.joints(group)]).sum() for group in ("hips", "hip_rolls"))
  return hips - rolls * (jnp.abs(c.command[1]) > SIDEWAYS)


def joint_deviation_hip_sideways(c: Context) -> jax.Array:
  """Sum |q - default| over hip rolls and yaws, but only while |command_y| > 0.1 m/s.

  A slip of Playground 0.2.0's Berkeley Humanoid and T1: it lets the hips go where they should not.
  """
  return jnp.abs(c.pose_error[c.robot.joints("hips")]).sum() * (jnp.abs(c.command[1]) > SIDEWAYS)


def joint_deviation_hip_crossed(c: Context) -> jax.Array:
  """Sum |q - default| over hip rolls and yaws, times 2 while command_y > 0.1 m/s, else 4.

  A slip of Playground 0.2.0's G1: the weights of four joints (their sum is 4; without rolls 2) multiply every joint.
  """
  weight = jnp.where(c.command[1] > SIDEWAYS, 2.0, 4.0)
  return weight * jnp.abs(c.pose_error[c.robot.joints("hips")]).sum()


def torques(c: Context) -> jax.Array:
  """|tau|_2 + |tau|_1. (Paper: |tau|².)"""
  return jnp.linalg.norm(c.data.actuator_force) + torques_sum(c)


def torques_sum(c: Context) -> jax.Array:
  """|tau|_1. (Paper: |tau|².)"""
  return jnp.abs(c.data.actuator_force).sum()


def torques_squared(c: Context) -> jax.Array:
  """|tau|², as in the paper."""
  return jnp.square(c.data.actuator_force).sum()


def energy(c: Context) -> jax.Array:
  """Sum |qd_j| |tau_j|, W. (Paper: |qd * tau|.)"""
  return (jnp.abs(c.joint_vel) * jnp.abs(c.data.actuator_force)).sum()


def energy_share(c: Context) -> jax.Array:
  """Sum |qd_j| |tau_j| / limit_j, rad/s, with the joints' limits of torque."""
  return jnp.abs(c.joint_vel * c.data.actuator_force / c.robot.torque_limits).sum()


def action_rate(c: Context) -> jax.Array:
  """|action - last action|²."""
  return jnp.square(c.action - c.kept("last_act")).sum()


def action_rate_and_change(c: Context) -> jax.Array:
  """|a - a1|² + |a - 2 a1 + a2|², with a1 and a2 the last action and the one before: first and second difference."""
  last, before = c.kept("last_act"), c.kept("last_last_act")
  return jnp.square(c.action - last).sum() + jnp.square(c.action - 2 * last + before).sum()


def action_rate_and_change_lagged(c: Context) -> jax.Array:
  """|a1 - a2|² + |a1 - 2 a2 + a|²: a slip of Playground 0.2.0's H1, which mixes up the order of the actions."""
  last, before = c.kept("last_act"), c.kept("last_last_act")
  return jnp.square(last - before).sum() + jnp.square(last - 2 * before + c.action).sum()


def action_size(c: Context) -> jax.Array:
  """|action|²."""
  return jnp.square(c.action).sum()


def dof_acc(c: Context) -> jax.Array:
  """|qdd|², of the joints."""
  return jnp.square(c.data.qacc[6:]).sum()


def dof_vel(c: Context) -> jax.Array:
  """|qd|², of the joints."""
  return jnp.square(c.joint_vel).sum()


def dof_vel_excess(c: Context, max_joint_vel: float) -> jax.Array:
  """Sum max(|qd_j| - max, 0)², rad²/s²."""
  return jnp.square(jnp.maximum(jnp.abs(c.joint_vel) - max_joint_vel, 0.0)).sum()


JOINTS: dict[str, Callable[..., jax.Array]] = {
  f.__name__: f
  for f in (
    dof_pos_limits, dof_pos_limits_scaled, pose, pose_deviation, pose_deviation_by_command, pose_when_still, hip_splay,
    stand_still, stand_still_unless_left, joint_deviation_knee, joint_deviation_hip, joint_deviation_hip_sideways,
    joint_deviation_hip_crossed, torques, torques_sum, torques_squared, energy, energy_share, action_rate,
    action_rate_and_change, action_rate_and_change_lagged, action_size, dof_acc, dof_vel, dof_vel_excess,
  )
}  # fmt: skip
