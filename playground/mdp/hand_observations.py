"""Observation terms of a hand with a cube, beside those of any robot in `playground.mdp.observations`.

What the actor sees of the cube is the tracked pose, `sensed_*`; the others are exact.
"""

import jax
from mujoco.mjx._src.math import quat_inv, quat_mul

from playground.mdp.hands import HandContext
from playground.mdp.rotations import two_rows


def tendon_length(c: HandContext) -> jax.Array:
  """Lengths of the tendons that motors pull, m [tendons]."""
  return c.sensor("tendon_length")


def joint_sensors(c: HandContext) -> jax.Array:
  """Positions of the joints that have a sensor, in a hand where few have, rad [sensors]."""
  return c.sensor("joint_sensors")


def fingertip_pos(c: HandContext) -> jax.Array:
  """Positions of the fingertips in the frame of the palm, m [3 * fingers]."""
  return c.sensor("fingertip_pos")


def sensed_cube_pos_error(c: HandContext) -> jax.Array:
  """From the tracked cube to the palm, world frame, m [3]."""
  return c.sensor("palm_position") - c.sensed_cube_pose[0]


def sensed_cube_ori_error(c: HandContext) -> jax.Array:
  """The tracked cube's orientation relative to the goal's, two rows of a matrix [6]."""
  return two_rows(quat_mul(c.sensed_cube_pose[1], quat_inv(c.sensor("cube_goal_orientation"))))


def cube_pos_error(c: HandContext) -> jax.Array:
  """From the cube to the palm, world frame, m [3]."""
  return c.sensor("palm_position") - c.sensor("cube_position")


def cube_ori_error(c: HandContext) -> jax.Array:
  """The cube's orientation relative to the goal's, two rows of a matrix [6]."""
  return two_rows(quat_mul(c.sensor("cube_orientation"), quat_inv(c.sensor("cube_goal_orientation"))))


def cube_quat(c: HandContext) -> jax.Array:
  """The cube's orientation, a quaternion w, x, y, z [4]."""
  return c.sensor("cube_orientation")


def cube_linvel(c: HandContext) -> jax.Array:
  """World velocity of the cube, m/s [3]."""
  return c.sensor("cube_linvel")


def cube_angvel(c: HandContext) -> jax.Array:
  """World angular velocity of the cube, rad/s [3]."""
  return c.sensor("cube_angvel")


def push_direction(c: HandContext) -> jax.Array:
  """Unit vector of the last push's force and torque on the cube [6]."""
  return c.carried("push_direction")


def push_wrench(c: HandContext) -> jax.Array:
  """Force and torque of a push on the cube, world frame, N and N m [6]."""
  return c.data.xfrc_applied[c.robot.cube]
