"""Parts that observations of a hand with a cube are concatenated from (`env.obs`; see `observations.py`).

What the actor sees of the cube is the tracked pose, `sensed_*`; the others are exact.
"""

from collections.abc import Callable

import jax
from mujoco.mjx._src.math import quat_inv, quat_mul

from playground.mdp.hands import Context
from playground.mdp.rotations import two_rows


def joint_pos(c: Context) -> jax.Array:
  """Joint positions, rad [joints]."""
  return c.joint_pos


def joint_vel(c: Context) -> jax.Array:
  """Joint velocities, rad/s [joints]."""
  return c.joint_vel


def tendon_length(c: Context) -> jax.Array:
  """Lengths of the tendons that motors pull, m."""
  return c.hand.sensors(c.data, "tendon_length")


def joint_sensors(c: Context) -> jax.Array:
  """Positions of the joints that have a sensor, in a hand where few have, rad."""
  return c.hand.sensors(c.data, "joint_sensors")


def target_error(c: Context) -> jax.Array:
  """Joint positions relative to their targets, rad [joints]."""
  return c.joint_pos - c.data.ctrl


def sensed_cube_pos_error(c: Context) -> jax.Array:
  """From the tracked cube to the palm, world frame, m [3]."""
  return c.sensor("palm_position") - c.sensed[0]


def sensed_cube_ori_error(c: Context) -> jax.Array:
  """The tracked cube's orientation relative to the goal's, two rows of a matrix [6]."""
  return two_rows(quat_mul(c.sensed[1], quat_inv(c.sensor("cube_goal_orientation"))))


def last_act(c: Context) -> jax.Array:
  """The action before the one just applied [nu]."""
  return c.info["last_act"]


def fingertips(c: Context) -> jax.Array:
  """Fingertips in the frame of the palm, m [3 * fingers]."""
  return c.hand.fingertips(c.data)


def actuator_force(c: Context) -> jax.Array:
  """Forces of the motors, N m (N on a tendon) [nu]."""
  return c.data.actuator_force


def cube_pos_error(c: Context) -> jax.Array:
  """From the cube to the palm, world frame, m [3]."""
  return c.sensor("palm_position") - c.sensor("cube_position")


def cube_ori_error(c: Context) -> jax.Array:
  """The cube's orientation relative to the goal's, two rows of a matrix [6]."""
  return two_rows(quat_mul(c.sensor("cube_orientation"), quat_inv(c.sensor("cube_goal_orientation"))))


def cube_quat(c: Context) -> jax.Array:
  """The cube's orientation, a quaternion w, x, y, z [4]."""
  return c.sensor("cube_orientation")


def cube_linvel(c: Context) -> jax.Array:
  """World velocity of the cube, m/s [3]."""
  return c.sensor("cube_linvel")


def cube_angvel(c: Context) -> jax.Array:
  """World angular velocity of the cube, rad/s [3]."""
  return c.sensor("cube_angvel")


def push_direction(c: Context) -> jax.Array:
  """Unit vector of the last push's force and torque on the cube [6]."""
  return c.info["pert_dir"]


def push_wrench(c: Context) -> jax.Array:
  """Force and torque of a push on the cube, world frame, N and N m [6]."""
  return c.data.xfrc_applied[c.hand.cube]


HAND_OBSERVATIONS: dict[str, Callable[[Context], jax.Array]] = {
  f.__name__: f
  for f in (
    tendon_length, joint_pos, joint_sensors, joint_vel, target_error, sensed_cube_pos_error, sensed_cube_ori_error,
    last_act, fingertips, actuator_force, cube_pos_error, cube_ori_error, cube_quat, cube_linvel, cube_angvel,
    push_direction, push_wrench,
  )
}  # fmt: skip
