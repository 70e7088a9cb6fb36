"""Gaits: when each foot is to be in the air, and how high.

A foot's phase runs from -pi, where it leaves the floor, over 0, where it is highest, to pi, where it is back.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from playground.mdp.legged import LeggedRobot

Info = dict[str, Any]
AT_REST = np.pi  # the phase of a foot that stays on the floor


@dataclasses.dataclass(frozen=True)
class Gait:
  """The feet's phases over an episode.

  Attributes:
    modes: the feet's phases at the start for each gait, one of which an episode has, rad, shape [gaits, feet].
    frequency: range of the steps' frequency, one value for an episode, Hz.
    foot_height: range of how high the feet should swing, one value for an episode, m; None draws none.
    rest_when_still: both feet stay on the floor while the command is to stand still.
    dt: control step, s.
    parity: after a rest the feet go on in step with each other (Playground 0.2.0), instead of in their gait.
  """

  modes: Sequence[Sequence[float]]
  frequency: tuple[float, float]
  foot_height: tuple[float, float] | None
  rest_when_still: bool
  dt: float
  parity: bool = False

  @property
  def keys(self) -> tuple[str, ...]:
    """Names of the random keys that `start` needs."""
    chosen = ("gait",) if len(self.modes) > 1 else ()
    return ("gait_frequency", *chosen, *(("foot_height",) if self.foot_height else ()))

  def start(self, keys: Mapping[str, jax.Array]) -> Info:
    """Draws an episode's gait.

    Returns:
      Entries of `info`: `phase` (rad, shape [feet]), `phase_dt` (rad in a control step), `gait` (index of the mode),
      `gait_freq` (Hz) and, if it is drawn, `foot_height` (m).
    """
    mode = jax.random.randint(keys["gait"], (), 0, len(self.modes)) if "gait" in self.keys else jnp.zeros((), jnp.int32)
    low, high = self.frequency
    frequency = jax.random.uniform(keys["gait_frequency"], minval=low, maxval=high)
    info = {
      "phase": jnp.array(self.modes)[mode],
      "phase_dt": 2 * jnp.pi * self.dt * frequency,
      "gait": mode,
      "gait_freq": frequency,
    }
    if self.foot_height:
      low, high = self.foot_height
      info["foot_height"] = jax.random.uniform(keys["foot_height"], minval=low, maxval=high)
    return info

  def advance(self, info: Mapping[str, Any], still: jax.Array) -> Info:
    """Moves the phases one control step on.

    Args:
      info: the entries of `start`.
      still: whether the command is to stand still, bool.

    Returns:
      The entries that changed.
    """
    phase = info["phase"]
    if self.rest_when_still and not self.parity:
      phase = jnp.where((phase == AT_REST).all(), jnp.array(self.modes)[info["gait"]], phase)
    phase = jnp.fmod(phase + info["phase_dt"] + jnp.pi, 2 * jnp.pi) - jnp.pi
    return {"phase": jnp.where(still, AT_REST, phase) if self.rest_when_still else phase}


def make_gait(config: Any, robot: LeggedRobot, dt: float, parity: bool) -> Gait | None:
  """Builds what `env.gait` describes, None if it names no gait; the names are those of the robot's `gaits`."""
  frequency, height, rest = tuple(config.frequency), config.foot_height, config.rest_when_still
  if not config.modes:
    return None
  modes = [robot.gait(name) for name in config.modes]
  if not parity:  # else a foot may start outside the range of phases, where its height is another (Playground 0.2.0)
    modes = [[phase - 2 * np.pi if phase > np.pi else phase for phase in phases] for phases in modes]
  return Gait(modes, frequency, height and tuple(height), rest, dt, parity)


def swing_height(phase: jax.Array, peak: jax.Array | float) -> jax.Array:
  """Returns how high a foot should be at its phase: `peak` times 3u² - 2u³, u rising to 1 at phase 0 and falling back.

  (Paper, appendix "Locomotion", feet phase. The polynomial goes on beyond +- pi.)
  """
  place = (phase + jnp.pi) / (2 * jnp.pi)
  rise, fall = 2 * place, 2 * place - 1
  smooth = lambda u: 3 * u**2 - 2 * u**3
  return peak * jnp.where(place <= 0.5, smooth(rise), 1 - smooth(fall))
