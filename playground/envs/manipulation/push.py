"""A Panda that pushes a block to a goal with torques, through delays and noise."""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from mujoco.mjx._src.math import axis_angle_to_quat, quat_mul

from playground.envs.base import State
from playground.envs.manipulation.arm import ArmTask, need_weights
from playground.envs.task import InitialState
from playground.envs.wrappers import PRESERVE_INFO
from playground.errors import ConfigError
from playground.mdp import delays
from playground.mdp.managers import ObservationManager
from playground.mdp.manipulators import ArmContext
from playground.physics.backend import PhysicsData, mjx

_ARM, _BOX = slice(0, 7), slice(13, 16)  # joints, and the block's position, in qpos
# Where the block and its goal may be drawn (m).
_PLACES = jnp.array([[0.4, -0.2, -0.005], [0.65, 0.2, 0.04]])
_SPREAD = jnp.array([0.4, 1.0, 0.0]), jnp.array([0.0, 0.0, 0.005])  # of places: in parts of a distance, and m
_BOX_SPREAD = 0.15  # m
ARM_SPREAD = 0.3 * jnp.array([0.2, 0.2, 0.2, 0.2, 0.3, 0.3, 0.3])  # of the joints' ranges
_BONUSES = ("is_terminated", "object_at_goal", "goal_reached")  # terms that are added to the mean of the others


