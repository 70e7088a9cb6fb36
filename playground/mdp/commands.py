"""What a joystick asks for: samplers of (forward m/s, left m/s, turn rad/s) and of how long a command lasts."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp

from playground.mdp.lookup import lookup


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

  First: c ~ U(-max, max). Next, for each component: with probability `change_probability` it becomes U(-max, max), or 0
  with probability 1 - `nonzero_probability`; else it stays. (Playground 0.2.0, Go1 joystick.)

  Attributes:
    max: largest command of each component (m/s, m/s, rad/s; paper, appendix "Locomotion": 1.5, 0.8, 1.2 on Go1).
    nonzero_probability: of each component, when it changes.
    change_probability: of any component, when a new command is due.
  """

  max: Sequence[float]
  nonzero_probability: Sequence[float]
  change_probability: float

  def first(self, key: jax.Array) -> jax.Array:
    high = jnp.array(self.max)
    return jax.random.uniform(key, (3,), minval=-high, maxval=high)

  def next(self, key: jax.Array, command: jax.Array) -> jax.Array:
    _, value_key, change_key, nonzero_key = jax.random.split(key, 4)
    nonzero = jax.random.bernoulli(nonzero_key, jnp.array(self.nonzero_probability), (3,))
    change = jax.random.bernoulli(change_key, self.change_probability, (3,))
    return jnp.where(change, self.first(value_key) * nonzero, command)


def exponential_steps(key: jax.Array, mean: float, dt: float) -> jax.Array:
  """Draws a number of control steps, int32: an exponentially distributed time of mean `mean` (s) over `dt` (s)."""
  return jnp.round(jax.random.exponential(key) * mean / dt).astype(jnp.int32)


SAMPLERS: dict[str, Callable[[Any], CommandSampler]] = {
  "walk": lambda config: Walk(tuple(config.max), tuple(config.nonzero_probability), config.change_probability),
}


def make_sampler(config: Any) -> CommandSampler:
  """Builds the sampler that `env.command.sampler` names from the keys it needs beside it."""
  return lookup(SAMPLERS, config.sampler, "env.command.sampler")(config)
