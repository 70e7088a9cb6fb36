"""Robots on legs: constants, and quantities that terms read in a step."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from playground.errors import ConfigError, lookup
from playground.mdp.context import Robot, StepContext
from playground.mdp.options import mirrors_as
from playground.physics.backend import PhysicsData, mjx

_KINDS = {  # of sensors, by their key in `env.robot` or in its `sensors`
  "linvel": mujoco.mjtSensor.mjSENS_VELOCIMETER,
  "gyro": mujoco.mjtSensor.mjSENS_GYRO,
  "accelerometer": mujoco.mjtSensor.mjSENS_ACCELEROMETER,
  "upvector": mujoco.mjtSensor.mjSENS_FRAMEZAXIS,
  "global_linvel": mujoco.mjtSensor.mjSENS_FRAMELINVEL,
  "global_angvel": mujoco.mjtSensor.mjSENS_FRAMEANGVEL,
  "foot_linvel": mujoco.mjtSensor.mjSENS_FRAMELINVEL,
  "foot_pos": mujoco.mjtSensor.mjSENS_FRAMEPOS,
  "foot_force": mujoco.mjtSensor.mjSENS_FORCE,
}


class LeggedRobot(Robot):
  """A robot on legs, whose YAML (`configs/robot/`) names the parts of its model.

  The first joint is the free one of the base; actuators stand in the order of the other joints.

  Attributes:
    joint_range: for joints that have no limits those of their servos, rad, shape [2, nu].
    target_range: (lower, upper) limits of the joints' targets: the robot's own, or those of the servos, rad, [2, nu].
    root: id of the body that is pushed.
    base_site: id of the site that carries the inertial sensors.
    feet: ids of the foot sites, shape [feet].
    foot_names: names of the foot sites.
    pose_weights: how much each joint's distance from the default pose counts, shape [nu].
    contact_groups: addresses of contact sensors' readings, by the name of a group.
    left_to_right: beginnings or ends of names on the left and their counterparts on the right.
  """

  qpos = slice(7, None)
  qvel = slice(6, None)

  def __init__(self, mj_model: mujoco.MjModel, config: Any):
    """Looks up the names of `env.robot`.

    Raises:
      ConfigError: the model lacks one, its joints come in another order, a list does not have one entry for each foot
        or joint, or a sensor is of another kind or at another foot.
    """
    joints = [mj_model.joint(i).name for i in range(1, mj_model.njnt)]
    if joints != list(config.joints):
      raise ConfigError(f"env.robot.joints must name the model's joints in their order: {', '.join(joints)}.")
    on_joint = mj_model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    parts = zip(on_joint, mj_model.actuator_trnid[:, 0], strict=True)
    driven = [mj_model.joint(i).name if joint else "another part" for joint, i in parts]
    if driven != joints:
      missing = [name for name in joints if name not in driven]
      found = f"there is none for {', '.join(missing)}" if missing else f"its servos drive {', '.join(driven)}"
      raise ConfigError(f"env.robot.mjcf needs a servo for each joint, in the order of the joints: {found}.")
    _check_lengths(config)
    super().__init__(mj_model, joints, config.sensors)
    self.init_qpos = self.keyframe(config.keyframe)
    self.default_pose = self.init_qpos[7:]
    self.joint_range, self.target_range = _ranges(mj_model, joints, config.get("target_range"))
    self.root = self.find("body", config.root, "env.robot.root")
    self.base_site = self.find("site", config.base_site, "env.robot.base_site")
    self.foot_names = tuple(config.feet)
    self.feet = np.array([self.find("site", name, "env.robot.feet") for name in config.feet])
    self.pose_weights = jnp.array(config.get("pose_weights", [1.0] * len(joints)))
    groups = {group: list(config[group]) for group in ("hips", "hip_rolls", "knees") if config.get(group)}
    for group, names in groups.items():
      for name in names:
        self.find_joints(name, f"env.robot.{group}")
    self.joint_groups = groups
    self.contact_groups: dict[str, np.ndarray] = {}
    for group in ("self_contact", "fatal_contact"):
      self.add_contact_group(group, config.get(group, ()))
    self._foot_contact = [self._addresses(sensors, "foot_contact") for sensors in config.foot_contact]
    self._foot_rows = {
      key: np.array([self.rows(name, f"env.robot.{key}") for name in config.get(key, ())])
      for key in ("foot_linvel", "foot_pos", "foot_force")
    }
    for name, sensor in config.sensors.items():
      if name in _KINDS:
        self._check_kind(sensor, f"env.robot.sensors.{name}", _KINDS[name])
    for key in self._foot_rows:
      for foot, sensor in zip(self.feet, config.get(key, ()), strict=False):  # some robots have none
        self._check_kind(sensor, f"env.robot.{key}", _KINDS[key])
        self._check_foot(sensor, f"env.robot.{key}", foot)
    for foot, sensors in zip(self.feet, config.foot_contact, strict=True):
      for sensor in sensors:
        self._check_foot(sensor, "env.robot.foot_contact", foot)
    self._subtree = [self.root]  # a child's id is always above its parent's
    for body in range(self.root + 1, mj_model.nbody):
      if mj_model.body_parentid[body] in self._subtree:
        self._subtree.append(body)
    self._gaits = dict(config.get("gaits", {}))
    self.left_to_right = dict(config.get("mirror") or {})

  def keyframe(self, name: str) -> jax.Array:
    """Returns the configuration of a keyframe, shape [nq]; raises UnknownNameError if there is none of that name."""
    return jnp.array(self.mj_model.key_qpos[self.find("key", name, "env.robot.keyframe")])

  def add_contact_group(self, name: str, sensors: Sequence[str]) -> None:
    """Names a group of contact sensors for `touching`."""
    self.contact_groups[name] = self._addresses(sensors, name)

  def _addresses(self, sensors: Sequence[str], key: str) -> np.ndarray:
    return np.array([self.rows(sensor, f"env.robot.{key}")[0] for sensor in sensors], int)

  def _check_kind(self, sensor: str, key: str, kind: mujoco.mjtSensor) -> None:
    """Raises ConfigError where a sensor of the model is of another kind."""
    found = mujoco.mjtSensor(self.mj_model.sensor_type[self.find("sensor", sensor, key)])
    if found != kind:
      is_kind, needed = (it.name.removeprefix("mjSENS_").lower() for it in (found, kind))
      raise ConfigError(f"{key}: the sensor {sensor} is a {is_kind}, and must be a {needed}.")

  def _check_foot(self, sensor: str, key: str, foot: int) -> None:
    """Raises ConfigError where a sensor is on the body of another foot than that of the site `foot`."""
    model, index = self.mj_model, self.find("sensor", sensor, key)
    kind, part = mujoco.mjtObj(model.sensor_objtype[index]), model.sensor_objid[index]
    bodies = {mujoco.mjtObj.mjOBJ_SITE: model.site_bodyid, mujoco.mjtObj.mjOBJ_GEOM: model.geom_bodyid}
    body = bodies[kind][part] if kind in bodies else part
    others = {model.site_bodyid[site]: name for site, name in zip(self.feet, self.foot_names, strict=True)}
    if body in others and body != model.site_bodyid[foot]:
      needed = model.site(foot).name
      raise ConfigError(f"{key}: the sensor {sensor} is at the foot {others[body]}, and must be at {needed}.")

  def find_feet(self, feet: Sequence[str], key: str = "feet") -> np.ndarray:
    """Returns the indices of feet in `feet` by their names; raises UnknownNameError."""
    order = {name: i for i, name in enumerate(self.foot_names)}
    return np.array([lookup(order, name, key) for name in feet], int)

  def check_names(self, params: Mapping[str, Any], key: str) -> None:
    """As `Robot.check_names`; `feet` and `keyframe` count, too."""
    super().check_names(params, key)
    self.find_feet(params.get("feet", ()), f"{key}.feet")
    if "keyframe" in params:
      self.find("key", params["keyframe"], f"{key}.keyframe")

  def gait(self, name: str, key: str = "params.modes") -> list[float]:
    """Returns the feet's phases at the start of a gait, rad; raises ConfigError if there is not one for each foot."""
    if not self._gaits:
      raise ConfigError(f"env.robot.gaits is empty or missing, so that there is no gait {name!r}.")
    phases = lookup(self._gaits, name, key)
    if len(phases) != len(self.feet):
      raise ConfigError(f"env.robot.gaits.{name} must hold {len(self.feet)} phases, one for each foot.")
    return list(phases)

  def foot_sensors(self, data: PhysicsData, key: str) -> jax.Array:
    """Returns the readings of the feet's sensors, shape [feet, 3]; raises ConfigError if the robot has none.

    `key` is `foot_linvel` (world velocities, m/s), `foot_pos` (positions in the frame of the base site, m) or
    `foot_force` (force between foot and leg in the foot site's frame, N).
    """
    return data.sensordata[self._present(key, self._foot_rows[key])]

  def touching(self, data: PhysicsData, group: str) -> jax.Array:
    """Returns which contacts of a group (`contact_groups`) there are, bool [contacts]; raises ConfigError for none."""
    found = lookup(self.contact_groups, group, "contacts of a robot on legs")
    return data.sensordata[self._present(group, found)] > 0

  def _present(self, key: str, found: np.ndarray) -> np.ndarray:
    if not found.size:
      raise ConfigError(f"env.robot.{key} is empty or missing.")
    return found

  def contact(self, data: PhysicsData) -> jax.Array:
    """Returns whether each foot touches the floor, bool, shape [feet]: any of its contact sensors is above 0."""
    return jnp.stack([(data.sensordata[address] > 0).any() for address in self._foot_contact])

  def mass(self, model: mjx.Model) -> jax.Array:
    """Returns the mass that a push on `root` moves, kg: the root's and that of all it carries."""
    return model.body_mass[np.array(self._subtree)].sum()


