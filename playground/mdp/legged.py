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
from playground.mdp.lookup import lookup

STILL = 0.01  # a command whose norm is not above asks to stand still


class LeggedRobot:
  """A robot's fixed facts, found in the compiled model under the names of `configs/robot/<robot>.yaml`.

  The first joint is the free one of the base; actuators stand in the order of the other joints.

  Attributes:
    init_qpos: configuration of the keyframe, shape [nq].
    default_pose: its joint part, rad, shape [nu].
    joint_range: (lower, upper) limits of the joints, or of the targets of joints that have none, rad, shape [2, nu].
    target_range: (lower, upper) limits of the joints' targets: the robot's own, or those of the servos, rad, [2, nu].
    root: id of the body that is pushed.
    base_site: id of the site that carries the inertial sensors.
    feet: ids of the foot sites, shape [feet].
    misreads_contact: whether tasks should read `misread_contact` in their steps.
    pose_weights: how much each joint's distance from the default pose counts, shape [nu].
    torque_limits: of the joints, N m, shape [nu].
  """

  def __init__(self, mj_model: mujoco.MjModel, config: Any, parity: bool = False):
    """Looks the names up.

    Args:
      mj_model: the compiled scene.
      config: `env.robot`.
      parity: whether its `parity`, if there is one, counts: `sensors` replace others, `misread_contact` is as it says.

    Raises:
      UnknownNameError: the model has no object of that name.
      ConfigError: the model's joints come in another order.
    """
    joints = [mujoco.mj_id2name(mj_model, mujoco.mjtObj.mjOBJ_JOINT, i) for i in range(1, mj_model.njnt)]
    if joints != list(config.joints):
      raise ConfigError(f"env.robot.joints must name the model's joints in their order: {', '.join(joints)}.")
    self._mj_model = mj_model
    self.init_qpos = self.keyframe(config.keyframe)
    self.default_pose = self.init_qpos[7:]
    limited = mj_model.jnt_limited[1:, None].astype(bool)
    self.joint_range = jnp.array(np.where(limited, mj_model.jnt_range[1:], mj_model.actuator_ctrlrange).T)
    own = config.get("target_range")
    self.target_range = jnp.array([own.lower, own.upper] if own else mj_model.actuator_ctrlrange.T)
    self.root = _find(mj_model, "body", config.root)
    replaced = config.parity if parity and "parity" in config else {}
    self.base_site = _find(mj_model, "site", config.base_site)
    self.feet = np.array([_find(mj_model, "site", name) for name in config.feet])
    self.misreads_contact: bool = replaced.get("misread_contact", False)
    sensors = {**config.sensors, **replaced.get("sensors", {})}
    self._sensors = {key: _address(mj_model, name) for key, name in sensors.items()}
    self._foot_linvel = np.array([_address(mj_model, name) for name in config.foot_linvel])
    contact_sensors = [[_find(mj_model, "sensor", name) for name in foot] for foot in config.foot_contact]
    self._foot_contact = [mj_model.sensor_adr[ids] for ids in contact_sensors]
    self._foot_contact_misread = contact_sensors
    self._foot_pos = np.array([_address(mj_model, name) for name in config.get("foot_pos", ())])
    self._foot_force = np.array([_address(mj_model, name) for name in config.get("foot_force", ())])
    self._subtree = _subtree(mj_model, self.root)
    self.pose_weights = tuple(config.get("pose_weights", [1.0] * len(joints)))
    self.torque_limits = jnp.array(_torque_limits(mj_model))
    order = {name: i for i, name in enumerate(joints)}
    self._groups = {
      group: np.array([lookup(order, name, f"env.robot.{group}") for name in config.get(group, ())], int)
      for group in ("hips", "hip_rolls", "knees")
    }
    self._contacts = {
      group: [_address(mj_model, name)[0] for name in config.get(group, ())]
      for group in ("self_contact", "fatal_contact")
    }
    self._gaits = dict(config.get("gaits", {}))

  def keyframe(self, name: str) -> jax.Array:
    """Returns the configuration of a keyframe, shape [nq]; raises UnknownNameError if there is none of that name."""
    return jnp.array(self._mj_model.key_qpos[_find(self._mj_model, "key", name)])

  def sensor(self, data: PhysicsData, key: str) -> jax.Array:
    """Returns the reading of the sensor that the robot's configuration has under `sensors.<key>`."""
    return data.sensordata[lookup(self._sensors, key, "env.robot.sensors")]

  def joints(self, group: str) -> np.ndarray:
    """Returns the indices of the joints under `hips`, `hip_rolls` or `knees`; raises ConfigError if there are none."""
    return self._present(group, self._groups[group])

  def gait(self, name: str) -> list[float]:
    """Returns the feet's phases at the start of a gait, rad; raises UnknownNameError if the robot has none of the name.

    Raises:
      ConfigError: it has not one phase for each foot.
    """
    phases = lookup(self._gaits, name, "env.gait.modes")
    if len(phases) != len(self.feet):
      raise ConfigError(f"env.robot.gaits.{name} must hold {len(self.feet)} phases, one for each foot.")
    return list(phases)

  def feet_velocity(self, data: PhysicsData) -> jax.Array:
    """Returns the world velocities of the foot sites, m/s, shape [feet, 3]."""
    return data.sensordata[self._foot_linvel]

  def feet_pos(self, data: PhysicsData) -> jax.Array:
    """Returns the positions of the feet in the frame of the base site, m, shape [feet, 3]."""
    return data.sensordata[self._present("foot_pos", self._foot_pos)]

  def feet_force(self, data: PhysicsData) -> jax.Array:
    """Returns the force between each foot and its leg in the foot site's frame, N, shape [feet, 3]."""
    return data.sensordata[self._present("foot_force", self._foot_force)]

  def touching(self, data: PhysicsData, group: str) -> jax.Array:
    """Returns which of the contacts under `self_contact` or `fatal_contact` there are, bool, shape [contacts]."""
    return data.sensordata[np.array(self._present(group, self._contacts[group]))] > 0

  def _present(self, key: str, found: Any) -> Any:
    if len(found) == 0:
      raise ConfigError(f"env.robot.{key} is empty or missing, but a reward or termination of env needs it.")
    return found

  def contact(self, data: PhysicsData) -> jax.Array:
    """Returns whether each foot touches the floor, bool, shape [feet]: any of its contact sensors is above 0."""
    return jnp.stack([(data.sensordata[address] > 0).any() for address in self._foot_contact])

  def misread_contact(self, data: PhysicsData) -> jax.Array:
    """As `contact`, but takes the sensors' ids for the addresses of their readings: a slip of Playground 0.2.0's H1.

    What it reads are the base's height and the directions of its axes.
    """
    return jnp.stack([(data.sensordata[np.array(ids)] > 0).any() for ids in self._foot_contact_misread])

  def mass(self, model: mjx.Model) -> jax.Array:
    """Returns the mass that a push on `root` moves, kg: the root's and that of all it carries."""
    return model.body_mass[self._subtree].sum()


