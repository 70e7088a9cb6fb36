"""Arms at a table: their constant facts, and what terms read of them and of what they handle in a step."""

import functools
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.mjx._src.math import quat_to_mat

from playground.envs.physics import PhysicsData
from playground.errors import UnknownNameError, nearest
from playground.mdp.context import StepContext
from playground.mdp.lookup import lookup
from playground.mdp.rotations import angle_between

if TYPE_CHECKING:
  from playground.envs.manipulation.tabletop import TabletopTask


class ArmRobot:
  """Constant facts of one or two arms and of their scene.

  Attributes:
    joint_names: of the arms' joints; fingers are not among them.
    qpos, qvel: indices of those joints in `qpos` and `qvel`.
    servos: indices of the actuators that drive those joints.
    joint_range: (lower, upper) limits of those joints, rad, shape [2, joints].
    init_qpos: configuration of the keyframe, those joints within their limits, shape [nq].
    init_ctrl: `ctrl` of the keyframe, likewise, shape [nu].
    default_pose: positions of those joints in `init_qpos`, rad, shape [joints].
    ctrl_range: (lower, upper) limits of `ctrl`, shape [2, nu].
    driven: indices of the actuators that act on a joint, and of those joints in `qpos`.
  """

  def __init__(self, mj_model: mujoco.MjModel, keyframe: str, joints: str):
    """Looks the names up.

    Args:
      mj_model: the compiled scene.
      keyframe: its start.
      joints: regular expression of the names of the arms' joints.

    Raises:
      UnknownNameError: the model has no keyframe of that name.
    """
    names = [mj_model.joint(i).name for i in range(mj_model.njnt)]
    ids = np.array([i for i, name in enumerate(names) if re.fullmatch(joints, name)])
    self.joint_names = [names[i] for i in ids]
    self.qpos, self.qvel = mj_model.jnt_qposadr[ids], mj_model.jnt_dofadr[ids]
    self.joint_range = jnp.array(mj_model.jnt_range[ids].T)
    self.ctrl_range = jnp.array(mj_model.actuator_ctrlrange.T)
    on_joint = np.flatnonzero(mj_model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
    driven = mj_model.actuator_trnid[on_joint, 0]
    self.driven = on_joint, mj_model.jnt_qposadr[driven]
    self.servos = np.array([on_joint[driven == i][0] for i in ids])
    table = {mj_model.key(i).name: mj_model.key(i) for i in range(mj_model.nkey)}
    key = lookup(table, keyframe, "env.keyframe")
    self.default_pose = jnp.clip(jnp.array(key.qpos)[self.qpos], *self.joint_range)
    self.init_qpos = jnp.array(key.qpos).at[self.qpos].set(self.default_pose)
    self.init_ctrl = jnp.clip(jnp.array(key.ctrl), *self.ctrl_range)
    self._mj_model = mj_model
    self._ids = {
      kind: {get(i).name: i for i in range(count)}
      for kind, get, count in (
        ("body", mj_model.body, mj_model.nbody),
        ("site", mj_model.site, mj_model.nsite),
        ("geom", mj_model.geom, mj_model.ngeom),
        ("sensor", mj_model.sensor, mj_model.nsensor),
      )
    }

  def find_joints(self, joints: str | Sequence[str]) -> np.ndarray:
    """Returns the indices of the arms' joints that match one of some regular expressions; raises UnknownNameError."""
    patterns = (joints,) if isinstance(joints, str) else joints
    found = [i for i, name in enumerate(self.joint_names) if any(re.fullmatch(p, name) for p in patterns)]
    if not found:
      near = nearest(str(patterns[0]), self.joint_names)
      raise UnknownNameError(f"joints={joints!r} matches no joint of the arms.{near}")
    return np.array(found)

  def find(self, kind: str, name: str) -> int:
    """Returns the id of a `body`, `site`, `geom` or `sensor`; raises UnknownNameError."""
    return lookup(self._ids[kind], name, f"{kind} of a term")

  def free_joint(self, body: str) -> slice:
    """Returns where the position of a free body is in `qpos`; raises UnknownNameError if no such body is free."""
    model = self._mj_model
    free = [i for i in range(model.njnt) if model.jnt_type[i] == mujoco.mjtJoint.mjJNT_FREE]
    table = {model.body(model.jnt_bodyid[i]).name: int(model.jnt_qposadr[i]) for i in free}
    start = lookup(table, body, "body of an event")
    return slice(start, start + 3)

  def sensor(self, data: PhysicsData, name: str) -> jax.Array:
    """Returns the reading of a sensor of the model; raises UnknownNameError."""
    index = self.find("sensor", name)
    start = self._mj_model.sensor_adr[index]
    return data.sensordata[start : start + self._mj_model.sensor_dim[index]]

  def touching(self, data: PhysicsData, geom: str) -> jax.Array:
    """Returns which of the contact sensors of a geom see a contact, bool, shape [sensors]; raises UnknownNameError."""
    self.find("geom", geom)
    return data.sensordata[contact_addresses(self._mj_model, geom)] > 0


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
    """Position of a body, m [3]."""
    return self.data.xpos[self.robot.find("body", body)]

  def body_axes(self, body: str) -> jax.Array:
    """Axes of a body [3, 3]."""
    return self.data.xmat[self.robot.find("body", body)]

  def site_pos(self, site: str) -> jax.Array:
    """Position of a site, m [3]."""
    return self.data.site_xpos[self.robot.find("site", site)]

  def site_axes(self, site: str) -> jax.Array:
    """Axes of a site [3, 3]."""
    return self.data.site_xmat[self.robot.find("site", site)]

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
    """Position of the goal, m [3]."""
    return self.data.mocap_pos[0]

  @property
  def to_goal(self) -> jax.Array:
    """From the object to the goal, m [3]."""
    return self.goal_pos - self.object_pos

  @property
  def goal_angle(self) -> jax.Array:
    """The smallest angle that turns the object as the goal, rad."""
    return angle_between(self.data.xquat[self.robot.find("body", self.env.object)], self.data.mocap_quat[0])

  @property
  def goal_axes_error(self) -> jax.Array:
    """First two rows of the goal's axes minus those of the object's [6]."""
    return (quat_to_mat(self.data.mocap_quat[0]) - self.body_axes(self.env.object))[:2].ravel()

  @functools.cached_property
  def at_goal(self) -> jax.Array:
    """Whether the object is where it should be, as the task's `success_...` keys say, bool."""
    return self.env.at_goal(self)

  @functools.cached_property
  def reached(self) -> jax.Array:
    """1 from the step on in which the gripper first reached the object in this episode, else 0."""
    near = jnp.linalg.norm(self.object_pos - self.gripper_pos) < _REACH
    return jnp.maximum(self.carried("reached_box"), near.astype(jnp.float32))


_REACH = 0.012  # m from the gripper's tip to the object's centre