def _ranges(mj_model: mujoco.MjModel, joints: Sequence[str], own: Any) -> tuple[jax.Array, jax.Array]:
  """Returns the limits of joints and of their targets, rad, each [2, joints]; `own` is `target_range` of the YAML.

  A servo without a range has that of its joint, and the other way round.

  Raises:
    ConfigError: neither of them has one.
  """
  limited, ranged = mj_model.jnt_limited[1:].astype(bool), mj_model.actuator_ctrllimited.astype(bool)
  if unlimited := [joint for joint, any_range in zip(joints, limited | ranged, strict=True) if not any_range]:
    raise ConfigError(f"env.robot.mjcf needs a range for each joint or for its servo: {', '.join(unlimited)} has none.")
  of_joints, of_servos = mj_model.jnt_range[1:].T, mj_model.actuator_ctrlrange.T
  targets = [own.lower, own.upper] if own else np.where(ranged, of_servos, of_joints)
  return jnp.array(np.where(limited, of_joints, of_servos)), jnp.array(targets)


def _check_lengths(config: Any) -> None:
  """Raises ConfigError where a list of `env.robot` does not have one entry for each foot or joint."""
  if not config.feet:
    raise ConfigError("env.robot.feet must name one foot or more.")
  own = config.get("target_range") or {}
  per_joint = {"pose_weights": config.get("pose_weights"), **{f"target_range.{end}": own[end] for end in own}}
  per_foot = {"foot_linvel": config.foot_linvel, "foot_contact": config.foot_contact}
  per_foot |= {key: config.get(key) or None for key in ("foot_pos", "foot_force")}  # some robots have none
  for what, names, lists in (("joint", config.joints, per_joint), ("foot", config.feet, per_foot)):
    for key, entries in lists.items():
      if entries is not None and len(entries) != (needed := len(names)):
        raise ConfigError(f"env.robot.{key} has {len(entries)} entries: it must have {needed}, one for each {what}.")
  if len(set(config.feet)) < len(config.feet) or not all(config.foot_contact or ()):
    raise ConfigError("env.robot.feet must name each foot once, and env.robot.foot_contact a sensor or more for each.")


