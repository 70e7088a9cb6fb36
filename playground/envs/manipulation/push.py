"""A Panda that pushes a block to a goal with torques, through delays and noise."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from mujoco.mjx._src.math import axis_angle_to_quat, normalize, quat_mul

from playground.envs.base import State
from playground.envs.manipulation.episodes import begin_anew, first_state
from playground.envs.manipulation.push_noise import Readings, sensed
from playground.envs.manipulation.tabletop import Info, TabletopTask, Terms, is_finite, logged, total
from playground.envs.physics import PhysicsData, mjx
from playground.envs.wrappers import PRESERVE_INFO
from playground.errors import ConfigError
from playground.mdp import delays
from playground.mdp.rotations import angle_between, two_rows
from playground.mdp.tolerance import tolerance
from playground.robots.panda.kinematics import JOINT_RANGE, MAX_VELOCITY
from playground.robots.tabletop import build_tabletop, contact_addresses

_ARM, _BOX = slice(0, 7), slice(13, 16)  # joints, and the block's position, in qpos
_Z = jnp.array([0.0, 0.0, 1.0])
# Where the block and its goal may be drawn (m), and where the block and the gripper may get to.
_PLACES = jnp.array([[0.4, -0.2, -0.005], [0.65, 0.2, 0.04]])
_TABLE = jnp.array([[0.3, -0.5], [0.75, 0.7]])
_LOWEST_BOX, _HIGHEST_GRIPPER = -0.01, 0.5
_SPREAD = jnp.array([0.4, 1.0, 0.0]), jnp.array([0.0, 0.0, 0.005])  # of places: in parts of a distance, and m
_BOX_SPREAD = 0.15  # m
_ARM_SPREAD = 0.3 * jnp.array([0.2, 0.2, 0.2, 0.2, 0.3, 0.3, 0.3])  # of the joints' ranges
_SOFT = 0.9  # of joints' ranges and velocities


class PushCube(TabletopTask):
  """Pushes a foam block over a table to a goal and turns it as the goal (paper, section IV-C.2 and Appendix C.5).

  An action is a torque for each of the arm's seven joints, which acts some control steps later; what is observed is
  some steps old and noisy. The closed gripper pushes with its sides. Once the block has stayed at a goal, within
  `success_distance` and `success_angle`, for `success_steps` steps, that goal is reached and the next one appears: an
  environment's level rises with every goal, and with it how far a goal is moved and turned. The level outlasts
  episodes, of which each begins with a goal of level 0, and the fresh starts of a training. Evaluations begin with 0.

  The defaults differ from Playground 0.2.0 as follows; `env.parity=true` has its ways:
  - The first observation shows the scene (0.2.0 computes no kinematics at reset: poses are 0), and is what is observed
    until the first delayed one arrives (0.2.0: zeros); delays and counters begin anew with every episode.
  - Delays reach the paper's 3 and 12 steps (0.2.0: one less, its bounds are exclusive).
  - Noise is drawn for each joint and axis and has both signs; turns are about axes in all directions (0.2.0: one
    positive number for all joints' angles, one for their velocities, one for the gripper's x, y and z, and axes from
    normally distributed angles, the gripper's turn from the joints' key).
  - The arm starts within equal angles to both sides (0.2.0: joint 4 always bends more, joint 6 nearly always less).
  - `action_rate` compares with the last action (0.2.0: with the one that was applied in the step before).
  - Soft limits are the joints' ranges shrunk about their centres (0.2.0: both limits times 0.9, for joint 4 beyond).
  - A new goal's place and turn come from keys of their own; levels end with the last (0.2.0 counts on).

  Metrics of an evaluation: `success` is whether the block was at its goal in any step, `goals_reached` how many it has
  reached in the episode; `curriculum_level`, `position_error_cm` and `rotation_error_deg` are those of the last step.
  """

  derived = ("sensordata", "xpos", "xquat", "site_xpos", "site_xmat")
  summaries: ClassVar[Mapping[str, str]] = {
    "success": "max",
    "position_error_cm": "last",
    "rotation_error_deg": "last",
    "goals_reached": "last",  # so far: of an event, an evaluation would see the last of the repeats of an action only
    "curriculum_level": "last",
  }

  def __init__(self, config: Any):
    """Builds the scene.

    Args:
      config: the task's ConfigDict, see `configs/env/PandaRobotiqPushCube.yaml`.

    Raises:
      ConfigError: delays whose bounds are in the wrong order, or a curriculum whose lists differ in length.
    """
    wait = config.delays
    for name, low, high in (("action", wait.action_min, wait.action_max), ("obs", wait.obs_min, wait.obs_max)):
      if not 0 <= low <= high - config.parity:
        raise ConfigError(f"env.delays.{name}_min={low} must be from 0 to env.delays.{name}_max={high}.")
    if not len(config.curriculum.distance) == len(config.curriculum.angle) > 0:
      raise ConfigError("env.curriculum.distance and env.curriculum.angle must have an entry for each level.")
    super().__init__(config, build_tabletop("panda_robotiq_cube"))
    model = self.mj_model
    self._block, self._gripper = model.body("box").id, model.site("gripper").id
    self._contacts = np.concatenate([contact_addresses(model, geom) for geom in ("wall", "floor")])
    self._max_ctrl = jnp.array(config.max_torque / model.actuator_gear[_ARM, 0])
    self._action_delays = (wait.action_min, wait.action_max - config.parity)  # 0.2.0's upper bounds are exclusive
    self._obs_delays = (wait.obs_min, wait.obs_max - config.parity)
    self._distances, self._angles = jnp.array(config.curriculum.distance), jnp.array(config.curriculum.angle)
    middle, half = JOINT_RANGE.mean(axis=0), (JOINT_RANGE[1] - JOINT_RANGE[0]) / 2
    centred = jnp.stack([-half, half])
    self._arm_spread = _ARM_SPREAD * (JOINT_RANGE if self.parity else centred)
    self._soft_range = _SOFT * JOINT_RANGE if self.parity else middle + _SOFT * centred

  @property
  def action_size(self) -> int:
    return 7

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    robot = {"last_act": 7, "joint_pos": 7, "joint_vel": 7, "gripper_pos": 3, "gripper_axes": 6}
    return {"state": {"target_pos": 3, "target_axes": 6} | robot | {"box_axes": 6, "box_pos": 3}}

  def reset(self, rng: jax.Array, model: mjx.Model | None = None) -> State:
    rng, box_key, yaw_key, goal_key, arm_key, turn_key = jax.random.split(rng, 6)
    box = self._draw_place(box_key, jnp.array(_BOX_SPREAD)).at[2].set(self._home_qpos[_BOX][2])
    box_quat = _draw_yaw(yaw_key, 2 * jnp.pi)
    goal = self._draw_place(goal_key, self._distances[0])
    goal_quat = quat_mul(box_quat, _draw_yaw(turn_key, self._angles[0]))
    low, high = self._arm_spread
    arm = self._home_qpos[_ARM] + jax.random.uniform(arm_key, (7,), minval=low, maxval=high)
    qpos = self._home_qpos.at[_ARM].set(arm).at[_BOX].set(box).at[_BOX.stop :].set(box_quat)
    data = self._placed({"qpos": qpos, "mocap_pos": goal[None], "mocap_quat": goal_quat[None]}, model)
    info: dict[str, Any] = {"last_act": jnp.zeros(7), "action_delay": jnp.zeros((), jnp.int32)}
    info["action_history"] = delays.start(info["last_act"], self.config.delays.action_max + 1)
    info |= {"success_step_count": jnp.zeros((), jnp.int32), "goals_reached": jnp.zeros(())}
    info[PRESERVE_INFO] = {"curriculum_id": jnp.zeros((), jnp.int32)}
    info["rng"], obs = self._observe(rng, data, info)
    steps = self.config.delays.obs_max + 1
    info["obs_history"] = delays.start(jnp.zeros_like(obs) if self.parity else obs, steps)
    return first_state(self, data, obs, info)

  def disturb(self, state: State) -> State:
    """Draws by how much this step's action is late."""
    state = begin_anew(state, goals_reached=0.0)
    if not self.parity:
      nothing = {key: jnp.zeros_like(state.info[key]) for key in ("last_act", "action_history", "success_step_count")}
      seen = jnp.broadcast_to(jnp.asarray(state.obs), state.info["obs_history"].shape)  # as if it had long been so
      state = begin_anew(state, **nothing, obs_history=seen)
    rng, key = jax.random.split(state.info["rng"])
    return state.replace(info=state.info | {"rng": rng, "action_delay": delays.draw_delay(key, self._action_delays)})

  def control(self, state: State, action: jax.Array) -> jax.Array:
    applied = delays.delayed(delays.push(state.info["action_history"], action), state.info["action_delay"])
    torques = jnp.clip(self._action_scale * applied, -self._max_ctrl, self._max_ctrl)
    return jnp.clip(jnp.append(torques, self._home_ctrl[7]), *self._ctrl_range)

  def evaluate(self, data: PhysicsData, info: Info, action: jax.Array) -> State:
    reward_config = self.config.reward
    history = delays.push(info["action_history"], action)
    error = jnp.linalg.norm(data.mocap_pos[0] - data.xpos[self._block])
    angle = angle_between(data.xquat[self._block], data.mocap_quat[0])
    there = (error < self.config.success_distance) & (angle < self.config.success_angle)
    reached = there & (info["success_step_count"] >= self.config.success_steps)
    out_of_bounds = self._out_of_bounds(data)
    rewards = self._weigh(self._terms(data, info, action, angle))
    reward = total(rewards) / sum(self._scales.values()) + reward_config.termination * out_of_bounds
    reward += reward_config.success_wait * there + reward_config.success * reached

    rng, *goal_keys = (info["rng"],) * 3 if self.parity else jax.random.split(info["rng"], 3)
    level, data = self._next_goal(goal_keys, data, info, reached)
    count = jnp.where(there & ~reached, info["success_step_count"] + 1, 0)
    metrics = logged(rewards) | {
      "out_of_bounds": out_of_bounds.astype(jnp.float32),
      "success": there.astype(jnp.float32),
      "goals_reached": info["goals_reached"] + reached,
      "curriculum_level": level.astype(jnp.float32),
      "position_error_cm": 100 * error,
      "rotation_error_deg": jnp.rad2deg(angle),
    }
    done = out_of_bounds | ~is_finite(data)
    rng, now = self._observe(rng, data, info)
    seen = delays.push(info["obs_history"], now)
    rng, key = jax.random.split(rng)
    obs = delays.delayed(seen, delays.draw_delay(key, self._obs_delays))
    info = {
      **info,
      "rng": jax.random.split(rng)[0],
      "last_act": delays.delayed(history, info["action_delay"]),
      "action_history": history,
      "obs_history": seen,
      "success_step_count": count,
      "goals_reached": metrics["goals_reached"],
      PRESERVE_INFO: {"curriculum_id": level},
    }
    return State(data, obs, reward * self.dt, done.astype(jnp.float32), metrics, info)

  def _terms(self, data: PhysicsData, info: Info, action: jax.Array, angle: jax.Array) -> Terms:
    """The reward's terms; `angle` is the block's to its goal, rad."""
    box, goal, gripper = data.xpos[self._block], data.mocap_pos[0], data.site_xpos[self._gripper]
    qpos, qvel = data.qpos[_ARM], data.qvel[_ARM]
    away = box - goal
    behind = box + 0.1 * normalize(away) * (jnp.linalg.norm(away) > 1e-3)  # where to push from
    normal = normalize(data.sensordata[:18].reshape(6, 3).mean(axis=0))  # of what the fingers touch the block with
    last = info["last_act"] if self.parity else info["action_history"][0]
    norm = jnp.linalg.norm
    return {
      "gripper_box": tolerance(norm(behind - gripper), (0, 0.1), 1.0, "linear"),
      "box_target": tolerance(norm(away[:2]), (0, 0.005), 0.4, "reciprocal"),
      "box_orientation": tolerance(angle, (0, 0.2), np.pi, "reciprocal"),
      "gripper_collision_side": norm(jnp.cross(_Z, normal)),
      "robot_target_qpos": tolerance(norm(qpos - self._home_qpos[_ARM]), (0, 0.5), 4.5, "linear"),
      "joint_vel": tolerance(norm(qvel), (0, 0.5), 2.0, "reciprocal"),
      "joint_vel_limit": 1 - (jnp.abs(qvel) > _SOFT * MAX_VELOCITY).any().astype(jnp.float32),
      "total_command": norm(action),
      "action_rate": norm(action - last),
    }

  def _out_of_bounds(self, data: PhysicsData) -> jax.Array:
    """The block or the gripper left the table, the gripper hit it or the wall, or a joint is near its limit; bool."""
    box, gripper, qpos = data.xpos[self._block], data.site_xpos[self._gripper], data.qpos[_ARM]
    off = [(place[:2] < _TABLE[0]) | (place[:2] > _TABLE[1]) for place in (box, gripper)]
    beyond = (qpos < self._soft_range[0]) | (qpos > self._soft_range[1])
    touching = data.sensordata[self._contacts] > 0
    heights = jnp.stack([box[2] < _LOWEST_BOX, gripper[2] > _HIGHEST_GRIPPER])
    return jnp.concatenate([*off, beyond, touching, heights]).any()

  def _next_goal(
    self, keys: Sequence[jax.Array], data: PhysicsData, info: Info, reached: jax.Array
  ) -> tuple[jax.Array, PhysicsData]:
    """The level, and the physics with its goal, after a step that `reached` a goal or did not."""
    level = info[PRESERVE_INFO]["curriculum_id"] + reached
    if not self.parity:
      level = jnp.minimum(level, len(self._distances) - 1)
    place = self._draw_place(keys[0], self._distances[level])  # beyond the lists' ends their last
    quat = quat_mul(data.xquat[self._block], _draw_yaw(keys[1], self._angles[level]))
    pos = jnp.where(reached, place, data.mocap_pos[0])[None]
    return level, data.replace(mocap_pos=pos, mocap_quat=jnp.where(reached, quat, data.mocap_quat[0])[None])

  def _draw_place(self, key: jax.Array, distance: jax.Array) -> jax.Array:
    """A place for the block, m [3], up to `distance` from the keyframe's along y and 0.4 times that along x."""
    reach = _SPREAD[0] * distance + _SPREAD[1]
    home = self._home_qpos[_BOX]
    return jnp.clip(jax.random.uniform(key, (3,), minval=home - reach, maxval=home + reach), *_PLACES)

  def _observe(self, rng: jax.Array, data: PhysicsData, info: Info) -> tuple[jax.Array, jax.Array]:
    """The next random key, and what the sensors read now: shape [48]."""
    gripper = data.site_xpos[self._gripper], data.site_xmat[self._gripper]
    box = data.xpos[self._block], data.xquat[self._block]
    rng, read = sensed(rng, Readings(data.qpos[_ARM], data.qvel[_ARM], *gripper, *box), self.config.noise, self.parity)
    parts = [data.mocap_pos[0], two_rows(data.mocap_quat[0]), info["last_act"], read.joint_pos, read.joint_vel]
    parts += [read.gripper_pos, read.gripper_axes[1:].ravel(), two_rows(read.box_quat), read.box_pos]
    return rng, jnp.concatenate(parts)


def _draw_yaw(key: jax.Array, max_angle: jax.Array | float) -> jax.Array:
  """A turn about the vertical, uniform in [0, `max_angle`) rad, as a quaternion [4]."""
  return axis_angle_to_quat(_Z, jax.random.uniform(key) * max_angle)
