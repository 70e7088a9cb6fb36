"""Arms at a table: scene, servo targets and success. The terms of a task's config define everything else."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco

from playground.envs.base import State
from playground.envs.task import InitialState, Task
from playground.errors import ConfigError
from playground.mdp.manipulators import ArmContext, ArmRobot
from playground.mdp.terms import Term
from playground.physics.backend import PhysicsData, mjx
from playground.robots.tabletop import build_tabletop


class TabletopTask(Task):
  """A scene whose keyframe is the start. By default an action adds to the targets of the servos.

  The reward of a step is the terms' total, not its product with the control step.

  Metrics of an evaluation: `success` is whether the object is within `success_distance` of the goal, and within
  `success_angle` of its turn where that is given, when the episode ends; `position_error_cm` is how far it is then.

  Attributes:
    object: name of the body of `c.object_pos`, `c.goal_angle`, ...; None if the config names none.
    gripper: name of the site at the tip of the gripper; None if the config names none.
  """

  context = ArmContext
  derived = ("sensordata", "actuator_force", "qacc", "xpos", "xquat", "xmat", "site_xpos", "site_xmat")
  summaries: ClassVar[Mapping[str, str]] = {"success": "last", "position_error_cm": "last"}
  arm_joints = r"joint\d"  # regular expression of the names of the arms' joints

  robot: ArmRobot

  def __init__(self, config: Any):
    """Builds the scene and binds the terms; `config` is that of `configs/env/_panda.yaml` or `_aloha.yaml`."""
    self.object, self.gripper = config.get("object"), config.get("gripper")
    super().__init__(config, build_tabletop(config.scene))
    self._action_scale = self.scales(config.action_scale)

  def make_robot(self, mj_model: mujoco.MjModel, config: Any) -> ArmRobot:
    return ArmRobot(mj_model, config.keyframe, self.arm_joints)

  def rest_ctrl(self, initial: InitialState) -> jax.Array:
    return self.robot.init_ctrl

  def action_to_ctrl(self, state: State, action: jax.Array) -> jax.Array:
    return jnp.clip(state.data.ctrl + self._action_scale * action, *self.robot.ctrl_range)

  def goal_distance(self, c: ArmContext) -> jax.Array:
    """Returns how far the object is from the goal as success counts it, m."""
    return jnp.linalg.norm(c.object_to_goal)

  def at_goal(self, c: ArmContext) -> jax.Array:
    """Returns whether the object is where it should be, bool."""
    return (self.goal_distance(c) < self.config.success_distance) & self.turned(c)

  def turned(self, c: ArmContext) -> jax.Array:
    """Returns whether the object is turned as it should be, bool; true without a `success_angle`."""
    angle = self.config.get("success_angle")
    return jnp.array(True) if angle is None else c.goal_angle < angle

  def measure(self, c: ArmContext) -> dict[str, jax.Array]:
    return {"success": c.at_goal.astype(jnp.float32), "position_error_cm": 100 * jnp.linalg.norm(c.object_to_goal)}

  def total(self, rewards: Mapping[str, jax.Array]) -> jax.Array:
    return super().total(rewards) / self.dt


class ArmTask(TabletopTask):
  """A Panda's hand reaches an object, then takes it to the goal (paper, appendix "Manipulation").

  An action adds to the targets of the servos: the arm's seven joints and the fingers. `info["reached_box"]` is whether
  the hand has reached the object in this episode. What differs from Playground 0.2.0 is in docs/differences.md. A
  further metric, `rotation_error_deg`, is how far the object is turned from the goal when the episode ends.
  """

  episode_info = ("reached_box",)
  summaries: ClassVar[Mapping[str, str]] = {"rotation_error_deg": "last"}

  def first_info(self, data: PhysicsData, key: jax.Array, model: mjx.Model) -> dict[str, Any]:
    return super().first_info(data, key, model) | {"reached_box": jnp.zeros(())}

  def next_info(self, c: ArmContext, key: jax.Array) -> dict[str, Any]:
    return super().next_info(c, key) | {"reached_box": c.reached}

  def measure(self, c: ArmContext) -> dict[str, jax.Array]:
    return super().measure(c) | {"rotation_error_deg": jnp.rad2deg(c.goal_angle)}


class Bimanual(TabletopTask):
  """Two arms at a table; an action adds to the targets of the servos of all joints and of both grippers.

  The weighted mean of the terms is the reward, or the potential whose gain is the reward. The model is that of
  Playground 0.2.0 with its upstream bug: capsules `right_finger_bottom` lie across the palm, not along the finger.
  """

  arm_joints = r"(left|right)/(?!.*_finger).*"

  def __init__(self, config: Any):
    super().__init__(config)
    need_weights(self.rewards.terms)

  def total(self, rewards: Mapping[str, jax.Array]) -> jax.Array:
    return super().total(rewards) / sum(term.options.weight for term in self.rewards.terms)


def need_weights(terms: Sequence[Term]) -> None:
  """Raises ConfigError where the weighted mean of reward terms has no value."""
  if sum(term.options.weight for term in terms) <= 0:
    raise ConfigError("env.rewards: the reward is the terms' weighted mean: their weights must add up to more than 0.")


class ProgressTask(TabletopTask):
  """Rewards the gain of the terms' total over its best so far in the episode: going back and forth earns nothing.

  The first step has no reward, since the value of the initial state is no progress.
  """

  # `first_step`: no step was made since the reset.
  episode_info = ("first_step", "best_potential")

  def first_info(self, data: PhysicsData, key: jax.Array, model: mjx.Model) -> dict[str, Any]:
    begin = {"first_step": jnp.ones((), bool), "best_potential": jnp.zeros(())}
    return super().first_info(data, key, model) | begin

  def next_info(self, c: ArmContext, key: jax.Array) -> dict[str, Any]:
    return super().next_info(c, key) | {"first_step": jnp.zeros((), bool)}

  def bonus(self, c: ArmContext, potential: jax.Array) -> jax.Array:
    """Returns the reward besides the gain, from the terms' total."""
    return jnp.zeros(())

  def clipped(self, reward: jax.Array) -> jax.Array:
    return reward  # of the potential: `post_step` clips the gain

  def post_step(self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array) -> State:
    state = super().post_step(data, info, action)
    potential, best = state.reward, info["best_potential"]
    reward = jnp.maximum(potential - best, 0.0) + self.bonus(ArmContext(self, data, info, action), potential)
    best = {"best_potential": jnp.maximum(potential, best)}
    return state.replace(reward=super().clipped(jnp.where(info["first_step"], 0.0, reward)), info=state.info | best)
