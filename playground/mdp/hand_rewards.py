"""Reward terms of a hand with a cube, chosen and weighed by `env.reward` (see `rewards.bind`).

Formulas are those of Playground 0.2.0 (paper, Appendix C.4).
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp

from playground.mdp.hands import Context
from playground.mdp.rotations import angle_between
from playground.mdp.tolerance import tolerance

_FULL_SPEED = 4.0  # rad/s, of a joint


def rotation_error(c: Context) -> jax.Array:
  """Angle between the cube's orientation and the goal's, rad."""
  return angle_between(c.sensor("cube_orientation"), c.sensor("cube_goal_orientation"))


def position_error(c: Context) -> jax.Array:
  """Distance of the cube from the palm, m."""
  return jnp.linalg.norm(c.sensor("palm_position") - c.sensor("cube_position"))


def orientation(c: Context) -> jax.Array:
  """1 within 0.2 rad of the goal, falling in proportion to the angle."""
  return tolerance(rotation_error(c), (0.0, 0.2), margin=math.pi, sigmoid="linear")


def position(c: Context) -> jax.Array:
  """1 within 2 cm of the palm, falling in proportion to the distance."""
  return tolerance(position_error(c), (0.0, 0.02), margin=0.05, sigmoid="linear")


def angvel(c: Context) -> jax.Array:
  """w_z, the cube's angular velocity about the world's z, with its sign."""
  return c.sensor("cube_angvel")[2]


def linvel(c: Context) -> jax.Array:
  """|v_x| + |v_y| + |v_z|, v the cube's world velocity."""
  return jnp.abs(c.sensor("cube_linvel")).sum()


def termination(c: Context) -> jax.Array:
  """1 in the step that terminates the episode."""
  return c.done.astype(jnp.float32)


def pose(c: Context) -> jax.Array:
  """sum (q_j - home_j)²."""
  return jnp.square(c.joint_pos - c.hand.home_pose).sum()


def action_rate(c: Context) -> jax.Array:
  """|a - a1|², a the action and a1 the one before."""
  return jnp.square(c.action - c.info["last_act"]).sum()


def action_rate_and_change(c: Context) -> jax.Array:
  """|a - a1|² + |a - 2 a1 + a2|²."""
  change = c.action - 2 * c.info["last_act"] + c.info["last_last_act"]
  return action_rate(c) + jnp.square(change).sum()


def joint_vel(c: Context) -> jax.Array:
  """sum (qd_j / 4 rad/s)²."""
  return jnp.square(c.joint_vel / _FULL_SPEED).sum()


def torques(c: Context) -> jax.Array:
  """sum f_i², f the motors' forces."""
  return jnp.square(c.data.actuator_force).sum()


def energy(c: Context) -> jax.Array:
  """sum |qd_j| |tau_j|, tau the servos' torques, of a hand that has a servo for each joint."""
  return (jnp.abs(c.joint_vel) * jnp.abs(c.data.actuator_force)).sum()


def energy_of_joints(c: Context) -> jax.Array:
  """sum |qd_j| |tau_j|, tau what the motors do at the joints, through tendons too."""
  return (jnp.abs(c.joint_vel) * jnp.abs(c.data.qfrc_actuator[: c.hand.num_joints])).sum()


HAND_REWARDS: dict[str, Callable[..., jax.Array]] = {
  f.__name__: f
  for f in (
    orientation, position, angvel, linvel, termination, pose, action_rate, action_rate_and_change, joint_vel, torques,
    energy, energy_of_joints,
  )
}  # fmt: skip
