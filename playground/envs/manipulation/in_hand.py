"""What tasks of a hand with a cube share: scene, targets, starts, and observations and rewards composed by config."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from playground.envs.base import Env, State
from playground.envs.manipulation.episodes import begin_anew, first_state
from playground.envs.manipulation.tabletop import is_finite
from playground.envs.physics import PhysicsData, mjx
from playground.mdp.hand_observations import HAND_OBSERVATIONS
from playground.mdp.hand_rewards import HAND_REWARDS
from playground.mdp.hands import Context, Hand
from playground.mdp.keys import split_keys
from playground.mdp.lookup import lookup
from playground.mdp.observer import Observer
from playground.mdp.pose_noise import DRAWS as POSE_DRAWS
from playground.mdp.pose_noise import sensed_pose
from playground.mdp.rewards import bind
from playground.mdp.rotations import uniform_quat
from playground.robots.in_hand import build_in_hand_scene

_LAST_OBS = "last_obs"  # entry of `info` during a step only
_AWAY = (-100.0, -100.0, -100.0)  # m, where a goal is that the task does not have

# What an action is added to: the targets that hold the keyframe `home`, or those of the step before.
_ACTION_BASES: dict[str, Callable[[Hand, PhysicsData], jax.Array]] = {
  "home": lambda hand, data: hand.home_ctrl,
  "last_target": lambda hand, data: data.ctrl,
}


class InHand(Env):
  """A hand, palm up, that turns a cube: target = base + action_scale * action, within the targets' range.

  An episode begins with the cube above the palm, turned anyhow, and ends when it is below `min_cube_height`. A task is
  a subclass; what a hand has of its own is `env.hand`.

  What is otherwise than in Playground 0.2.0 in all of them (`env.parity=true` has its ways):
  - the first observation is of the start (0.2.0 computes no forward pass: poses and sensors are 0);
  - nothing is carried over from one episode to the next (0.2.0: last actions, counters, the goal's spin);
  - the goal is a mark that nothing touches (0.2.0: a cube that collides).

  Attributes:
    hand: the hand's fixed facts.
  """

  derived = ("sensordata", "actuator_force", "qfrc_actuator")
  forgotten: ClassVar[tuple[str, ...]] = ("last_act", "last_last_act")  # of `info`: 0 when an episode begins
  draws: ClassVar[tuple[tuple[str, ...], ...]] = (("joints", "joint_vel"), ("cube_pos", "cube_quat"))  # of a reset

  def __init__(self, config: Any):
    """Builds the scene and binds everything that the config names.

    Args:
      config: the task's ConfigDict (`configs/env/_in_hand.yaml` and those that build on it).

    Raises:
      UnknownNameError: a reward, observation, hand or sensor that does not exist.
    """
    super().__init__(config, self._scene(config).compile())
    self.hand = Hand(self.mj_model, config.hand)
    self._action_base = lookup(_ACTION_BASES, config.action_base, "env.action_base")
    self._action_scale = np.asarray(config.action_scale)
    self._smoothing: float = config.ema_alpha
    self._rewards = bind(config.reward, HAND_REWARDS)
    self._observer = Observer(config, self.parity, HAND_OBSERVATIONS)
    self._noise = config.noise
    self._min_cube_height: float = config.min_cube_height
    self._joint_std: float = config.reset.joint_std
    self._cube_start = jnp.array(config.reset.cube_pos)
    self._cube_spread: float = config.reset.cube_spread

  def _scene(self, config: Any) -> mujoco.MjSpec:
    spec = build_in_hand_scene(config.hand.name)
    if not config.torque_limits:
      for joint in spec.joints:
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    if not config.parity:
      for geom in spec.body("goal").geoms:
        geom.contype = geom.conaffinity = 0
    return spec

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    def first(rng: jax.Array) -> Context:
      state = self.reset(rng)
      return self._context(state.data, state.info, jnp.zeros(self.action_size))

    return self._observer.parts(first)

  def reset(self, rng: jax.Array, model: mjx.Model | None = None) -> State:
    model = self.mjx_model if model is None else model
    rng, keys = split_keys(rng, (), self.draws)
    data = self.physics.make(**self._start(keys))
    data = data if self.parity else self.physics.forward(model, data)
    nothing = jnp.zeros(self.action_size)
    info = {"last_act": nothing, "last_last_act": nothing} | self._start_info(keys, model)
    info["rng"], obs = self._observe(self._context(data, info, nothing), rng, None)
    return first_state(self, data, obs, info)

  def _start(self, keys: Mapping[str, jax.Array]) -> dict[str, jax.Array]:
    """State fields at the start of an episode, by name."""
    bent = self.hand.home_pose + self._joint_std * jax.random.normal(keys["joints"], (self.hand.num_joints,))
    joints = jnp.clip(bent, *self.hand.joint_range)
    spread = self._cube_spread
    cube = self._cube_start + jax.random.uniform(keys["cube_pos"], (3,), minval=-spread, maxval=spread)
    return {
      "qpos": jnp.concatenate([joints, cube, uniform_quat(keys["cube_quat"])]),
      "ctrl": joints if self.hand.has_servos else self.hand.home_ctrl,
      "mocap_pos": jnp.array([_AWAY]),
    }

  def _start_info(self, keys: Mapping[str, jax.Array], model: mjx.Model) -> dict[str, jax.Array]:
    """What a task carries besides `rng` and the last actions, at the start of an episode."""
    del keys, model
    return {}

  def control(self, state: State, action: jax.Array) -> jax.Array:
    target = self._action_base(self.hand, state.data) + self._action_scale * action
    target = jnp.clip(target, *self.hand.target_range)
    return self._smoothing * target + (1 - self._smoothing) * state.data.ctrl

  def disturb(self, state: State) -> State:
    """Hands the last observation on to `evaluate`; an episode that begins forgets the one before it."""
    if not self.parity:
      state = begin_anew(state, **{name: jnp.zeros_like(state.info[name]) for name in self.forgotten})
    return state.replace(info=state.info | {_LAST_OBS: state.obs}) if self._observer.looks_back else state

  def evaluate(self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array) -> State:
    info = dict(info)
    last = info.pop(_LAST_OBS, None)
    now = self._context(data, info, action)
    rng, obs = self._observe(now, info["rng"], last)
    rewards = {name: weight * term(now) for name, (weight, term) in self._rewards.items()}
    metrics = {f"reward/{name}": value for name, value in rewards.items()} | self._measure(now)
    after = info | {"rng": rng, "last_act": action, "last_last_act": info["last_act"]}
    reward = sum(rewards.values(), jnp.zeros(())) * self.dt
    return State(data, obs, reward, now.done.astype(jnp.float32), metrics, after)

  def _context(self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array) -> Context:
    """The present moment, the cube's pose as it is."""
    pose = self.hand.sensor(data, "cube_position"), self.hand.sensor(data, "cube_orientation")
    done = (pose[0][2] < self._min_cube_height) | ~is_finite(data)
    return Context(self.hand, data, info, action, pose, done)

  def _observe(self, now: Context, rng: jax.Array, last: Any) -> tuple[jax.Array, Any]:
    """The next random key, and the observation."""
    after = self._observer.skip(rng)
    if "pose" in self._noise:  # drawn after the noise of the other parts, as in 0.2.0
      after, keys = split_keys(after, (), POSE_DRAWS)
      pose = sensed_pose(keys, now.sensed, self._noise.pose, self._noise.level, self.parity)
      now = dataclasses.replace(now, sensed=pose)
    return after, self._observer.observe(now, rng, last)[1]

  def _measure(self, now: Context) -> dict[str, jax.Array]:
    """Metrics of how well the task is done."""
    del now
    return {}
