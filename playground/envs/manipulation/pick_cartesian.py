"""A Panda that picks up a cube with a hand that moves in a plane."""

from typing import Any

import jax
import jax.numpy as jnp

from playground.envs.base import State
from playground.envs.manipulation.episodes import begin_anew
from playground.envs.manipulation.pick import Pick
from playground.envs.manipulation.tabletop import Info, is_finite, logged, outside, total
from playground.envs.physics import PhysicsData, mjx
from playground.mdp import delays
from playground.mdp.progress import progress
from playground.robots.panda.kinematics import forward_kinematics, inverse_kinematics, within_limits

_WORKSPACE = jnp.array([[0.25, -0.32, 0.02], [0.77, 0.32, 0.5]])  # m, where the tip may be sent
_BEHIND = 0.03  # m, by which cube and target are nearer to the base than the tip at the start
_TARGET_HEIGHT, _LIFTED = 0.2, 0.05  # m
_GRIP_STEP = 0.02  # m: two steps close the open fingers


class PickCubeCartesian(Pick):
  """Lifts a cube to a target above the middle of where it may lie (paper, appendix "Manipulation").

  Actions: where the hand's tip goes along y and z, in parts of `action_scale`, and whether the fingers close (below 0)
  or open. Inverse kinematics turn the tip's place into the joints' targets; the hand keeps its attitude and joint 7 its
  angle. The reward is what the weighted sum of the terms gains over its best so far in the episode, which success ends.
  In some episodes the cube is in the hand from the first step on, to show what is to be had.

  Beside those of `ArmTask` the defaults differ from Playground 0.2.0 as follows; `env.parity=true` has its ways:
  - The cube starts on the floor (0.2.0: 3 cm inside it, from where it jumps up).
  - Where the arm cannot reach, or only beyond its joints' limits, the hand's place stays as it is (0.2.0 moves it on,
    away from the hand, and knows no limits).
  - The hand that starts with the cube stays where it is (0.2.0 calls it back in the same step).
  - The gripper's delayed actions are those of the episode, and before it the closing of fingers that hold the cube at
    the start, the opening of others (0.2.0: those of the episode before).
  """

  def __init__(self, config: Any, scene: str = "panda_single_cube_camera"):
    """Builds the scene. `config`: see `configs/env/PandaPickCubeCartesian.yaml`."""
    super().__init__(config, scene, keyframe="low_home", body="box", obstacle="floor")
    guide = self.mj_model.key("picked")
    self._guide_qpos, self._guide_ctrl = jnp.array(guide.qpos), jnp.array(guide.ctrl)
    self._tip, self._attitude = forward_kinematics(self._home_ctrl[:7])
    self._guide_tip = self._tip if self.parity else forward_kinematics(self._guide_ctrl[:7])[0]

  @property
  def action_size(self) -> int:
    return 3

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    return {"state": super().observation_parts["state"] | {"no_solution": 1, "last_act": 3}}

  def reset(self, rng: jax.Array, model: mjx.Model | None = None) -> State:
    rng, box_key = jax.random.split(rng)
    x = self._tip[0] - _BEHIND
    reach = self.config.reset.box_y
    y = jax.random.uniform(box_key, minval=-reach, maxval=reach)
    target = jnp.stack([x, jnp.zeros(()), jnp.array(_TARGET_HEIGHT)])
    box = jnp.stack([x, y, jnp.zeros(()) if self.parity else self._home_qpos[11]])
    info = {
      "rng": rng,
      "target_pos": target,
      "best_reward": jnp.zeros(()),
      "current_pos": self._tip,
      "newly_reset": jnp.zeros((), bool),
      "last_act": jnp.zeros(3),
      "no_solution": jnp.zeros(()),
      "action_history": jnp.zeros(self.config.gripper_delay + 1),
      "action_delay": jnp.zeros((), jnp.int32),
    }
    return self._start({"qpos": self._home_qpos.at[9:12].set(box), "mocap_pos": target[None]}, info, model)

  def disturb(self, state: State) -> State:
    """Begins an episode, in some of them with the cube in the hand, and draws the gripper's delay."""
    rng, delay_key = jax.random.split(state.info["rng"])
    rng, guide_key = jax.random.split(rng)
    first = state.data.time == 0
    guided = first & jax.random.bernoulli(guide_key, self.config.guide_probability)
    start = {"reached_box": 0.0, "best_reward": 0.0, "last_act": jnp.zeros(3)}
    start["current_pos"] = jnp.where(guided, self._guide_tip, self._tip)
    if not self.parity:  # the fingers were told before what they are seen to do: a late one must not let the cube fall
      start["action_history"] = jnp.full_like(state.info["action_history"], jnp.where(guided, -1.0, 0.0))
    state = begin_anew(state, **start)
    delay = delays.draw_delay(delay_key, (0, self.config.gripper_delay))
    qpos = jnp.where(guided, self._guide_qpos, state.data.qpos)
    ctrl = jnp.where(guided, self._guide_ctrl, state.data.ctrl)
    info = state.info | {"rng": rng, "newly_reset": first, "action_delay": delay}
    return state.replace(data=state.data.replace(qpos=qpos, ctrl=ctrl), info=info)

  def control(self, state: State, action: jax.Array) -> jax.Array:
    action, _ = self._delayed(state.info, action)
    _, joints, solved = self._plan(state.data.ctrl, state.info, action)
    arm = jnp.where(solved, joints, state.data.ctrl[:7])
    fingers = state.data.ctrl[7] + jnp.where(action[2] < 0, -_GRIP_STEP, _GRIP_STEP)
    return jnp.clip(jnp.append(arm, fingers), *self._ctrl_range)

  def evaluate(self, data: PhysicsData, info: Info, action: jax.Array) -> State:
    action, history = self._delayed(info, action)
    # From the servos' new targets this is the plan that they came from: joint 7 is the same, and so is the branch.
    tip, _, solved = self._plan(data.ctrl, info, action)
    info = self._reach(data, info)
    place, measures = data.xpos[self._moved], self._measures(data, info)
    terms = self._terms(data, info) | {
      "action_rate": jnp.linalg.norm(action - info["last_act"]),
      "no_solution": 1 - solved.astype(jnp.float32),
      "lifted": (place[2] > _LIFTED).astype(jnp.float32),
      "success": measures["success"],
    }
    rewards = self._weigh(terms)
    gain, best = progress(total(rewards), info["best_reward"])
    reward = jnp.where(info["newly_reset"], 0.0, gain)  # what the start itself is worth is no progress

    out_of_bounds = outside(place) | (place[2] < 0)
    done = out_of_bounds | ~is_finite(data) | (measures["success"] > 0)
    info |= {"best_reward": best, "last_act": action, "action_history": history, "no_solution": terms["no_solution"]}
    info["current_pos"] = tip if self.parity else jnp.where(solved, tip, info["current_pos"])
    metrics = logged(rewards) | {"out_of_bounds": out_of_bounds.astype(jnp.float32)} | measures
    return State(data, self._observe(data, info), reward, done.astype(jnp.float32), metrics, info)

  def _observe(self, data: PhysicsData, info: Info) -> jax.Array:
    return jnp.concatenate([super()._observe(data, info), info["no_solution"][None], info["last_act"]])

  def _delayed(self, info: Info, action: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The action with the gripper's part of some steps ago, and the history of that part."""
    history = delays.push(info["action_history"], action[2])
    return action.at[2].set(delays.delayed(history, info["action_delay"])), history

  def _plan(self, ctrl: jax.Array, info: Info, action: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Where the tip is to go, the joint angles for it, and whether the arm can do that."""
    step = self._action_scale * jnp.array([0.0, action[0], action[1]])
    tip = jnp.clip(info["current_pos"] + step, *_WORKSPACE)
    joints = inverse_kinematics(tip, self._attitude, ctrl[6], near=ctrl[:7])
    return tip, joints, jnp.isfinite(joints).all() if self.parity else within_limits(joints)
