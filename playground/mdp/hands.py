"""What rewards and observations of a hand with a cube are functions of: the hand and the present moment."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from playground.envs.physics import PhysicsData, mjx
from playground.mdp.lookup import lookup
from playground.mdp.pose_noise import Pose


class Hand:
  """A hand's fixed facts, found in the compiled scene (`playground.robots.in_hand`).

  Attributes:
    num_joints: hinges of the hand; they come first in `qpos` and `qvel`.
    home: `qpos` of the keyframe `home`, [nq].
    home_pose: its joints, rad, [num_joints].
    home_ctrl: the targets that hold it, [nu].
    joint_range: (lower, upper) limits of the joints, rad, [2, num_joints].
    target_range: (lower, upper) limits of the targets, [2, nu].
    has_servos: whether each joint has a position servo of its own; else tendons pull it.
    cube: id of the cube's body.
  """

  def __init__(self, mj_model: mujoco.MjModel, config: Any):
    """Looks the names up; `config` is `env.hand`.

    Raises:
      UnknownNameError: the model has no sensor of that name.
    """
    home = mj_model.key("home")
    self.num_joints: int = mj_model.njnt - 1  # the last is the cube's
    self.home = jnp.array(home.qpos)
    self.home_pose = self.home[: self.num_joints]
    self.home_ctrl = jnp.array(home.ctrl)
    self.joint_range = jnp.array(mj_model.jnt_range[: self.num_joints].T)
    self.target_range = jnp.array(mj_model.actuator_ctrlrange.T)
    self.has_servos = mj_model.nu == self.num_joints
    self.cube: int = mj_model.body("cube").id
    self._rows = {
      mj_model.sensor(i).name: np.arange(mj_model.sensor_dim[i]) + mj_model.sensor_adr[i]
      for i in range(mj_model.nsensor)
    }
    self._groups = {name: self._joined(config.sensors[name], f"env.hand.sensors.{name}") for name in config.sensors}
    self._fingertips = self._joined([f"{tip}_position" for tip in config.fingertips], "env.hand.fingertips")

  def _joined(self, names: Sequence[str], key: str) -> np.ndarray:
    return np.concatenate([lookup(self._rows, name, key) for name in names])

  def sensor(self, data: PhysicsData, name: str) -> jax.Array:
    """The reading of a sensor of the scene."""
    return data.sensordata[self._rows[name]]

  def sensors(self, data: PhysicsData, group: str) -> jax.Array:
    """The readings of the sensors that the hand's configuration has under `sensors.<group>`."""
    return data.sensordata[lookup(self._groups, group, "env.hand.sensors")]

  def fingertips(self, data: PhysicsData) -> jax.Array:
    """Where the fingertips are, in the frame of the palm, m, [3 * fingers]."""
    return data.sensordata[self._fingertips]

  def cube_mass(self, model: mjx.Model) -> jax.Array:
    """Mass of the cube, kg."""
    return model.body_mass[self.cube]


@dataclasses.dataclass(frozen=True)
class Context:
  """The present moment.

  Attributes:
    hand: fixed facts.
    data: physics after the step.
    info: what the task carried into the step.
    action: the action of the step, [action_size].
    sensed: the cube's pose as it is tracked, with noise.
    done: whether the episode ends here, bool.
  """

  hand: Hand
  data: PhysicsData
  info: Mapping[str, Any]
  action: jax.Array
  sensed: Pose
  done: jax.Array

  def sensor(self, name: str) -> jax.Array:
    """The reading of a sensor of the scene."""
    return self.hand.sensor(self.data, name)

  @property
  def joint_pos(self) -> jax.Array:
    """rad, [num_joints]."""
    return self.data.qpos[: self.hand.num_joints]

  @property
  def joint_vel(self) -> jax.Array:
    """rad/s, [num_joints]."""
    return self.data.qvel[: self.hand.num_joints]
