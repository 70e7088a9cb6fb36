"""Gaits: what an episode draws, how phases go on, and how high a foot should be."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ml_collections import ConfigDict

from playground.errors import ConfigError, UnknownNameError
from playground.mdp.gait import AT_REST, Gait, make_gait, swing_height
from playground.mdp.keys import split_keys
from playground.mdp.legged import LeggedRobot

WALK, JUMP = (0.0, np.pi), (0.0, 0.0)
KEYS = jax.random.split(jax.random.PRNGKey(0), 2000)


def gait(modes: Any = (WALK,), height: Any = None, rest: bool = False, parity: bool = False) -> Gait:
  return Gait(modes, (1.0, 2.0), height, rest, dt=0.02, parity=parity)


def test_draws() -> None:
  both = gait((WALK, JUMP), height=(0.1, 0.3))
  info = jax.vmap(lambda key: both.start(split_keys(key, both.keys)[1]))(KEYS)
  np.testing.assert_allclose([info["gait_freq"].min(), info["gait_freq"].max()], [1, 2], atol=0.01)
  np.testing.assert_allclose([info["foot_height"].min(), info["foot_height"].max()], [0.1, 0.3], atol=0.01)
  np.testing.assert_allclose(info["gait"].mean(), 0.5, atol=0.05)
  np.testing.assert_allclose(info["phase"], jnp.array([WALK, JUMP])[info["gait"]])
  np.testing.assert_allclose(info["phase_dt"], 2 * np.pi * 0.02 * info["gait_freq"], rtol=1e-6)


def test_one_gait_needs_one_draw() -> None:
  one = gait()
  assert one.keys == ("gait_frequency",)
  assert "foot_height" not in one.start({"gait_frequency": KEYS[0]})


def roll(of: Gait, still: list[bool]) -> np.ndarray:
  """Phases after each step."""
  info, phases = of.start({"gait_frequency": KEYS[0]}), []
  for now in still:
    info = info | of.advance(info, jnp.array(now))
    phases.append(info["phase"])
  return np.array(phases)


def test_feet_stay_half_a_period_apart() -> None:
  phases = roll(gait(), [True, False] * 50)  # this gait goes on when still
  assert (phases >= -np.pi).all() and (phases <= np.pi).all()
  np.testing.assert_allclose(np.exp(1j * phases[:, 0]), -np.exp(1j * phases[:, 1]), atol=1e-4)
  steps = np.angle(np.exp(1j * np.diff(phases[:, 0])))
  assert (steps > 0).all()
  np.testing.assert_allclose(steps, steps[0], rtol=1e-3)


@pytest.mark.parametrize("parity", [False, True])
def test_after_a_rest(parity: bool) -> None:
  phases = roll(gait(rest=True, parity=parity), [False, True, True, False, False])
  assert (phases[1:3] == np.float32(AT_REST)).all()
  if parity:
    np.testing.assert_array_equal(phases[3:, 0], phases[3:, 1])  # in step with each other
  else:
    np.testing.assert_array_equal(phases[3], phases[0])  # the gait begins anew


def test_swing_height() -> None:
  phases = jnp.array([-np.pi, -np.pi / 2, 0.0, np.pi / 2, np.pi])
  np.testing.assert_allclose(swing_height(phases, 0.2), [0, 0.1, 0.2, 0.1, 0], atol=1e-6)
  np.testing.assert_allclose(swing_height(jnp.array(-0.75 * np.pi), 1.0), 3 / 16 - 2 / 64, rtol=1e-5)


def test_gaits_are_the_robots() -> None:
  robot: Any = LeggedRobot.__new__(LeggedRobot)
  robot._gaits, robot.feet = {"walk": WALK, "trot": (0.0, 1.0, 2.0)}, np.array([3, 4])
  config = ConfigDict({"modes": ["walk"], "frequency": [1.0, 2.0], "foot_height": None, "rest_when_still": False})
  assert make_gait(config, robot, 0.02, False) == Gait([list(WALK)], (1.0, 2.0), None, False, 0.02)
  robot._gaits["late"] = (0.0, 1.5 * np.pi)
  for parity, second in ((False, -0.5 * np.pi), (True, 1.5 * np.pi)):  # parity: beyond the range of phases
    late = make_gait(ConfigDict({**config, "modes": ["late"]}), robot, 0.02, parity)
    np.testing.assert_allclose(late.modes, [[0.0, second]])  # pyright: ignore[reportOptionalMemberAccess]
  assert make_gait(ConfigDict({**config, "modes": []}), SimpleNamespace(), 0.02, False) is None  # pyright: ignore
  with pytest.raises(UnknownNameError, match=r"env\.gait\.modes: 'wlk' is unknown.*Did you mean 'walk'"):
    make_gait(ConfigDict({**config, "modes": ["wlk"]}), robot, 0.02, False)
  with pytest.raises(ConfigError, match=r"env\.robot\.gaits\.trot must hold 2 phases"):
    make_gait(ConfigDict({**config, "modes": ["trot"]}), robot, 0.02, False)
