"""Arms at a table and hands with a cube: constants, and quantities that terms read in a step."""

import functools
import re
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.mjx._src.math import quat_to_mat

from playground.errors import ConfigError, lookup
from playground.mdp.context import Robot, StepContext
from playground.mdp.poses import Pose, angle_between
from playground.physics.backend import PhysicsData

if TYPE_CHECKING:
  from playground.envs.manipulation.arm import TabletopTask
  from playground.envs.manipulation.in_hand import HandTask

_REACH = 0.012  # m from the gripper's tip to the object's centre


class Manipulator(Robot):
  """Constants of arms or of a hand, and of their scene.

  Attributes:
    joint_ids: of the arms' or the hand's joints, those of grippers' fingers excepted.
    ctrl_range: (lower, upper) limits of `ctrl`, infinite for an actuator without a range, shape [2, nu].
    init_ctrl: `ctrl` of the keyframe, shape [nu].
  """

  def __init__(self, mj_model: mujoco.MjModel, keyframe: str, joints: str = ".*", sensors: Any = None):
    """Looks up the names; `joints` is a regular expression of the names of the joints, free ones excepted."""
    hinges = [i for i in range(mj_model.njnt) if mj_model.jnt_type[i] != mujoco.mjtJoint.mjJNT_FREE]
    self.joint_ids = np.array([i for i in hinges if re.fullmatch(joints, mj_model.joint(i).name)])
    super().__init__(mj_model, [mj_model.joint(i).name for i in self.joint_ids], sensors)
    self.qpos, self.qvel = _span(mj_model.jnt_qposadr[self.joint_ids]), _span(mj_model.jnt_dofadr[self.joint_ids])
    self.joint_range = jnp.array(mj_model.jnt_range[self.joint_ids].T)
    ranged = mj_model.actuator_ctrllimited.astype(bool)
    no_limit = np.array([[-np.inf], [np.inf]])
    self.ctrl_range = jnp.array(np.where(ranged, mj_model.actuator_ctrlrange.T, no_limit))
    key = mj_model.key(self.find("key", keyframe, "env.keyframe"))
    self.init_qpos, self.init_ctrl = jnp.array(key.qpos), jnp.array(key.ctrl)
    self.default_pose = self.init_qpos[self.qpos]


