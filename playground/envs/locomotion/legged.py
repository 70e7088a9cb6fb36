"""What the tasks on legs share: scene, joint targets, and observations, rewards and terminations composed by config."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
from mujoco.mjx._src.math import axis_angle_to_quat, quat_mul

from playground.envs.base import Env, Observation, State
from playground.envs.physics import PhysicsData, mjx
from playground.mdp.keys import split_keys
from playground.mdp.legged import Context, LeggedRobot
from playground.mdp.lookup import lookup
from playground.mdp.observer import Observer
from playground.mdp.rewards import REWARDS, TOTALS, bind
from playground.mdp.terminations import TERMINATIONS
from playground.robots.gains import set_gains
from playground.robots.scene import configured_scene

_LAST_OBS = "last_obs"  # entry of `info` during a step only

# What an action is added to: the joints' default pose, their position, or their target in the step before.
_ACTION_BASES: dict[str, Callable[[LeggedRobot, PhysicsData], jax.Array]] = {
  "default_pose": lambda robot, data: robot.default_pose,
  "joint_pos": lambda robot, data: data.qpos[7:],
  "last_target": lambda robot, data: data.ctrl,
}


class LeggedTask(Env):
  """A robot on legs whose actions move the joints' position targets: target = base + action_scale * action.

  A task is a subclass that writes `reset` (with `_first_state`) and, where it has more to keep than the last action,
  `_track` (what rewards and observations of this step see) and `_next_info` (what the next step starts from).

  Attributes:
    robot: the robot's fixed facts.
  """

  derived = ("sensordata", "actuator_force", "site_xpos", "site_xmat", "qacc")
  logged: ClassVar[tuple[str, ...]] = ()  # entries of `info` whose mean is logged as a metric of that name

  def __init__(self, config: Any):
    """Builds the scene and binds everything that the config names.

    Args:
      config: the task's ConfigDict (`configs/env/joystick.yaml`, `getup.yaml`, ...) with the robot under `robot`.

    Raises:
      UnknownNameError: a reward, observation, termination, robot, terrain or object that does not exist.
      ConfigError: a reward's parameter is missing.
    """
    spec = self.spec = self._scene(config)
    mj_model = spec.compile()
    set_gains(mj_model, **config.robot.pd)
    super().__init__(config, mj_model)
    self.robot = LeggedRobot(mj_model, config.robot, self.parity)
    self._action_base = lookup(_ACTION_BASES, config.action_base, "env.action_base")
    self._action_scale: float = config.action_scale
    self._target_range = self.robot.target_range if config.clip_targets else None
    self._rewards = bind(config.reward, REWARDS, parity=self.parity, facts=self._reward_facts())
    self._total = lookup(TOTALS, config.reward.total, "env.reward.total")
    self._reward_clip = config.reward.clip and tuple(config.reward.clip)
    thresholds = {name: config.termination[name] for name in config.termination}
    functions = {name: lookup(TERMINATIONS, name, "env.termination") for name in thresholds}
    self._terminations = [(functions[name], value) for name, value in thresholds.items() if value is not None]
    self._observer = Observer(config, self.parity)
    self._own_noise_key: bool = config.noise.own_key

  def _scene(self, config: Any) -> mujoco.MjSpec:
    """The scene to compile; called first of all."""
    return configured_scene(config)

  def _reward_facts(self) -> dict[str, Any]:
    """Parameters of reward terms that come from the robot, beside those in `env.reward`."""
    return {"pose_weights": self.robot.pose_weights}

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    def first(rng: jax.Array) -> Context:
      state = self.reset(rng)
      return self._context(state.data, state.info, jnp.zeros(self.action_size))

    return self._observer.parts(first)

  def control(self, state: State, action: jax.Array) -> jax.Array:
    target = self._action_base(self.robot, state.data) + self._action_scale * action
    return target if self._target_range is None else jnp.clip(target, *self._target_range)

  def disturb(self, state: State) -> State:
    """Hands the last observation on to `evaluate`, where that of this step takes the past from."""
    return state.replace(info=state.info | {_LAST_OBS: state.obs}) if self._observer.looks_back else state

  def evaluate(self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array) -> State:
    info = dict(info)
    last = info.pop(_LAST_OBS) if self._observer.looks_back else None
    rng, keys = split_keys(info["rng"], (), [self._step_draws]) if self._own_noise_key else (info["rng"], {})
    now = self._track(self._context(data, info, action))
    now = dataclasses.replace(now, done=self._terminated(now))
    rng, obs = self._observe(now, rng, keys.get("noise"), last)
    rewards = {name: weight * term(now) for name, (weight, term) in self._rewards.items()}
    reward = self._sum_up(rewards)
    after = self._next_info(now, rng, keys)
    metrics = {f"reward/{name}": value for name, value in rewards.items()}
    metrics |= {name: after[name].mean() for name in self.logged} | self._measure(now)
    return State(data, obs, reward, now.done.astype(jnp.float32), metrics, after)

  def _sum_up(self, rewards: Mapping[str, jax.Array]) -> jax.Array:
    """The reward of a step, from the weighted terms."""
    gains = [value for name, value in rewards.items() if self._rewards[name][0] > 0]
    costs = [value for name, value in rewards.items() if self._rewards[name][0] < 0]
    reward = self._total(sum(gains, jnp.zeros(())), sum(costs, jnp.zeros(()))) * self.dt
    return jnp.clip(reward, *self._reward_clip) if self._reward_clip else reward

  def _first_state(self, data: PhysicsData, info: dict[str, Any], noise_key: jax.Array | None = None) -> State:
    """The state after reset.

    Args:
      data: the physics, after a forward pass.
      info: what the task carries, with `rng`; it lacks the last action, which is 0.
      noise_key: key of the observation noise, for a task whose `env.noise.own_key` is true.
    """
    info = {**info, "last_act": jnp.zeros(self.action_size)}
    info["rng"], obs = self._observe(self._context(data, info, info["last_act"]), info["rng"], noise_key)
    metrics = {name: jnp.zeros(()) for name in (*(f"reward/{name}" for name in self._rewards), *self.logged)}
    metrics |= {name: jnp.zeros(()) for name in ("fall", *self.summaries)}
    return State(data, obs, jnp.zeros(()), jnp.zeros(()), metrics, info)

  @property
  def _step_draws(self) -> tuple[str, ...]:
    """Names of a step's random keys, in order, where the noise has one of its own (`env.noise.own_key`)."""
    return ("noise",)

  @property
  def _spread_draws(self) -> tuple[str, ...]:
    """Names of the random keys that `_spread_start` needs."""
    spread = self.config.reset
    return tuple(name for name in ("xy", "yaw", "joint_scale", "base_vel") if spread[name])

  def _spread_start(self, keys: Mapping[str, jax.Array], qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Moves, turns and bends a pose on the ground and draws a base velocity, as `env.reset` says.

    Its `xy`, `yaw` and `base_vel` bound uniform draws; `joint_scale` is the range of a factor on each joint's angle,
    which then stays within the joint's limits. 0 or null leaves the pose as it is.

    Returns:
      qpos and qvel.
    """
    spread, draws = self.config.reset, self._spread_draws
    if "xy" in draws:
      qpos = qpos.at[:2].add(jax.random.uniform(keys["xy"], (2,), minval=-spread.xy, maxval=spread.xy))
    if "yaw" in draws:
      yaw = jax.random.uniform(keys["yaw"], minval=-spread.yaw, maxval=spread.yaw)
      turn = axis_angle_to_quat(jnp.array([0.0, 0.0, 1.0]), yaw)
      qpos = qpos.at[3:7].set(quat_mul(qpos[3:7], turn))
    if "joint_scale" in draws:
      low, high = spread.joint_scale
      joints = qpos[7:] * jax.random.uniform(keys["joint_scale"], (self.action_size,), minval=low, maxval=high)
      qpos = qpos.at[7:].set(joints if self.parity else jnp.clip(joints, *self.robot.joint_range))
    qvel = self._base_velocity(keys["base_vel"]) if "base_vel" in draws else jnp.zeros(self.mj_model.nv)
    return qpos, qvel

  def _base_velocity(self, key: jax.Array) -> jax.Array:
    """A qvel whose base part is uniform within +- `env.reset.base_vel`, m/s and rad/s."""
    reach = self.config.reset.base_vel
    base = jax.random.uniform(key, (6,), minval=-reach, maxval=reach)
    return jnp.zeros(self.mj_model.nv).at[:6].set(base)

  def _start(self, model: mjx.Model, qpos: jax.Array, qvel: jax.Array, ctrl: jax.Array | None = None) -> PhysicsData:
    """The physics after a forward pass; without `ctrl` the targets are where the joints are."""
    ctrl = qpos[7:] if ctrl is None else ctrl
    return self.physics.forward(model, self.physics.make(qpos=qpos, qvel=qvel, ctrl=ctrl))

  def _context(self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array) -> Context:
    contact = self.robot.contact(data)
    return Context(self.robot, data, info, action, contact, jnp.zeros_like(contact), jnp.zeros((), bool))

  def _track(self, now: Context) -> Context:
    """Adds to the present moment what the task keeps account of (swings of the feet, say)."""
    return now

  def _terminated(self, now: Context) -> jax.Array:
    """Whether the episode ends here, bool: any of `env.termination`."""
    return jnp.array([function(now, threshold) for function, threshold in self._terminations], bool).any()

  def _observe(
    self, now: Context, rng: jax.Array, noise_key: jax.Array | None, last: Observation | None = None
  ) -> tuple[jax.Array, Observation]:
    """The next `rng`, and the observation. The noise's keys come from `noise_key`; without one, from `rng`."""
    after, obs = self._observer.observe(now, rng if noise_key is None else noise_key, last)
    return after if noise_key is None else rng, obs

  def _measure(self, now: Context) -> dict[str, jax.Array]:
    """Metrics of how well the task is done, in units that people use; `fall` counts episodes that ended early."""
    return {"fall": now.done.astype(jnp.float32)}

  def _next_info(self, now: Context, rng: jax.Array, keys: Mapping[str, jax.Array]) -> dict[str, Any]:
    """What the next step starts from; `keys` are those of `_step_draws`, none without a key for noise."""
    del keys
    info = {**now.info, "rng": rng, "last_act": now.action}
    return info | ({"last_last_act": now.info["last_act"]} if "last_last_act" in info else {})
