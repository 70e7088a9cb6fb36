"""Follow a joystick's velocity commands on legs: one task for all robots, composed by config."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco

from playground.envs.base import State
from playground.envs.locomotion.legged import LeggedTask
from playground.envs.physics import mjx
from playground.errors import ConfigError
from playground.mdp.commands import make_sampler, make_timer
from playground.mdp.gait import make_gait
from playground.mdp.keys import split_keys
from playground.mdp.legged import Context
from playground.mdp.lookup import lookup
from playground.mdp.pushes import make_pushes
from playground.robots.scene import configured_scene

_DRAWS = ("xy", "yaw", "joint_scale", "base_vel", "gait_frequency", "gait", "foot_height", "command", "command_timer",
          "push_interval", "push_duration", "push_velocity", "noise")  # fmt: skip


class Joystick(LeggedTask):
  """Tracks commanded forward, sideways and turning velocity (paper: appendix "Locomotion", joystick tasks).

  Which rewards, observations, commands, gait, noise, pushes and terminations there are and how they weigh is
  `configs/env/joystick.yaml`; what bipeds have otherwise is `configs/env/biped_joystick.yaml`, and what tracking a gait
  asks for besides (paper: gait tracking, with a joystick and in place) `configs/env/gait_tracking.yaml`.

  The defaults differ from Playground 0.2.0 as follows; `env.parity=true` has its ways:
  - soft joint limits shrink the range about its centre (0.2.0 scales the Go1's bounds, which lets the knees pass the
    hard limit);
  - a kick is as strong as it says on the robot at hand (0.2.0 takes the mass before randomisation);
  - scaled joint angles of a start stay within the joints' limits;
  - Apollo, Barkour, H1, OP3 and Spot start with their targets where their joints are (0.2.0: all 0);
  - after standing still the legs take up their gait again (0.2.0's T1 and Apollo move both feet in step from then on);
  - Barkour, H1, OP3 and Spot observe the direction of gravity in their own frame (0.2.0: the upward axis in the world
    frame, which depends on the heading);
  - Spot observes the command that it should follow in a gait, and only gaits that should keep the base level punish its
    going up and down (0.2.0: only the others); a foot's phase starts within +- pi (0.2.0: one of Spot's walk does not);
  - the H1's contacts are those of its feet (0.2.0 reads other sensors), and its change of action is that of the actions
    in their order;
  - Barkour's joints may leave their default pose while it moves (0.2.0: only if the command is to the left);
  - every fall of Barkour and OP3 costs (0.2.0: not those in the last step of a command);
  - noise on the position of Spot's feet is independent in x, y and z (0.2.0: the same draw);
  - hips may roll while the command is sideways, and only then (0.2.0: Berkeley Humanoid's and T1's hips are free while
    it is not; on the G1 the weights of the four joints multiply each of them).
  """

  logged = ("swing_peak",)
  summaries: ClassVar[Mapping[str, str]] = {"tracking_error/lin_vel": "mean", "tracking_error/ang_vel": "mean"}

  def __init__(self, config: Any):
    """Builds the task, as `LeggedTask`.

    Raises:
      UnknownNameError: also a command sampler, timer, kind of pushes, gait or random draw that does not exist.
      ConfigError: also a gait that has not one phase for each foot.
    """
    super().__init__(config)
    self._commands = make_sampler(config.command)
    self._timer = make_timer(config.command, self.dt)
    self._gait = make_gait(config.gait, self.robot, self.dt, self.parity)
    self._pushes = make_pushes(config.pushes, self.robot.root, self.dt)
    gait_draws = self._gait.keys if self._gait else ()
    noise = ("noise",) if self._own_noise_key else ()
    self._draws = (*self._spread_draws, *gait_draws, "command", *self._timer.keys, *self._pushes.keys, *noise)
    self._draw_order = [tuple(group) for group in config.reset.draw_order]
    for group in self._draw_order:
      for name in group:
        lookup(dict.fromkeys(_DRAWS), name, "env.reset.draw_order")
    self._starts_at_zero: bool = config.reset.parity_zero_ctrl and self.parity

  def _scene(self, config: Any) -> mujoco.MjSpec:
    spec = configured_scene(config)
    if config.restricted_joint_range:
      if "restricted_range" not in config.robot:
        raise ConfigError(f"env.restricted_joint_range: robot={config.robot.name} has no restricted_range.")
      for name in config.robot.restricted_range:
        spec.joint(name).range = config.robot.restricted_range[name]
    return spec

  def _reward_facts(self) -> dict[str, Any]:
    return super()._reward_facts() | {"gait_modes": tuple(self.config.gait.modes)}

  @property
  def _step_draws(self) -> tuple[str, ...]:
    return ("command", "noise", *self._timer.keys)

  def reset(self, rng: jax.Array, model: mjx.Model | None = None) -> State:
    model = self.mjx_model if model is None else model
    rng, keys = split_keys(rng, self._draws, self._draw_order)
    qpos, qvel = self._spread_start(keys, self.robot.init_qpos)
    feet = len(self.robot.feet)
    info = {
      "rng": rng,
      "command": self._commands.first(keys["command"]),
      "last_last_act": jnp.zeros(self.action_size),
      "feet_air_time": jnp.zeros(feet),
      "swing_peak": jnp.zeros(feet),
      "last_contact": jnp.zeros(feet, bool),
      **self._timer.start(keys),
      **self._pushes.start(keys, self.robot.mass(self.mjx_model if self.parity else model)),
      **(self._gait.start(keys) if self._gait else {}),
    }
    ctrl = jnp.zeros(self.action_size) if self._starts_at_zero else None
    return self._first_state(self._start(model, qpos, qvel, ctrl), info, keys.get("noise"))

  def disturb(self, state: State) -> State:
    state = super().disturb(state)
    data, changed = self._pushes.act(state.data, state.info)
    return state.replace(data=data, info=state.info | changed)

  def _track(self, now: Context) -> Context:
    """Counts this step into the feet's swings, and says which foot lands."""
    if self.robot.misreads_contact:
      now = dataclasses.replace(now, contact=self.robot.misread_contact(now.data))
    was_in_air = now.info["feet_air_time"] > 0
    swing = {
      "feet_air_time": now.info["feet_air_time"] + self.dt,
      "swing_peak": jnp.maximum(now.info["swing_peak"], now.feet_height),
    }
    # A foot that touched in the step before but left the floor since has landed, too.
    first = was_in_air & (now.contact | now.info["last_contact"])
    return dataclasses.replace(now, info={**now.info, **swing}, first_contact=first)

  def _measure(self, now: Context) -> dict[str, jax.Array]:
    """Adds by how much the velocity in the base's frame misses the command: horizontally, m/s, and turning, rad/s."""
    linvel, gyro, command = now.sensor("linvel"), now.sensor("gyro"), now.command
    return super()._measure(now) | {
      "tracking_error/lin_vel": jnp.linalg.norm(command[:2] - linvel[:2]),
      "tracking_error/ang_vel": jnp.abs(command[2] - gyro[2]),
    }

  def _next_info(self, now: Context, rng: jax.Array, keys: Mapping[str, jax.Array]) -> dict[str, Any]:
    """Ends the swings of feet on the floor, moves the gait on and draws the next command when it is due."""
    info = now.info
    if not keys:
      rng, keys = split_keys(rng, (), [("command", *self._timer.keys)])
    due, timer = self._timer.advance(info, now.done, keys)
    return {
      **super()._next_info(now, rng, keys),
      "command": jnp.where(due, self._commands.next(keys["command"], info["command"]), info["command"]),
      "feet_air_time": jnp.where(now.contact, 0.0, info["feet_air_time"]),
      "swing_peak": jnp.where(now.contact, 0.0, info["swing_peak"]),
      "last_contact": now.contact,
      **timer,
      **(self._gait.advance(info, now.still) if self._gait else {}),
    }
