"""What rewards, observations and terminations of a legged robot are functions of: the robot and the present moment."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from playground.envs.physics import PhysicsData, mjx
from playground.errors import ConfigError, UnknownNameError, nearest


class LeggedRobot:
  """A robot's fixed facts, found in the compiled model under the names of `configs/robot/<robot>.yaml`.

  The first joint is the free one of the base; actuators stand in the order of the other joints.

  Attributes:
    init_qpos: configuration of the keyframe, shape [nq].
    default_pose: its joint part, rad, shape [nu].
    joint_range: (lower, upper) limits of the joints, rad, shape [2, nu].
    root: id of the body that is pushed.
    base_site: id of the site that carries the inertial sensors.
    feet: ids of the foot sites, shape [feet].
  """

  def __init__(self, mj_model: mujoco.MjModel, config: Any):
    """Looks the names up.

    Args:
      mj_model: the compiled scene.
      config: `env.robot`.

    Raises:
      UnknownNameError: the model has no object of that name.
      ConfigError: the model's joints come in another order.
    """
    joints = [mujoco.mj_id2name(mj_model, mujoco.mjtObj.mjOBJ_JOINT, i) for i in range(1, mj_model.njnt)]
    if joints != list(config.joints):
      raise ConfigError(f"env.robot.joints must name the model's joints in their order: {', '.join(joints)}.")
    self.init_qpos = jnp.array(mj_model.key_qpos[_find(mj_model, "key", config.keyframe)])
    self.default_pose = self.init_qpos[7:]
    self.joint_range = jnp.array(mj_model.jnt_range[1:].T)
    self.root = _find(mj_model, "body", config.root)
    self.base_site = _find(mj_model, "site", config.base_site)
    self.feet = np.array([_find(mj_model, "site", name) for name in config.feet])
    self._sensors = {key: _address(mj_model, config.sensors[key]) for key in config.sensors}
    self._foot_linvel = np.array([_address(mj_model, name) for name in config.foot_linvel])
    self._foot_contact = [np.concatenate([_address(mj_model, name) for name in foot]) for foot in config.foot_contact]
    self._subtree = _subtree(mj_model, self.root)

  def sensor(self, data: PhysicsData, key: str) -> jax.Array:
    """Returns the reading of the sensor that the robot's configuration has under `sensors.<key>`."""
    return data.sensordata[self._sensors[key]]

  def feet_velocity(self, data: PhysicsData) -> jax.Array:
    """Returns the world velocities of the foot sites, m/s, shape [feet, 3]."""
    return data.sensordata[self._foot_linvel]

  def contact(self, data: PhysicsData) -> jax.Array:
    """Returns whether each foot touches the floor, bool, shape [feet]: any of its contact sensors is above 0."""
    return jnp.stack([(data.sensordata[address] > 0).any() for address in self._foot_contact])

  def mass(self, model: mjx.Model) -> jax.Array:
    """Returns the mass that a push on `root` moves, kg: the root's and that of all it carries."""
    return model.body_mass[self._subtree].sum()


@dataclasses.dataclass(frozen=True)
class Context:
  """One environment after one control step, before the bookkeeping for the next.

  Attributes:
    robot: the robot's fixed facts.
    data: the physics.
    info: what the task carries, as it stood during the step: `command` (m/s, m/s, rad/s), `last_act` and
      `last_last_act` (the two actions before `action`), `last_contact`; `feet_air_time` (s, shape [feet]) and
      `swing_peak` (m, highest z of each foot since it last touched) already count this step.
    action: the action just applied, shape [nu].
    contact: which feet touch the floor, bool, shape [feet].
    first_contact: which of them were in the air before, bool, shape [feet].
    done: whether the episode ends here, bool.
  """

  robot: LeggedRobot
  data: PhysicsData
  info: Mapping[str, Any]
  action: jax.Array
  contact: jax.Array
  first_contact: jax.Array
  done: jax.Array

  def sensor(self, key: str) -> jax.Array:
    return self.robot.sensor(self.data, key)

  @property
  def command(self) -> jax.Array:
    return self.info["command"]

  @property
  def joint_pos(self) -> jax.Array:
    """Joint positions, rad, shape [nu]."""
    return self.data.qpos[7:]

  @property
  def joint_vel(self) -> jax.Array:
    """Joint velocities, rad/s, shape [nu]."""
    return self.data.qvel[6:]

  @property
  def gravity(self) -> jax.Array:
    """Direction of gravity in the frame of the base site, shape [3]."""
    return -self.data.site_xmat[self.robot.base_site][2]

  @property
  def feet_height(self) -> jax.Array:
    """World z of the foot sites, m, shape [feet]."""
    return self.data.site_xpos[self.robot.feet, 2]

  @property
  def feet_velocity(self) -> jax.Array:
    """World velocities of the foot sites, m/s, shape [feet, 3]."""
    return self.robot.feet_velocity(self.data)


_OBJECTS = {
  "key": (mujoco.mjtObj.mjOBJ_KEY, "nkey"),
  "body": (mujoco.mjtObj.mjOBJ_BODY, "nbody"),
  "site": (mujoco.mjtObj.mjOBJ_SITE, "nsite"),
  "sensor": (mujoco.mjtObj.mjOBJ_SENSOR, "nsensor"),
}


def _find(mj_model: mujoco.MjModel, kind: str, name: str) -> int:
  obj, count = _OBJECTS[kind]
  index = mujoco.mj_name2id(mj_model, obj, name)
  if index < 0:
    names = [mujoco.mj_id2name(mj_model, obj, i) or "" for i in range(getattr(mj_model, count))]
    raise UnknownNameError(f"env.robot names the {kind} {name!r}, which the model has not.{nearest(name, names)}")
  return index


def _address(mj_model: mujoco.MjModel, sensor: str) -> np.ndarray:
  index = _find(mj_model, "sensor", sensor)
  return mj_model.sensor_adr[index] + np.arange(mj_model.sensor_dim[index])


def _subtree(mj_model: mujoco.MjModel, root: int) -> np.ndarray:
  bodies = [root]  # a child's id is always above its parent's
  for body in range(root + 1, mj_model.nbody):
    if mj_model.body_parentid[body] in bodies:
      bodies.append(body)
  return np.array(bodies)
