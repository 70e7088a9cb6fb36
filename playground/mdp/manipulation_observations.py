"""Observation terms of arms at a table and of hands with a cube, beside those of any robot in `observations`.

The first line of a docstring gives frame, unit and [length]. An orientation is two rows of a rotation matrix, without
the quaternion's double cover. A hand's actor sees the cube's tracked pose, `sensed_*`; the other terms are exact.
"""

import zlib

import jax
import jax.numpy as jnp
from mujoco.mjx._src.math import quat_inv, quat_mul, quat_to_mat

from playground.limits import AtLeast0
from playground.mdp.context import StepContext
from playground.mdp.manipulators import ArmContext, HandContext
from playground.mdp.poses import turn_at_random, two_rows


def qpos(c: StepContext) -> jax.Array:
  """Positions of `joints` in their order: rad, m; of a free one m and a quaternion, w first, world frame [nq]."""
  return c.data.qpos


def qvel(c: StepContext) -> jax.Array:
  """Velocities of `joints`: rad/s, m/s; of a free one m/s in the world frame, then rad/s in its own [nv]."""
  return c.data.qvel


def action(c: StepContext) -> jax.Array:
  """The action just applied [action_size]."""
  return c.action


def applied_action(c: StepContext) -> jax.Array:
  """The action that acted in the step before, delays included (task PushCube) [action_size]."""
  return c.carried("applied_act")


def servo_error(c: ArmContext) -> jax.Array:
  """Targets of the actuators minus the positions of their joints, rad, m [nu]."""
  actuators, joints = c.robot.driven
  return c.data.ctrl[actuators] - c.data.qpos[joints]


def site_axes(c: ArmContext, site: str, turn_noise: AtLeast0 = 0.0) -> jax.Array:
  """Orientation of a site: last two rows of its rotation matrix in the world frame [6].

  Args:
    c: the step.
    site: its name.
    turn_noise: rad, times `env.noise_level`: the largest turn about an axis in any direction.
  """
  return _turned(c, c.site_axes(site), turn_noise, site)


def body_axes(c: ArmContext, body: str, turn_noise: AtLeast0 = 0.0) -> jax.Array:
  """Orientation of a body: last two rows of its rotation matrix in the world frame [6]; see `site_axes`."""
  return _turned(c, c.body_axes(body), turn_noise, body)


def body_upvector(c: ArmContext, body: str) -> jax.Array:
  """Third row of a body's rotation matrix in the world frame [3]."""
  return c.body_axes(body)[2]


def gripper_to_object(c: ArmContext) -> jax.Array:
  """From the gripper to the object, world frame, m [3]."""
  return c.object_pos - c.gripper_pos


def goal_axes(c: ArmContext) -> jax.Array:
  """Orientation of the goal: last two rows of its rotation matrix in the world frame [6]."""
  return two_rows(c.data.mocap_quat[0])


def goal_to_object(c: ArmContext) -> jax.Array:
  """From the goal to the object, world frame, m [3]."""
  return -c.object_to_goal


def no_ik_solution(c: ArmContext) -> jax.Array:
  """1 where the inverse kinematics found no joint angles for the last action, else 0 [1]."""
  return c.carried("no_solution")[None]


def episode_time(c: StepContext) -> jax.Array:
  """Share of the episode that is over [1]."""
  return (c.data.time / (c.env.episode_length * c.env.dt))[None]


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


def _turned(c: ArmContext, axes: jax.Array, max_angle: float, name: str) -> jax.Array:
  """The last two rows of axes that a tracker sees, turned at random by up to `max_angle` rad; shape [6]."""
  max_angle = max_angle * c.env.config.noise_level
  if max_angle:
    key = jax.random.fold_in(c.info["rng"], zlib.crc32(name.encode()))
    axes = quat_to_mat(turn_at_random(key, jnp.array([1.0, 0.0, 0.0, 0.0]), max_angle)) @ axes
  return axes[1:].ravel()
