"""Arms at a table: scene and servo targets. All else of a task is terms of its config."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from playground.envs.base import State
from playground.envs.task import InitialState, Task
from playground.mdp.arms import ArmContext, ArmRobot
from playground.robots.tabletop import build_tabletop


class TabletopTask(Task):
  """A scene whose keyframe is the start. By default an action adds to the targets of the servos.

  The reward of a step is the terms' total, not its product with the control step.

  Attributes:
    object: name of the body that `c.object_pos` and its like are of; None where the config names none.
    gripper: name of the site at the tip of the gripper, likewise.
  """

  context = ArmContext
  derived = ("sensordata", "actuator_force", "qacc", "xpos", "xquat", "xmat", "site_xpos", "site_xmat")
  arm_joints = r"joint\d"  # regular expression of the names of the arms' joints

  robot: ArmRobot

  def __init__(self, config: Any):
    """Builds the scene and binds the terms.

    Args:
      config: the task's ConfigDict: that of `Task`, `scene` (`playground.robots.tabletop`), `action_scale`, `keyframe`,
        `object` and `gripper`.

    Raises:
      UnknownNameError: a term, parameter or object of the model that does not exist.
      ConfigError: a value that is invalid.
    """
    self.object, self.gripper = config.get("object"), config.get("gripper")
    super().__init__(config, build_tabletop(config.scene))
    self._action_scale: float = config.action_scale

  def make_robot(self, mj_model: mujoco.MjModel, config: Any) -> ArmRobot:
    return ArmRobot(mj_model, config.keyframe, self.arm_joints)

  def rest_ctrl(self, initial: InitialState) -> jax.Array:
    return self.robot.init_ctrl

  def action_to_ctrl(self, state: State, action: jax.Array) -> jax.Array:
    return jnp.clip(state.data.ctrl + self._action_scale * action, *self.robot.ctrl_range)

  def at_goal(self, c: ArmContext) -> jax.Array:
    """Whether the object is where it should be, bool."""
    raise NotImplementedError

  def total(self, rewards: Mapping[str, jax.Array]) -> jax.Array:
    return super().total(rewards) / self.dt
