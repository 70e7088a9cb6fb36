"""The arguments of terms: a robot's constants, and one environment after one control step."""

import functools
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import mujoco
import numpy as np

from playground.errors import ConfigError, UnknownNameError, lookup, nearest
from playground.mdp.options import mirrors_as
from playground.physics.backend import PhysicsData
from playground.settings import is_text, plain
from playground.text import format_value

if TYPE_CHECKING:
  from playground.envs.task import Task


class Robot:
  """A robot's constants, found in the compiled model by name.

  Attributes:
    mj_model: the compiled scene.
    joint_names: of the joints that `c.joint_pos` holds, in its order.
    qpos, qvel: where those joints are in `qpos` and `qvel`.
    init_qpos: configuration of the keyframe, shape [nq].
    default_pose: positions of those joints in `init_qpos`, rad, shape [joints].
    joint_range: (lower, upper) limits of those joints, rad, shape [2, joints].
    joint_groups: regular expressions of joint names, by the name of a group.
    ground_peak: height of the highest ground where robots start, m.
  """

  ground_peak = 0.0

  def __init__(self, mj_model: mujoco.MjModel, joints: Sequence[str], sensors: Mapping[str, Any] | None = None):
    """Looks up names; `sensors` maps a name that terms read to a sensor of the model, or to several in a row.

    Raises:
      ConfigError: the model has no sensor of that name, or a list of sensors is empty.
    """
    self.mj_model = mj_model
    self.joint_names = tuple(joints)
    self.joint_groups: dict[str, Sequence[str]] = {}
    starts, sizes = mj_model.sensor_adr, mj_model.sensor_dim
    self._rows = {mj_model.sensor(i).name: starts[i] + np.arange(sizes[i]) for i in range(mj_model.nsensor)}
    for name, parts in (sensors or {}).items():
      key = f"env.robot.sensors.{name}"
      if not parts or not (isinstance(parts, str) or is_text(parts, 1)):
        raise ConfigError(f"{key}={format_value(plain(parts))} must name a sensor, or be a list of names.")
      self._rows[name] = np.concatenate([self.rows(p, key) for p in ([parts] if isinstance(parts, str) else parts)])

  def find(self, kind: str, name: str, key: str = "env.robot") -> int:
    """Returns the id of a `body`, `site`, `geom`, `sensor` or `key`; raises UnknownNameError."""
    index = mujoco.mj_name2id(self.mj_model, mujoco.mju_str2Type(kind), name)
    if index < 0:
      names = [getattr(self.mj_model, kind)(i).name for i in range(getattr(self.mj_model, f"n{kind}"))]
      what = "keyframe" if kind == "key" else kind
      raise UnknownNameError(f"{key} names the {what} {name!r}, which the model does not have.{nearest(name, names)}")
    return index

  def rows(self, sensor: str, key: str = "sensor") -> np.ndarray:
    """Returns where a sensor's reading is in `sensordata`; raises UnknownNameError."""
    return lookup(self._rows, sensor, key)

  def sensor(self, data: PhysicsData, name: str) -> jax.Array:
    """Returns the reading of a sensor, by its name in the robot's YAML or in the model; raises UnknownNameError."""
    return data.sensordata[self.rows(name)]

  def find_joints(self, joints: str | Sequence[str], key: str = "joints") -> np.ndarray:
    """Returns the indices of joints, in the order of `joint_names`.

    `joints` is a group of `joint_groups`, a regular expression that matches whole names, or several of them.

    Raises:
      UnknownNameError: one matches no joint.
      ConfigError: one is no regular expression, or there is none.
    """
    found: set[int] = set()
    for name in (joints,) if isinstance(joints, str) else joints:
      patterns = self.joint_groups.get(name, [name])
      try:
        matches = {i for i, joint in enumerate(self.joint_names) if any(re.fullmatch(p, joint) for p in patterns)}
      except re.error as error:
        raise ConfigError(f"{key}={name!r} is no regular expression, such as '.*_hip_joint': {error}.") from None
      if not matches:
        known = [*self.joint_groups, *self.joint_names]
        no_group = "and is no group of joints in its YAML"
        raise UnknownNameError(f"{key}={name!r} matches no joint of the robot {no_group}.{nearest(name, known)}")
      found |= matches
    if not found:
      raise ConfigError(f"{key}=[] must name one joint or more.")
    return np.array(sorted(found))

  def check_names(self, params: Mapping[str, Any], key: str) -> None:
    """Raises UnknownNameError where `params` of a term name parts that the robot or its scene does not have.

    Those are `joints`, `sensor`, `sensors`, `body`, `site` and `geom`.
    """
    if "joints" in params:
      self.find_joints(params["joints"], f"{key}.joints")
    for name in ("sensor", "sensors"):
      for sensor in (params[name],) if isinstance(params.get(name), str) else params.get(name, ()):
        self.rows(sensor, f"{key}.{name}")
    for kind in ("body", "site", "geom"):
      if isinstance(params.get(kind), str):
        self.find(kind, params[kind], f"{key}.{kind}")