class ArmRobot(Manipulator):
  """Constants of one or two arms and of their scene; the keyframe's joints and `ctrl` are within their limits.

  Attributes:
    driven: indices of the actuators that act on a joint, and of those joints in `qpos`.
    servos: indices of the actuators that drive the arms' joints.
  """

  def __init__(self, mj_model: mujoco.MjModel, keyframe: str, joints: str):
    super().__init__(mj_model, keyframe, joints)
    self.default_pose = jnp.clip(self.default_pose, *self.joint_range)
    self.init_qpos = self.init_qpos.at[self.qpos].set(self.default_pose)
    self.init_ctrl = jnp.clip(self.init_ctrl, *self.ctrl_range)
    on_joint = np.flatnonzero(mj_model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
    driven = mj_model.actuator_trnid[on_joint, 0]
    self.driven = on_joint, mj_model.jnt_qposadr[driven]
    self.servos = np.array([on_joint[driven == i][0] for i in self.joint_ids])

  def free_joint(self, body: str) -> slice:
    """Returns where the position of a free body is in `qpos`; raises UnknownNameError if no such body is free."""
    model = self.mj_model
    free = [i for i in range(model.njnt) if model.jnt_type[i] == mujoco.mjtJoint.mjJNT_FREE]
    table = {model.body(model.jnt_bodyid[i]).name: int(model.jnt_qposadr[i]) for i in free}
    start = lookup(table, body, "body of an event")
    return slice(start, start + 3)

  def touching(self, data: PhysicsData, geom: str) -> jax.Array:
    """Returns which contact sensors of a geom report a contact, bool, shape [sensors].

    Raises:
      ConfigError: the scene has no such geom, or no contact sensor of it.
    """
    self.find("geom", geom, "a term")
    addresses = contact_addresses(self.mj_model, geom)
    if not addresses.size:
      raise ConfigError(f"the scene has no contact sensor of geom {geom!r}.")
    return data.sensordata[addresses] > 0

  def contact_normals(self, data: PhysicsData) -> jax.Array:
    """Returns the readings of the sensors `<geom>_<other>_normal`, shape [sensors, 3]; raises ConfigError for none."""
    rows = [rows for name, rows in self._rows.items() if name.endswith("_normal")]
    if not rows:
      raise ConfigError("the scene has no contact sensor <geom>_<other>_normal.")
    return data.sensordata[_span(np.concatenate(rows))].reshape(-1, 3)


class Hand(Manipulator):
  """A hand's constants, found in the compiled scene (`playground.robots.in_hand`) in its keyframe `home`.

  Attributes:
    has_servos: whether each joint has a position servo of its own; else tendons pull it.
    cube: id of the cube's body.
    cube_qpos: where the cube's position and orientation are in `qpos`.
  """

  def __init__(self, mj_model: mujoco.MjModel, config: Any):
    """Looks up the names of `env.robot`."""
    super().__init__(mj_model, "home", sensors=config.sensors)
    self.has_servos = mj_model.nu == len(self.joint_names)
    self.cube: int = mj_model.body("cube").id
    start = int(mj_model.joint("cube_freejoint").qposadr[0])
    self.cube_qpos = slice(start, start + 7)


def _span(indices: np.ndarray) -> slice | np.ndarray:
  """A slice where the indices follow each other: cheaper to read than a gather."""
  start, stop = int(indices[0]), int(indices[-1]) + 1
  return slice(start, stop) if stop - start == len(indices) else indices


def contact_addresses(model: mujoco.MjModel, geom: str) -> np.ndarray:
  """Where in `sensordata` the `found` sensors of a geom's contacts are, in the sensors' order: shape [sensors]."""
  of_contacts = (model.sensor_type == mujoco.mjtSensor.mjSENS_CONTACT) & (model.sensor_dim == 1)
  this = model.geom(geom).id
  return model.sensor_adr[of_contacts & ((model.sensor_objid == this) | (model.sensor_refid == this))]


class ArmContext(StepContext):
  """A step of arms at a table. Positions are the world's, m; axes are the columns of a rotation matrix [3, 3].

  The object and the gripper are those that the task's config names; the goal is the scene's mocap body.
  """

  env: "TabletopTask"
  robot: ArmRobot

  def body_pos(self, body: str) -> jax.Array:
    """Position of a body, world frame, m [3]."""
    return self.data.xpos[self.robot.find("body", body, "a term")]

  def body_axes(self, body: str) -> jax.Array:
    """Axes of a body [3, 3]."""
    return self.data.xmat[self.robot.find("body", body, "a term")]

  def site_pos(self, site: str) -> jax.Array:
    """Position of a site, world frame, m [3]."""
    return self.data.site_xpos[self.robot.find("site", site, "a term")]

  def site_axes(self, site: str) -> jax.Array:
    """Axes of a site [3, 3]."""
    return self.data.site_xmat[self.robot.find("site", site, "a term")]

  @property
  def object_pos(self) -> jax.Array:
    """Position of the object, m [3]."""
    return self.body_pos(self.env.object)

  @property
  def gripper_pos(self) -> jax.Array:
    """Position of the gripper's tip, m [3]."""
    return self.site_pos(self.env.gripper)

  @property
  def goal_pos(self) -> jax.Array:
    """Position of the goal, world frame, m [3]."""
    return self.data.mocap_pos[0]

  @property
  def object_to_goal(self) -> jax.Array:
    """From the object to the goal, world frame, m [3]."""
    return self.goal_pos - self.object_pos

  @property
  def goal_angle(self) -> jax.Array:
    """The smallest angle that turns the object as the goal, rad."""
    return angle_between(self.data.xquat[self.robot.find("body", self.env.object, "a term")], self.data.mocap_quat[0])

  @property
  def goal_axes_error(self) -> jax.Array:
    """First two rows of the goal's rotation matrix minus those of the object, world frame [6]."""
    return (quat_to_mat(self.data.mocap_quat[0]) - self.body_axes(self.env.object))[:2].ravel()

  @functools.cached_property
  def at_goal(self) -> jax.Array:
    """Whether the object is where it should be, as the task's `success_...` keys say, bool."""
    return self.env.at_goal(self)

  @functools.cached_property
  def reached(self) -> jax.Array:
    """1 from the step on in which the gripper first reached the object in this episode, else 0."""
    near = jnp.linalg.norm(self.object_pos - self.gripper_pos) < _REACH
    return jnp.maximum(self.info["reached_box"], near.astype(jnp.float32))


class HandContext(StepContext):
  """A step of a hand with a cube."""

  env: "HandTask"  # pyright: ignore[reportIncompatibleVariableOverride]
  robot: Hand  # pyright: ignore[reportIncompatibleMethodOverride]

  @functools.cached_property
  def sensed_cube_pose(self) -> Pose:
    """The cube's pose as it is tracked, with the noise of `env.pose_noise`: one draw a step for all terms."""
    return self.env.sense_cube(self.info, (self.sensor("cube_position"), self.sensor("cube_orientation")))

  @functools.cached_property
  def rotation_error(self) -> jax.Array:
    """Angle between the cube's orientation and the goal's, rad."""
    return angle_between(self.sensor("cube_orientation"), self.sensor("cube_goal_orientation"))

  @functools.cached_property
  def position_error(self) -> jax.Array:
    """Distance of the cube from the palm, m."""
    return jnp.linalg.norm(self.sensor("palm_position") - self.sensor("cube_position"))