class LeggedContext(StepContext):
  """A step of a robot on legs.

  `info` has `feet_air_time` (s), `swing_peak` (m) and `last_contact` (bool), each of shape [feet], as they stood before
  the step, in tasks that track feet.
  """

  robot: "LeggedRobot"

  @functools.cached_property
  @mirrors_as("feet")
  def contact(self) -> jax.Array:
    """Which feet touch the floor, bool [feet]."""
    return self.robot.contact(self.data)

  @functools.cached_property
  @mirrors_as("feet")
  def feet_air_time(self) -> jax.Array:
    """How long each foot has been in the air, this step included, s [feet]."""
    return self.info["feet_air_time"] + self.dt

  @functools.cached_property
  @mirrors_as("feet")
  def swing_peak(self) -> jax.Array:
    """Highest z of each foot since it last touched, m [feet]."""
    return jnp.maximum(self.info["swing_peak"], self.feet_height)

  @property
  @mirrors_as("feet")
  def first_contact(self) -> jax.Array:
    """Which feet have landed, bool [feet]: one that touched in the step before but left since has, too."""
    return (self.info["feet_air_time"] > 0) & (self.contact | self.info["last_contact"])

  @property
  def still(self) -> jax.Array:
    """Whether the command asks to stand still, bool."""
    return is_still(self.command)

  @property
  def phase(self) -> jax.Array:
    """Phases of the feet in the gait, rad [feet]."""
    return self.info["phase"]

  @property
  @mirrors_as("polar")
  def gravity(self) -> jax.Array:
    """Direction of gravity in the base frame [3]."""
    return -self.data.site_xmat[self.robot.base_site][2]

  @property
  @mirrors_as("same")
  def base_height(self) -> jax.Array:
    """World z of the base site, m [1]."""
    return self.data.site_xpos[self.robot.base_site, 2]

  @property
  @mirrors_as("polar")
  def forward(self) -> jax.Array:
    """The base site's forward axis in the world frame [3]."""
    return self.data.site_xmat[self.robot.base_site][:, 0]

  @property
  @mirrors_as("feet")
  def feet_height(self) -> jax.Array:
    """World z of the foot sites, m [feet]."""
    return self.data.site_xpos[self.robot.feet, 2]

  @property
  @mirrors_as("feet_polar")
  def feet_velocity(self) -> jax.Array:
    """World velocities of the feet, m/s [feet, 3]."""
    return self.robot.foot_sensors(self.data, "foot_linvel")


def is_still(command: jax.Array) -> jax.Array:
  """Returns whether a velocity command asks to stand still, bool: its norm is at most 0.01."""
  return jnp.linalg.norm(command) <= 0.01


def swing_height(phase: jax.Array, peak: jax.Array | float) -> jax.Array:
  """Returns how high a foot should be at its phase: `peak` times 3u² - 2u³, u rising to 1 at phase 0 and falling back.

  (Paper, appendix "Locomotion", feet phase. The polynomial goes on beyond +- pi.)
  """
  place = (phase + jnp.pi) / (2 * jnp.pi)
  rise, fall = 2 * place, 2 * place - 1
  smooth = lambda u: 3 * u**2 - 2 * u**3
  return peak * jnp.where(place <= 0.5, smooth(rise), 1 - smooth(fall))
