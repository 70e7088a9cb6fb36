"""What a joystick asks for: samplers of (forward m/s, left m/s, turn rad/s), and timers of how long a command lasts."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp

from playground.mdp.lookup import lookup

Info = dict[str, Any]


class CommandSampler(Protocol):
  """Draws commands, shape [3]."""

  def first(self, key: jax.Array) -> jax.Array:
    """Draws the command that an episode starts with."""
    ...

  def next(self, key: jax.Array, command: jax.Array) -> jax.Array:
    """Draws the command that follows `command`."""
    ...


@dataclasses.dataclass(frozen=True)
class Walk:
  """Changes some components at a time and often sets them to zero, so that moving on one axis alone is practised.

  First: c ~ U(min, max). Next, for each component: with probability `change_probability` it becomes U(min, max), or 0
  with probability 1 - `nonzero_probability`; else it stays. (Playground 0.2.0, Go1 and Apollo joystick.)

  Attributes:
    min: smallest command of each component (m/s, m/s, rad/s).
    max: largest (paper, appendix "Locomotion": 1.5, 0.8, 1.2 on Go1).
    nonzero_probability: of each component, when it changes.
    change_probability: of any component, when a new command is due.
  """

  min: Sequence[float]
  max: Sequence[float]
  nonzero_probability: Sequence[float]
  change_probability: float

  def first(self, key: jax.Array) -> jax.Array:
    return jax.random.uniform(key, (3,), minval=jnp.array(self.min), maxval=jnp.array(self.max))

  def next(self, key: jax.Array, command: jax.Array) -> jax.Array:
    _, value_key, change_key, nonzero_key = jax.random.split(key, 4)
    nonzero = jax.random.bernoulli(nonzero_key, jnp.array(self.nonzero_probability), (3,))
    change = jax.random.bernoulli(change_key, self.change_probability, (3,))
    return jnp.where(change, self.first(value_key) * nonzero, command)


@dataclasses.dataclass(frozen=True)
class Box:
  """Draws all components anew: c ~ U(min, max), with probability `zero_probability` all 0.

  Attributes:
    min: smallest command of each component (m/s, m/s, rad/s).
    max: largest.
    zero_probability: of standing still.
    deadband: a component whose size is below becomes 0.
    unused_keys: how many random keys are split off and left unused first. (Playground 0.2.0's order of draws.)
  """

  min: Sequence[float]
  max: Sequence[float]
  zero_probability: float
  deadband: float
  unused_keys: int = 0

  def first(self, key: jax.Array) -> jax.Array:
    *keys, zero_key = jax.random.split(key, 4 + self.unused_keys)[self.unused_keys :]
    bounds = zip(keys, self.min, self.max, strict=True)
    command = jnp.stack([jax.random.uniform(k, minval=low, maxval=high) for k, low, high in bounds])
    command = jnp.where(jax.random.bernoulli(zero_key, self.zero_probability), 0.0, command)
    return jnp.where(jnp.abs(command) < self.deadband, 0.0, command)

  def next(self, key: jax.Array, command: jax.Array) -> jax.Array:
    del command
    return self.first(key)


def make_sampler(config: Any) -> CommandSampler:
  """Builds the sampler that `env.command.sampler` names; `min: null` is the opposite of `max`."""
  high = tuple(config.max)
  low = tuple(-x for x in high) if config.min is None else tuple(config.min)
  samplers: dict[str, CommandSampler] = {
    "walk": Walk(low, high, tuple(config.nonzero_probability), config.change_probability),
    "box": Box(low, high, config.zero_probability, config.deadband, config.unused_keys),
  }
  return lookup(samplers, config.sampler, "env.command.sampler")


class Timer(Protocol):
  """Says when a command is due.

  Attributes:
    keys: names of the random keys that `start` and `advance` need.
  """

  keys: ClassVar[tuple[str, ...]]

  def start(self, keys: Mapping[str, jax.Array]) -> Info:
    """Returns the entries of `info` that an episode starts with."""
    ...

  def advance(self, info: Mapping[str, Any], done: jax.Array, keys: Mapping[str, jax.Array]) -> tuple[jax.Array, Info]:
    """Counts a step; an episode that ends starts the count anew, but keeps its command.

    Returns:
      Whether a new command is due, bool, and the entries of `info` that changed.
    """
    ...


@dataclasses.dataclass(frozen=True)
class ExponentialTimer:
  """A command lasts an exponentially distributed time of mean `duration` (s), in control steps of `dt` (s)."""

  keys: ClassVar[tuple[str, ...]] = ("command_timer",)
  duration: float
  dt: float

  def start(self, keys: Mapping[str, jax.Array]) -> Info:
    return {"steps_until_next_cmd": exponential_steps(keys["command_timer"], self.duration, self.dt)}

  def advance(self, info: Mapping[str, Any], done: jax.Array, keys: Mapping[str, jax.Array]) -> tuple[jax.Array, Info]:
    steps = info["steps_until_next_cmd"] - 1
    due = steps <= 0
    return due, {"steps_until_next_cmd": jnp.where(due | done, self.start(keys)["steps_until_next_cmd"], steps)}


@dataclasses.dataclass(frozen=True)
class FixedTimer:
  """A command lasts `duration` (s), in control steps of `dt` (s)."""

  keys: ClassVar[tuple[str, ...]] = ()
  duration: float
  dt: float

  def start(self, keys: Mapping[str, jax.Array]) -> Info:
    del keys
    return {"step": jnp.zeros((), jnp.int32)}

  def advance(self, info: Mapping[str, Any], done: jax.Array, keys: Mapping[str, jax.Array]) -> tuple[jax.Array, Info]:
    del keys
    step = info["step"] + 1
    due = step >= round(self.duration / self.dt)
    return due, {"step": jnp.where(due | done, 0, step)}


def make_timer(config: Any, dt: float) -> Timer:
  """Builds the timer that `env.command.timer` names."""
  timers: dict[str, type[ExponentialTimer | FixedTimer]] = {"exponential": ExponentialTimer, "fixed": FixedTimer}
  return lookup(timers, config.timer, "env.command.timer")(config.duration, dt)


def exponential_steps(key: jax.Array, mean: float, dt: float) -> jax.Array:
  """Draws a number of control steps, int32: an exponentially distributed time of mean `mean` (s) over `dt` (s)."""
  return jnp.round(jax.random.exponential(key) * mean / dt).astype(jnp.int32)