def need_free_root(env: "Task") -> None:
  """Raises ConfigError where the model's first joint is not free: `qpos[:7]` and `qvel[:6]` are of other joints."""
  model = env.mj_model
  if not model.njnt or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
    raise ConfigError("it needs a free joint as the first of the model, which this task does not have.")


def root_qpos(c: "StepContext") -> jax.Array:
  """Returns the root's position, m, and orientation [7]; raises ConfigError where the first joint is not free."""
  need_free_root(c.env)
  return c.data.qpos[:7]


class _Info(dict[str, Any]):
  """Entries of `info`, of which a missing one is an error of the configuration."""

  def __missing__(self, name: str) -> Any:
    raise ConfigError(f"it reads info[{name!r}], which this task does not have; a command or an event must write it.")


class StepContext:
  """One environment after one control step, before the bookkeeping for the next. Arrays have no batch axis.

  Attributes:
    env: the task: its model and control step `dt`.
    robot: the robot's constants.
    data: the physics after the step.
    info: the `info` of the task during the step; an entry that it does not have raises ConfigError.
    action: the action just applied, shape [action_size].
    dt: time since the step before, s; 0 at the start of an episode.
  """

  def __init__(
    self, env: "Task", data: PhysicsData, info: Mapping[str, Any], action: jax.Array, dt: float | None = None
  ):
    self.env, self.robot = env, env.robot
    self.data = data
    self.info: Mapping[str, Any] = _Info(info)
    self.action = action
    self.dt = env.dt if dt is None else dt

  @functools.cached_property
  def terminated(self) -> jax.Array:
    """Whether any termination term ends the episode in this step, those with `time_out` aside, bool."""
    return self.env.terminations.any(self)

  @property
  @mirrors_as("joints")
  def last_act(self) -> jax.Array:
    """The action before the newest one, 0 at the start of an episode [action_size]."""
    return self.info["last_act"]

  @property
  @mirrors_as("joints")
  def action_before_last(self) -> jax.Array:
    """The action before `last_act` [action_size]."""
    return self.info["last_last_act"]

  @property
  @mirrors_as("joints")
  def joint_pos(self) -> jax.Array:
    """Joint positions, rad [joints]."""
    return self.data.qpos[self.robot.qpos]

  @property
  @mirrors_as("joints")
  def joint_vel(self) -> jax.Array:
    """Joint velocities, rad/s [joints]."""
    return self.data.qvel[self.robot.qvel]

  @property
  @mirrors_as("joints")
  def joint_pos_rel(self) -> jax.Array:
    """Joint positions relative to the default pose, rad [joints]."""
    return self.joint_pos - self.robot.default_pose

  @property
  @mirrors_as("command")
  def command(self) -> jax.Array:
    """Velocity command: forward m/s, left m/s, turn rad/s [3]."""
    return self.info["command"]

  def sensor(self, name: str) -> jax.Array:
    """Returns the reading of a sensor; see `Robot.sensor`."""
    return self.robot.sensor(self.data, name)
