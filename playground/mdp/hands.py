"""A hand with a cube: its constant facts, and what terms read of it in a step."""

import functools
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from playground.envs.physics import PhysicsData, mjx
from playground.errors import ConfigError, UnknownNameError, nearest
from playground.mdp.context import StepContext
from playground.mdp.lookup import lookup
from playground.mdp.pose_noise import Pose
from playground.mdp.rotations import angle_between

if TYPE_CHECKING:
  from playground.envs.manipulation.in_hand import HandTask


class Hand:
  """A hand's constant facts, found in the compiled scene (`playground.robots.in_hand`).

  The joints of the hand come first in `qpos` and `qvel`, the cube's free joint is the last.

  Attributes:
    qpos, qvel: where the joints are in `qpos` and `qvel`.
    joint_names: of the hand.
    init_qpos: configuration of the keyframe `home`, shape [nq].
    default_pose: its joint part, rad, shape [joints].
    default_ctrl: targets that hold it, shape [nu].
    joint_range: (lower, upper) limits of the joints, rad, shape [2, joints].
    target_range: (lower, upper) limits of the targets, shape [2, nu].
    has_servos: whether each joint has a position servo of its own; else tendons pull it.
    cube: id of the cube's body.
    cube_qpos: where the cube's position and orientation are in `qpos`.
  """

  def __init__(self, mj_model: mujoco.MjModel, config: Any):
    """Looks the names up.

    Args:
      mj_model: the compiled scene.
      config: `env.robot`: `sensors` holds lists of the scene's sensors by the name that terms read.

    Raises:
      UnknownNameError: the model has no sensor of that name.
      ConfigError: a list of names is empty.
    """
    home, joints = mj_model.key("home"), mj_model.njnt - 1
    self.qpos = self.qvel = slice(0, joints)
    self.joint_names = tuple(mj_model.joint(i).name for i in range(joints))
    self.init_qpos = jnp.array(home.qpos)
    self.default_pose = self.init_qpos[self.qpos]
    self.default_ctrl = jnp.array(home.ctrl)
    self.joint_range = jnp.array(mj_model.jnt_range[:joints].T)
    self.target_range = jnp.array(mj_model.actuator_ctrlrange.T)
    self.has_servos = mj_model.nu == joints
    self.cube: int = mj_model.body("cube").id
    self.cube_qpos = slice(joints, joints + 7)
    rows = {
      mj_model.sensor(i).name: np.arange(mj_model.sensor_dim[i]) + mj_model.sensor_adr[i]
      for i in range(mj_model.nsensor)
    }
    for key, names in config.sensors.items():
      if not names:
        raise ConfigError(f"env.robot.sensors.{key} must name one or more.")
    self._sensors = rows | {
      key: np.concatenate([lookup(rows, name, f"env.robot.sensors.{key}") for name in names])
      for key, names in config.sensors.items()
    }

  def sensor(self, data: PhysicsData, name: str) -> jax.Array:
    """Returns the reading of a sensor, by its key in `sensors` of the hand's YAML or its name in the scene."""
    return data.sensordata[lookup(self._sensors, name, "env.robot.sensors")]

  def find_joints(self, joints: str | Sequence[str]) -> np.ndarray:
    """Returns the indices of joints whose whole names match a regular expression, or one of several.

    Raises:
      UnknownNameError: one that matches no joint.
    """
    found: set[int] = set()
    for pattern in (joints,) if isinstance(joints, str) else joints:
      matches = {i for i, name in enumerate(self.joint_names) if re.fullmatch(pattern, name)}
      if not matches:
        near = nearest(pattern, self.joint_names)
        raise UnknownNameError(f"joints={pattern!r} matches no joint of the hand.{near}")
      found |= matches
    return np.array(sorted(found))

  def cube_mass(self, model: mjx.Model) -> jax.Array:
    """Returns the mass of the cube, kg."""
    return model.body_mass[self.cube]


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
