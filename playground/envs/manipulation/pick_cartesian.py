"""A Panda that picks up a cube with a hand that moves in a plane."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from playground.envs.base import State
from playground.envs.manipulation.arm import ArmTask, ProgressTask
from playground.envs.task import InitialState
from playground.mdp import delays
from playground.mdp.manipulators import ArmContext
from playground.physics.backend import PhysicsData, mjx
from playground.robots.panda.kinematics import forward_kinematics, inverse_kinematics, within_limits

WORKSPACE = jnp.array([[0.25, -0.32, 0.02], [0.77, 0.32, 0.5]])  # m, where the tip may be sent
_BEHIND = 0.03  # m, by which cube and goal are nearer to the base than the tip at the start
_GOAL_HEIGHT = 0.2  # m
_GRIP_STEP = 0.02  # m: two steps close the open fingers


class PickCubeCartesian(ProgressTask, ArmTask):
  """Lifts a cube to a goal above the middle of where it may lie (paper, appendix "Manipulation").

  Actions: where the hand's tip goes along y and z, in parts of `action_scale`, and whether the fingers close (below 0)
  or open. Inverse kinematics turn the tip's place into the joints' targets; the hand keeps its attitude and joint 7 its
  angle. The reward is the gain of the terms' total over its best so far in the episode. Some episodes begin with the
  cube in the hand.
  """

  episode_info = ("reached_box", "current_pos", "no_solution", "action_history")

  def __init__(self, config: Any):
    """Builds the scene. `config`: see `configs/env/PandaPickCubeCartesian.yaml`."""
    super().__init__(config)
    self._tip, self.attitude = forward_kinematics(self.robot.init_ctrl[:7])
    guide = self.mj_model.key("picked")
    self._guide_qpos, self._guide_ctrl = jnp.array(guide.qpos), jnp.array(guide.ctrl)
    self._guide_tip, _ = forward_kinematics(self._guide_ctrl[:7])

  @property
  def action_size(self) -> int:
    return 3

  def initial_state(self, key: jax.Array, model: mjx.Model) -> InitialState:
    initial = super().initial_state(key, model)
    x = self._tip[0] - _BEHIND
    box = self.robot.free_joint("box")
    place = jnp.stack([x, jnp.zeros(()), self.robot.init_qpos[box][2]])
    goal = place.at[2].set(_GOAL_HEIGHT)
    return initial.replace(qpos=initial.qpos.at[box].set(place), mocap_pos=goal[None])

  def first_info(self, data: PhysicsData, key: jax.Array, model: mjx.Model) -> dict[str, Any]:
    return super().first_info(data, key, model) | {
      "current_pos": self._tip,
      "no_solution": jnp.zeros(()),
      "action_history": jnp.zeros(self.config.gripper_delay + 1),
      "action_delay": delays.draw_delay(key, (0, self.config.gripper_delay)),
    }

  def pre_step(self, state: State) -> State:
    """Puts the cube into the hand before the first step of some episodes."""
    state = super().pre_step(state)
    rng, key = jax.random.split(state.info["rng"])
    guided = state.info["first_step"] & jax.random.bernoulli(key, self.config.guide_probability)
    choose = lambda guide, own: jnp.where(guided, guide, own)
    qpos, ctrl = choose(self._guide_qpos, state.data.qpos), choose(self._guide_ctrl, state.data.ctrl)
    info = {"rng": rng, "current_pos": choose(self._guide_tip, state.info["current_pos"])}
    # The fingers hold the cube because of a command to close: a delayed command must not drop it.
    info["action_history"] = choose(-1.0, state.info["action_history"])
    return state.replace(data=state.data.replace(qpos=qpos, ctrl=ctrl), info=state.info | info)

  def action_to_ctrl(self, state: State, action: jax.Array) -> jax.Array:
    action, _ = self._delayed(state.info, action)
    _, joints, solved = self._plan(state.data.ctrl, state.info, action)
    arm = jnp.where(solved, joints, state.data.ctrl[:7])
    fingers = state.data.ctrl[7] + jnp.where(action[2] < 0, -_GRIP_STEP, _GRIP_STEP)
    return jnp.clip(jnp.append(arm, fingers), *self.robot.ctrl_range)

  def post_step(self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array) -> State:
    action, history = self._delayed(info, action)
    # From the servos' new targets this is the plan that they came from: joint 7 is the same, and so is the branch.
    tip, _, solved = self._plan(data.ctrl, info, action)
    state = super().post_step(data, {**info, "no_solution": 1 - solved.astype(jnp.float32)}, action)
    return state.replace(info=state.info | {"current_pos": tip, "action_history": history})

  def next_info(self, c: ArmContext, key: jax.Array) -> dict[str, Any]:
    return super().next_info(c, key) | {"action_delay": delays.draw_delay(key, (0, self.config.gripper_delay))}

  def _delayed(self, info: Mapping[str, Any], action: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the action with the gripper's entry of some steps ago, and the history of that entry."""
    history = delays.push(info["action_history"], action[2])
    return action.at[2].set(delays.delayed(history, info["action_delay"])), history

  def _plan(
    self, ctrl: jax.Array, info: Mapping[str, Any], action: jax.Array
  ) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Returns the tip's target, its joint angles, and whether the arm can reach it; otherwise the tip stays."""
    step = self._action_scale * jnp.array([0.0, action[0], action[1]])
    tip = jnp.clip(info["current_pos"] + step, *WORKSPACE)
    joints = inverse_kinematics(tip, self.attitude, ctrl[6], near=ctrl[:7])
    solved = within_limits(joints)
    return jnp.where(solved, tip, info["current_pos"]), joints, solved


class PickCubeCartesianVision(PickCubeCartesian):
  """Lifts a cube to the goal's height (paper, section IV-C and appendix C.6); `env.vision` defines the images."""

  def goal_distance(self, c: ArmContext) -> jax.Array:
    return jnp.abs(c.object_to_goal[2])