@dataclasses.dataclass(frozen=True)
class Context:
  """One environment after one control step, before the bookkeeping for the next.

  Attributes:
    robot: the robot's fixed facts.
    data: the physics.
    info: what the task carries, as it stood during the step: `last_act`, and as far as the task has them
      `last_last_act` (the two actions before `action`), `command` (m/s, m/s, rad/s), `last_contact`, `phase` (rad);
      `feet_air_time` (s, shape [feet]) and `swing_peak` (m, highest z of each foot since it last touched) already
      count this step.
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

  def kept(self, name: str) -> jax.Array:
    """Returns an entry of `info`.

    Raises:
      ConfigError: the task keeps none of that name.
    """
    if name not in self.info:
      raise ConfigError(f"Something in env.obs or env.reward needs the {name!r} that this task does not keep.")
    return self.info[name]

  @property
  def command(self) -> jax.Array:
    return self.kept("command")

  @property
  def commanded_speed(self) -> jax.Array:
    """Norm of the command, its turning included: 0 is to stand still."""
    return jnp.linalg.norm(self.command)

  @property
  def still(self) -> jax.Array:
    """Whether the command is to stand still, bool."""
    return self.commanded_speed <= STILL

  @property
  def phase(self) -> jax.Array:
    """Phases of the feet in the gait, rad, shape [feet]."""
    return self.kept("phase")

  @property
  def pose_error(self) -> jax.Array:
    """Joint positions relative to the default pose, rad, shape [nu]."""
    return self.joint_pos - self.robot.default_pose

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
  def base_height(self) -> jax.Array:
    """World z of the base site, m."""
    return self.data.site_xpos[self.robot.base_site, 2]

  @property
  def forward(self) -> jax.Array:
    """The base site's forward axis in the world frame, shape [3]."""
    return self.data.site_xmat[self.robot.base_site][:, 0]

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


def _torque_limits(mj_model: mujoco.MjModel) -> np.ndarray:
  """What bounds each torque: the servo's range of forces, or the joint's; infinite where nothing does."""
  servo = np.where(mj_model.actuator_forcelimited, mj_model.actuator_forcerange[:, 1], np.inf)
  joint = np.where(mj_model.jnt_actfrclimited[1:], mj_model.jnt_actfrcrange[1:, 1], np.inf)
  return np.minimum(servo, joint)


def _subtree(mj_model: mujoco.MjModel, root: int) -> np.ndarray:
  bodies = [root]  # a child's id is always above its parent's
  for body in range(root + 1, mj_model.nbody):
    if mj_model.body_parentid[body] in bodies:
      bodies.append(body)
  return np.array(bodies)