class PushCube(ArmTask):
  """Pushes a foam block over a table to a goal and turns it as the goal (paper, section IV-C.2 and Appendix C.5).

  An action is a torque for each of the arm's seven joints, which acts some control steps later; the observation `state`
  is some steps old and noisy. The closed gripper pushes with its sides. Once the block has stayed at a goal for
  `success_steps` steps, that goal is reached and the next one appears. An environment's level rises with every goal,
  and with it how far a goal is moved and turned. The level outlasts episodes and full resets, but each episode begins
  with a goal of level 0, and evaluations begin with level 0.

  Metrics of an evaluation: `success` is whether the block reached a goal in any step, `success_1` and `success_2`
  whether it was within `success_distance` and within `success_angle` of one; `goals_reached` counts the goals of the
  episode; `curriculum_level`, `position_error_cm` and `rotation_error_deg` are those of the last step.
  """

  # `goal_reached`: the goal was reached in the last step, and the next one is yet to appear.
  episode_info = ("action_history", "applied_act", "goal_reached", "goals_reached", "goal_steps")
  summaries: ClassVar[Mapping[str, str]] = {
    "success": "max",
    "success_1": "max",
    "success_2": "max",
    "goals_reached": "last",  # so far, since a metric holds the last repeat of an action only
    "curriculum_level": "last",
  }

  def __init__(self, config: Any):
    """Builds the scene. `config`: see `configs/env/PandaRobotiqPushCube.yaml`."""
    if len(config.curriculum.distance) != len(config.curriculum.angle):
      raise ConfigError("env.curriculum.distance and env.curriculum.angle must have an entry for each level.")
    if config.reward_total != "sum":
      raise ConfigError(
        f"env.reward_total={config.reward_total}: this task's reward is a mean of terms: leave it at sum."
      )
    super().__init__(config)
    need_weights([term for term in self.rewards.terms if term.name not in _BONUSES])
    self._action_delay = tuple(config.action_delay)
    self.observations = ObservationManager(config, tuple(config.observation_delay))
    self._max_ctrl = jnp.array(config.max_torque / self.mj_model.actuator_gear[_ARM, 0])
    self._distances, self.angles = jnp.array(config.curriculum.distance), jnp.array(config.curriculum.angle)
    half = (self.robot.joint_range[1] - self.robot.joint_range[0]) / 2
    self.arm_spread = ARM_SPREAD * jnp.stack([-half, half])

  @property
  def action_size(self) -> int:
    return 7

  def initial_state(self, key: jax.Array, model: mjx.Model) -> InitialState:
    box_key, yaw_key, goal_key, arm_key, turn_key = jax.random.split(key, 5)
    home = self.robot.init_qpos
    box = self._draw_place(box_key, jnp.array(_BOX_SPREAD)).at[2].set(home[_BOX][2])
    box_quat = draw_yaw(yaw_key, 2 * jnp.pi)
    goal = self._draw_place(goal_key, self._distances[0])
    goal_quat = quat_mul(box_quat, draw_yaw(turn_key, self.angles[0]))
    low, high = self.arm_spread
    arm = home[_ARM] + jax.random.uniform(arm_key, (7,), minval=low, maxval=high)
    qpos = home.at[_ARM].set(arm).at[_BOX].set(box).at[_BOX.stop :].set(box_quat)
    return InitialState(qpos, jnp.zeros(self.mj_model.nv), mocap_pos=goal[None], mocap_quat=goal_quat[None])

  def first_info(self, data: PhysicsData, key: jax.Array, model: mjx.Model) -> dict[str, Any]:
    return super().first_info(data, key, model) | {
      "action_history": jnp.zeros((self._action_delay[1] + 1, 7)),
      "action_delay": delays.draw_delay(key, self._action_delay),
      "applied_act": jnp.zeros(7),
      "goal_steps": jnp.zeros((), jnp.int32),
      "goal_reached": jnp.zeros((), bool),
      "goals_reached": jnp.zeros(()),
      PRESERVE_INFO: {"curriculum_id": jnp.zeros((), jnp.int32)},
    }

  def pre_step(self, state: State) -> State:
    """Shows the next goal after one was reached; beyond the last level goals are as that one's."""
    state = super().pre_step(state)
    data, level, reached = state.data, state.info[PRESERVE_INFO]["curriculum_id"], state.info["goal_reached"]
    rng, place_key, turn_key = jax.random.split(state.info["rng"], 3)
    pos = self._draw_place(place_key, self._distances[level])
    quat = quat_mul(data.xquat[self.mj_model.body("box").id], draw_yaw(turn_key, self.angles[level]))
    pos, quat = jnp.where(reached, pos, data.mocap_pos[0]), jnp.where(reached, quat, data.mocap_quat[0])
    data = data.replace(mocap_pos=pos[None], mocap_quat=quat[None])
    return state.replace(data=data, info=state.info | {"rng": rng})

  def action_to_ctrl(self, state: State, action: jax.Array) -> jax.Array:
    applied = delays.delayed(delays.push(state.info["action_history"], action), state.info["action_delay"])
    torques = jnp.clip(self._action_scale * applied, -self._max_ctrl, self._max_ctrl)
    return jnp.clip(jnp.append(torques, self.robot.init_ctrl[7]), *self.robot.ctrl_range)

  def goal_reached(self, c: ArmContext) -> jax.Array:
    """Whether the block has now been at the goal for long enough, bool."""
    return c.at_goal & (c.info["goal_steps"] >= self.config.success_steps)

  def total(self, rewards: Mapping[str, jax.Array]) -> jax.Array:
    """Returns dt * (weighted mean of the terms + bonuses)."""
    bonuses = {name: value for name, value in rewards.items() if name in _BONUSES}
    weight = sum(term.options.weight for term in self.rewards.terms if term.name not in _BONUSES)
    mean = sum((value for name, value in rewards.items() if name not in bonuses), jnp.zeros(())) / weight
    return (mean + sum(bonuses.values())) * self.dt

  def next_info(self, c: ArmContext, key: jax.Array) -> dict[str, Any]:
    reached = self.goal_reached(c)
    history = delays.push(c.info["action_history"], c.action)
    return super().next_info(c, key) | {
      "action_history": history,
      "action_delay": delays.draw_delay(key, self._action_delay),
      "applied_act": delays.delayed(history, c.info["action_delay"]),
      "goal_steps": jnp.where(c.at_goal & ~reached, c.info["goal_steps"] + 1, 0),
      "goal_reached": reached,
      "goals_reached": c.info["goals_reached"] + reached,
      PRESERVE_INFO: {"curriculum_id": self._next_level(c)},
    }

  def measure(self, c: ArmContext) -> dict[str, jax.Array]:
    reached = self.goal_reached(c)
    return super().measure(c) | {
      "success": reached.astype(jnp.float32),
      "success_1": (jnp.linalg.norm(c.object_to_goal) < self.config.success_distance).astype(jnp.float32),
      "success_2": self.turned(c).astype(jnp.float32),
      "goals_reached": c.info["goals_reached"] + reached,
      "curriculum_level": self._next_level(c).astype(jnp.float32),
    }

  def _next_level(self, c: ArmContext) -> jax.Array:
    return jnp.minimum(c.info[PRESERVE_INFO]["curriculum_id"] + self.goal_reached(c), len(self._distances) - 1)

  def _draw_place(self, key: jax.Array, distance: jax.Array) -> jax.Array:
    """Draws a place for the block, m [3], up to `distance` from the keyframe's along y and 0.4 times that along x."""
    reach = _SPREAD[0] * distance + _SPREAD[1]
    home = self.robot.init_qpos[_BOX]
    return jnp.clip(jax.random.uniform(key, (3,), minval=home - reach, maxval=home + reach), *_PLACES)


def draw_yaw(key: jax.Array, max_angle: jax.Array | float) -> jax.Array:
  """Draws a turn about the vertical, uniform in [0, `max_angle`) rad, as a quaternion [4]."""
  return axis_angle_to_quat(jnp.array([0.0, 0.0, 1.0]), jax.random.uniform(key) * max_angle)
