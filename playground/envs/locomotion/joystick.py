"""Follow a joystick's velocity commands on legs: one task for all robots, composed by config."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from mujoco.mjx._src.math import axis_angle_to_quat, quat_mul

from playground.envs.base import Env, State
from playground.envs.physics import PhysicsData, mjx
from playground.mdp.commands import exponential_steps, make_sampler
from playground.mdp.legged import Context, LeggedRobot
from playground.mdp.lookup import lookup
from playground.mdp.noise import add_noise
from playground.mdp.observations import OBSERVATIONS
from playground.mdp.pushes import advance_kick, sample_kicks
from playground.mdp.rewards import PARITY_REWARDS, REWARDS, bind
from playground.mdp.terminations import TERMINATIONS
from playground.robots.scene import build_scene

ACTOR = "state"  # the observation of what the robot's own sensors tell: noisy; the others are exact


class Joystick(Env):
  """Tracks commanded forward, sideways and turning velocity (paper: appendix "Locomotion", joystick tasks).

  An action moves the joints' position targets: target = default pose + action_scale * action. Which rewards,
  observations, commands, noise, pushes and terminations there are and how they weigh is `configs/env/joystick.yaml`.

  The defaults differ from Playground 0.2.0 as follows; `env.parity=true` has its ways:
  - soft joint limits shrink the range about its centre (0.2.0 scales the bounds, which lets the Go1's knees pass the
    hard limit);
  - a kick is as strong as it says on the robot at hand (0.2.0 takes the mass before randomisation).
  """

  derived = ("sensordata", "actuator_force", "site_xpos", "site_xmat")

  def __init__(self, config: Any):
    """Builds the scene and binds everything that the config names.

    Args:
      config: the task's ConfigDict, `configs/env/joystick.yaml` with the robot under `robot`.

    Raises:
      UnknownNameError: a reward, observation, sampler, termination, robot, terrain or object that does not exist.
      ConfigError: a reward's parameter is missing.
    """
    scene, robot = config.scene, config.robot
    spec = build_scene(
      robot.name, terrain=scene.terrain, collision=scene.collision, floor_contacts=tuple(robot.floor_contacts)
    )
    mj_model = spec.compile()
    _set_gains(mj_model, robot.pd.kp, robot.pd.damping)
    super().__init__(config, mj_model)
    self.robot = LeggedRobot(mj_model, robot)
    self._action_scale: float = config.action_scale
    self._rewards = bind(config.reward, PARITY_REWARDS if self.parity else REWARDS)
    self._reward_clip = tuple(config.reward.clip)
    self._terminations = [
      (lookup(TERMINATIONS, name, "env.termination"), config.termination[name]) for name in config.termination
    ]
    self._commands = make_sampler(config.command)
    self._command_duration: float = config.command.mean_duration
    self._noise = _amplitudes(config.noise)
    self._obs = {group: tuple(config.obs[group]) for group in sorted(config.obs, key=lambda g: (g != ACTOR, g))}
    for group, parts in self._obs.items():
      for part in parts:
        lookup(OBSERVATIONS if group == ACTOR else {ACTOR: None, **OBSERVATIONS}, part, f"env.obs.{group}")
    self._pushing: bool = config.pushes.enable

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    names = {part for parts in self._obs.values() for part in parts} - {ACTOR}

    def every_part(rng: jax.Array) -> dict[str, jax.Array]:
      state = self.reset(rng)
      now = self._context(state.data, state.info, jnp.zeros(self.action_size))
      return {name: OBSERVATIONS[name](now) for name in names}

    sizes = {name: part.size for name, part in jax.eval_shape(every_part, jax.random.PRNGKey(0)).items()}
    sizes[ACTOR] = sum(sizes[part] for part in self._obs[ACTOR])
    return {group: {part: sizes[part] for part in parts} for group, parts in self._obs.items()}

  def reset(self, rng: jax.Array, model: mjx.Model | None = None) -> State:
    model = self.mjx_model if model is None else model
    rng, data = self._start(rng, model)
    rng, *kick_keys = jax.random.split(rng, 4)
    rng, timer_key, command_key = jax.random.split(rng, 3)
    feet = len(self.robot.feet)
    info = {
      "rng": rng,
      "command": self._commands.first(command_key),
      "steps_until_next_cmd": exponential_steps(timer_key, self._command_duration, self.dt),
      "last_act": jnp.zeros(self.action_size),
      "last_last_act": jnp.zeros(self.action_size),
      "feet_air_time": jnp.zeros(feet),
      "swing_peak": jnp.zeros(feet),
      "last_contact": jnp.zeros(feet, bool),
      **sample_kicks(jnp.stack(kick_keys), self.config.pushes, self.dt),
    }
    if self._pushing:
      info["pert_mass"] = self.robot.mass(self.mjx_model if self.parity else model)
    now = self._context(data, info, jnp.zeros(self.action_size))
    info["rng"], obs = self._observe(now)
    metrics = {name: jnp.zeros(()) for name in (*(f"reward/{name}" for name in self._rewards), "swing_peak")}
    return State(data, obs, jnp.zeros(()), jnp.zeros(()), metrics, info)

  def disturb(self, state: State) -> State:
    if not self._pushing:
      return state
    force, info = advance_kick(state.info, state.info["pert_mass"], self.dt)
    xfrc = state.data.xfrc_applied.at[self.robot.root, :3].set(force)
    return state.replace(data=state.data.replace(xfrc_applied=xfrc), info=state.info | info)

  def control(self, state: State, action: jax.Array) -> jax.Array:
    return self.robot.default_pose + self._action_scale * action

  def evaluate(self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array) -> State:
    swing = {
      "feet_air_time": info["feet_air_time"] + self.dt,
      "swing_peak": jnp.maximum(info["swing_peak"], data.site_xpos[self.robot.feet, 2]),
    }
    now = self._context(data, {**info, **swing}, action, was_in_air=info["feet_air_time"] > 0)
    rng, obs = self._observe(now)
    rewards = {name: weight * term(now) for name, (weight, term) in self._rewards.items()}
    reward = jnp.clip(sum(rewards.values(), jnp.zeros(())) * self.dt, *self._reward_clip)
    after = self._next_info(now, rng)
    metrics = {f"reward/{name}": value for name, value in rewards.items()}
    metrics["swing_peak"] = after["swing_peak"].mean()
    return State(data, obs, reward, now.done.astype(jnp.float32), metrics, after)

  def _start(self, rng: jax.Array, model: mjx.Model) -> tuple[jax.Array, PhysicsData]:
    """The keyframe, moved and turned on the ground, with a random base velocity."""
    spread = self.config.reset
    qpos, qvel = self.robot.init_qpos, jnp.zeros(self.mj_model.nv)
    rng, key = jax.random.split(rng)
    qpos = qpos.at[:2].add(jax.random.uniform(key, (2,), minval=-spread.xy, maxval=spread.xy))
    rng, key = jax.random.split(rng)
    yaw = jax.random.uniform(key, minval=-spread.yaw, maxval=spread.yaw)
    turn = axis_angle_to_quat(jnp.array([0.0, 0.0, 1.0]), yaw)
    qpos = qpos.at[3:7].set(quat_mul(qpos[3:7], turn))
    rng, key = jax.random.split(rng)
    qvel = qvel.at[:6].set(jax.random.uniform(key, (6,), minval=-spread.base_vel, maxval=spread.base_vel))
    return rng, self.physics.forward(model, self.physics.make(qpos=qpos, qvel=qvel, ctrl=qpos[7:]))

  def _context(
    self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array, was_in_air: jax.Array | bool = False
  ) -> Context:
    contact = self.robot.contact(data)
    # A foot that touched in the step before but left the floor since has landed, too.
    first = was_in_air & (contact | info["last_contact"])
    now = Context(self.robot, data, info, action, contact, first, jnp.zeros((), bool))
    done = jnp.array([f(now, threshold) for f, threshold in self._terminations], bool).any()
    return dataclasses.replace(now, done=done)

  def _observe(self, now: Context) -> tuple[jax.Array, dict[str, jax.Array]]:
    clean = {name: OBSERVATIONS[name](now) for name in self._noise}
    rng, noisy = add_noise(now.info["rng"], clean, self._noise)
    obs = {}
    for group, parts in self._obs.items():
      known = noisy if group == ACTOR else obs
      obs[group] = jnp.concatenate([known[part] if part in known else OBSERVATIONS[part](now) for part in parts])
    return rng, obs

  def _next_info(self, now: Context, rng: jax.Array) -> dict[str, Any]:
    """What the next step starts from. (A gait's phase, for bipeds, is to be advanced here.)"""
    info = now.info
    rng, command_key, timer_key = jax.random.split(rng, 3)
    steps = info["steps_until_next_cmd"] - 1
    due = steps <= 0
    timer = exponential_steps(timer_key, self._command_duration, self.dt)
    return {
      **info,
      "rng": rng,
      "command": jnp.where(due, self._commands.next(command_key, info["command"]), info["command"]),
      "steps_until_next_cmd": jnp.where(due | now.done, timer, steps),
      "last_last_act": info["last_act"],
      "last_act": now.action,
      "feet_air_time": jnp.where(now.contact, 0.0, info["feet_air_time"]),
      "swing_peak": jnp.where(now.contact, 0.0, info["swing_peak"]),
      "last_contact": now.contact,
    }


def _amplitudes(config: Any) -> dict[str, float]:
  for name in config.scales:
    lookup(OBSERVATIONS, name, "env.noise.scales")
  return {name: config.level * config.scales[name] for name in OBSERVATIONS if name in config.scales}


def _set_gains(mj_model: mujoco.MjModel, kp: float, damping: float) -> None:
  """Gives every position servo the gain `kp` (N m/rad) and every joint but the free one `damping` (N m s/rad)."""
  mj_model.actuator_gainprm[:, 0] = kp
  mj_model.actuator_biasprm[:, 1] = -kp
  mj_model.dof_damping[6:] = damping
