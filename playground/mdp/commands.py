"""Command terms: velocities to track, and gaits.

A command is a class whose fields are the term's `params`. `bind(env)` looks names up once; `reset(key)` returns the
entries of `info` that an episode starts with, `step(c, key)` those for the next step. An auto-reset keeps them: the
next episode has the same command. A termination, but not a time-out, redraws a velocity command's duration.
"""

import dataclasses
from collections.abc import Sequence
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np

from playground.errors import ConfigError
from playground.limits import AtLeast0, Limit, Positive, Share, Span, Vector
from playground.mdp.context import StepContext
from playground.mdp.legged import is_still

Info = dict[str, Any]
_AT_REST = np.pi  # the phase of a foot that stays on the floor


@dataclasses.dataclass
class _VelocityCommand:
  """Writes `command` [3] (forward m/s, left m/s, turn rad/s) and `command_steps_left`.

  Attributes:
    max: largest command of each component.
    min: smallest; None is -max.
    resample_s: how long a command lasts, s.
    exponential: the time is drawn for each command, `resample_s` is its mean.
  """

  max: Vector
  min: Vector | None = None
  resample_s: Positive = 5.0
  exponential: bool = False

  def bind(self, env: Any) -> None:
    low = [-high for high in self.max] if self.min is None else self.min
    if any(a > b for a, b in zip(low, self.max, strict=True)):
      raise ConfigError(f"params.max={list(self.max)} must not be below min={list(low)}.")
    self._dt: float = env.dt

  def reset(self, key: jax.Array) -> Info:
    key, time_key = jax.random.split(key)
    return {"command": self._first(key), "command_steps_left": self._steps(time_key)}

  def step(self, c: StepContext, key: jax.Array) -> Info:
    key, time_key = jax.random.split(key)
    left = c.info["command_steps_left"] - 1
    due = left <= 0
    return {
      "command": jnp.where(due, self._next(key, c.info["command"]), c.info["command"]),
      "command_steps_left": jnp.where(due | c.terminated, self._steps(time_key), left),
    }

  def _steps(self, key: jax.Array) -> jax.Array:
    seconds = self.resample_s * (jax.random.exponential(key) if self.exponential else jnp.ones(()))
    return jnp.round(seconds / self._dt).astype(jnp.int32)

  def _first(self, key: jax.Array) -> jax.Array:
    """Draws the command that an episode starts with."""
    high = jnp.array(self.max, jnp.float32)
    low = -high if self.min is None else jnp.array(self.min, jnp.float32)
    return jax.random.uniform(key, (3,), minval=low, maxval=high)

  def _next(self, key: jax.Array, command: jax.Array) -> jax.Array:
    """Draws the command that follows another one."""
    return self._first(key)


@dataclasses.dataclass
class UniformVelocity(_VelocityCommand):
  """Draws all components uniformly; some commands ask to stand still.

  Attributes:
    zero_probability: of standing still.
    deadband: a component whose size is below becomes 0.
  """

  zero_probability: Share = 0.0
  deadband: AtLeast0 = 0.0

  def _first(self, key: jax.Array) -> jax.Array:
    key, zero_key = jax.random.split(key)
    command = jnp.where(jax.random.bernoulli(zero_key, self.zero_probability), 0.0, super()._first(key))
    return jnp.where(jnp.abs(command) < self.deadband, 0.0, command)


@dataclasses.dataclass
class VelocityWalk(_VelocityCommand):
  """Changes some components at a time and often sets them to zero, so that policies practise moving on one axis.

  (Playground 0.2.0, joysticks of Go1 and Apollo.)

  Attributes:
    change_probability: of each component, when a new command is due.
    nonzero_probability: of each component, when it changes: else it becomes 0.
  """

  change_probability: Share = 0.5
  nonzero_probability: Annotated[Sequence[float], Limit(0, 1, form="list", length=3)] = (0.9, 0.25, 0.5)

  def _next(self, key: jax.Array, command: jax.Array) -> jax.Array:
    value_key, change_key, nonzero_key = jax.random.split(key, 3)
    nonzero = jax.random.bernoulli(nonzero_key, jnp.array(self.nonzero_probability), (3,))
    change = jax.random.bernoulli(change_key, self.change_probability, (3,))
    return jnp.where(change, self._first(value_key) * nonzero, command)


@dataclasses.dataclass
class Gait:
  """Phases of the feet: when each should be in the air, and how high.

  A foot's phase runs from -pi, where it leaves the floor, over 0, where it is highest, to pi, where it is back. Writes
  `phase` (rad [feet]), `phase_dt` (rad in a control step), `gait` (index of the mode), `gait_freq` (Hz) and, if it is
  drawn, `foot_height` (m).

  Attributes:
    modes: gaits of the robot's YAML, one of which an episode has.
    frequency: range of the steps' frequency, one value for an episode, Hz.
    foot_height: range of the highest swing of the feet, one value for an episode, m; None draws none.
    rest_when_still: all feet stay on the floor while the command asks to stand still.
  """

  modes: Sequence[str]
  frequency: Span = (1.25, 1.5)
  foot_height: Span | None = None
  rest_when_still: bool = False

  def bind(self, env: Any) -> None:
    if not self.modes:
      raise ConfigError("params.modes=[] must name a gait.")
    phases = np.array([env.robot.gait(name) for name in self.modes])
    self._phases = jnp.array(np.where(phases > np.pi, phases - 2 * np.pi, phases))
    self._dt: float = env.dt

  def reset(self, key: jax.Array) -> Info:
    mode_key, frequency_key, height_key = jax.random.split(key, 3)
    mode = jax.random.randint(mode_key, (), 0, len(self.modes))
    frequency = jax.random.uniform(frequency_key, (), float, *self.frequency)
    info = {
      "phase": self._phases[mode],
      "phase_dt": 2 * jnp.pi * self._dt * frequency,
      "gait": mode,
      "gait_freq": frequency,
    }
    if self.foot_height is not None:
      info["foot_height"] = jax.random.uniform(height_key, (), float, *self.foot_height)
    return info

  def step(self, c: StepContext, key: jax.Array) -> Info:
    phase = c.info["phase"]
    if self.rest_when_still:
      phase = jnp.where((phase == _AT_REST).all(), self._phases[c.info["gait"]], phase)
    phase = jnp.fmod(phase + c.info["phase_dt"] + jnp.pi, 2 * jnp.pi) - jnp.pi
    if self.rest_when_still:
      phase = jnp.where(is_still(c.command), _AT_REST, phase)
    return {"phase": phase}
