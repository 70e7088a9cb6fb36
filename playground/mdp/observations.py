"""Observation terms, besides the properties of a step context (`playground.mdp.terms`).

Sensors, site poses and actuator forces are one physics step older than `qpos` and `qvel`, as MuJoCo leaves them. The
first line of a docstring goes into `policy.yaml`: it gives frame, unit and [length]. An orientation is two rows of a
rotation matrix, without the quaternion's double cover. A hand's actor observes the cube's tracked pose, `sensed_*`;
the other terms are exact.
"""

import zlib
from collections.abc import Callable

import jax
import jax.numpy as jnp
from mujoco.mjx._src.math import quat_inv, quat_mul, quat_to_mat

from playground.limits import AtLeast0
from playground.mdp.context import StepContext, root_qpos
from playground.mdp.legged import LeggedContext
from playground.mdp.manipulators import ArmContext, HandContext
from playground.mdp.options import MirrorKind, mirrors_as
from playground.mdp.poses import turn_at_random, two_rows

Observe = Callable[[StepContext], jax.Array]


def _sensor(name: str, what: str, mirror: MirrorKind | None = None) -> Observe:
  """Returns the term that reads a sensor, by its name in the robot's YAML."""
  return _reads(what, lambda c: c.sensor(name), mirror)


def _from_info(name: str, what: str, mirror: MirrorKind | None = None) -> Observe:
  """Returns the term that reads an entry of `info`."""
  return _reads(what, lambda c: c.info[name], mirror)


def _reads(what: str, read: Observe, mirror: MirrorKind | None = None) -> Observe:
  read.__doc__ = what
  return mirrors_as(mirror)(read) if mirror else read


# Any robot.


def qpos(c: StepContext) -> jax.Array:
  """Positions of `joints` in their order: rad, m; of a free one m and a quaternion, w first, world frame [nq]."""
  return c.data.qpos


def qvel(c: StepContext) -> jax.Array:
  """Velocities of `joints`: rad/s, m/s; of a free one m/s in the world frame, then rad/s in its own [nv]."""
  return c.data.qvel


@mirrors_as("joints")
def target_error(c: StepContext) -> jax.Array:
  """Joint positions relative to their targets, rad [joints]."""
  return c.joint_pos - c.data.ctrl


def episode_time(c: StepContext) -> jax.Array:
  """Share of the episode that is over [1]."""
  return c.data.time / (c.env.episode_length * c.env.dt)


actuator_force = _reads("Forces of the actuators, N m (N on a tendon) [nu].", lambda c: c.data.actuator_force, "joints")
action = _reads("The action just applied [action_size].", lambda c: c.action)

# Robots on legs.

gyro = _sensor("gyro", "Angular velocity of the base in its own frame, rad/s [3].", "axial")
gyro_yaw = _reads("Angular velocity of the base about its own z, rad/s [1].", lambda c: c.sensor("gyro")[2], "opposite")
linvel = _sensor("linvel", "Linear velocity of the base in its own frame, m/s [3].", "polar")
accelerometer = _sensor("accelerometer", "Proper acceleration of the base in its own frame, m/s² [3].", "polar")
global_angvel = _sensor("global_angvel", "Angular velocity of the base in the world frame, rad/s [3].", "axial")
upvector = _sensor(
  "upvector", "The base's upward axis in the world frame [3]: unlike `gravity`, it has the heading.", "polar"
)
last_contact = _from_info("last_contact", "Which feet touched the floor in the step before, 0 or 1 [feet].", "feet")
gait = _from_info("gait", "Index of the episode's gait in the modes of the gait command [1].", "same")
gait_frequency = _from_info("gait_freq", "Frequency of the gait's steps, Hz [1].", "same")
foot_height = _from_info("foot_height", "Highest swing of the feet in this episode's gait, m [1].", "same")
pushed = _from_info("pushing", "Whether a push is under way, 0 or 1 [1].", "same")
root_height = _reads("World z of the root joint, m [1].", lambda c: root_qpos(c)[2], "same")
root_pos = _reads("World position of the root joint, m [3].", lambda c: root_qpos(c)[:3], "polar")
root_quat = _reads(
  "Orientation of the root joint, a quaternion w, x, y, z [4].", lambda c: root_qpos(c)[3:], "quaternion"
)


@mirrors_as("feet_polar")
def feet_pos(c: LeggedContext) -> jax.Array:
  """Positions of the feet in the base frame, m [feet, 3]."""
  return c.robot.foot_sensors(c.data, "foot_pos")


@mirrors_as("feet")
def phase(c: LeggedContext) -> jax.Array:
  """Cosines of the feet's phases in the gait, then their sines [2 * feet]."""
  return jnp.concatenate([jnp.cos(c.phase), jnp.sin(c.phase)])


@mirrors_as("polar")
def push_force(c: LeggedContext) -> jax.Array:
  """Force of a push on the root body, world frame, N [3]."""
  return c.data.xfrc_applied[c.robot.root, :3]


# Arms at a table.

applied_action = _from_info(
  "applied_act", "The action that acted in the step before, late (task PushCube) [action_size]."
)
no_ik_solution = _from_info("no_solution", "1 where inverse kinematics found no joint angles for the last action [1].")


def servo_error(c: ArmContext) -> jax.Array:
  """Targets of the actuators minus the positions of their joints, rad, m [nu]."""
  actuators, joints = c.robot.driven
  return c.data.ctrl[actuators] - c.data.qpos[joints]


def site_axes(c: ArmContext, site: str, turn_noise: AtLeast0 = 0.0) -> jax.Array:
  """Orientation of a site: last two rows of its rotation matrix in the world frame [6].

  `turn_noise` times `env.noise_level` is the largest turn, rad, about an axis in any direction.
  """
  return _turned(c, c.site_axes(site), turn_noise, site)


def body_axes(c: ArmContext, body: str, turn_noise: AtLeast0 = 0.0) -> jax.Array:
  """Orientation of a body: last two rows of its rotation matrix in the world frame [6]; see `site_axes`."""
  return _turned(c, c.body_axes(body), turn_noise, body)


def _turned(c: ArmContext, axes: jax.Array, max_angle: float, name: str) -> jax.Array:
  """The last two rows of axes as a tracker measures them, turned at random by up to `max_angle` rad; shape [2, 3]."""
  max_angle = max_angle * c.env.config.noise_level
  if max_angle:
    key = jax.random.fold_in(c.info["rng"], zlib.crc32(name.encode()))
    axes = quat_to_mat(turn_at_random(key, jnp.array([1.0, 0.0, 0.0, 0.0]), max_angle)) @ axes
  return axes[1:]


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


# Hands with a cube.

tendon_length = _sensor("tendon_length", "Lengths of the tendons that motors pull, m [tendons].")
joint_sensors = _sensor("joint_sensors", "Positions of the joints that have a sensor, where few have, rad [sensors].")
fingertip_pos = _sensor("fingertip_pos", "Positions of the fingertips in the frame of the palm, m [3 * fingers].")
cube_quat = _sensor("cube_orientation", "The cube's orientation, a quaternion w, x, y, z [4].")
cube_linvel = _sensor("cube_linvel", "World velocity of the cube, m/s [3].")
cube_angvel = _sensor("cube_angvel", "World angular velocity of the cube, rad/s [3].")
push_direction = _from_info("push_direction", "Unit vector of the last push's force and torque on the cube [6].")


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


def push_wrench(c: HandContext) -> jax.Array:
  """Force and torque of a push on the cube, world frame, N and N m [6]."""
  return c.data.xfrc_applied[c.robot.cube]
