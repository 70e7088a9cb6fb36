"""Commands: what is drawn, for how long; gaits: what an episode draws, how phases go on, how high feet should be."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.errors import ConfigError, UnknownNameError
from playground.mdp.commands import Gait, UniformVelocity, VelocityWalk
from playground.mdp.legged import LeggedRobot, swing_height
from playground.mdp.terms import bind
from tests.mdp.context import context

KEYS = jax.random.split(jax.random.PRNGKey(0), 20_000)
MAX = (1.5, 0.8, 1.2)
NONZERO = (0.9, 0.25, 0.5)
OLD = jnp.array([9.0, 9.0, 9.0])  # outside all ranges, so that what was kept can be told


def bound(command: Any, robot: Any = None) -> Any:
  command.bind(SimpleNamespace(dt=0.02, robot=robot))
  return command


def after(command: Any, left: int, terminated: bool = False) -> Any:
  """`info` after steps of many episodes of which so many were left."""
  c = context(terminated=terminated, command_steps_left=jnp.array(left), command=(9.0, 9.0, 9.0))
  return jax.jit(jax.vmap(lambda key: command.step(c, key)))(KEYS)


def test_a_walk_begins_anywhere_and_keeps_zeroes_or_redraws_each_component() -> None:
  walk = bound(VelocityWalk(MAX, change_probability=0.4, nonzero_probability=NONZERO))
  first = jax.vmap(walk.reset)(KEYS)["command"]
  np.testing.assert_allclose([first.max(0), -first.min(0)], [MAX, MAX], rtol=1e-2)
  np.testing.assert_allclose(first.mean(0), 0, atol=0.02)
  commands = after(walk, left=1)["command"]
  kept, zero = (commands == OLD).mean(0), (commands == 0).mean(0)
  np.testing.assert_allclose(kept, 0.6, atol=0.02)
  np.testing.assert_allclose(zero, 0.4 * (1 - jnp.array(NONZERO)), atol=0.02)
  drawn = jnp.where((commands == OLD) | (commands == 0), 0, commands)
  np.testing.assert_allclose(jnp.abs(drawn).max(0), MAX, rtol=2e-2)


def test_uniform_commands_are_drawn_anew_or_zero() -> None:
  uniform = bound(UniformVelocity((1.0, 0.0, 2.0), (-1.0, 0.0, 0.5), zero_probability=0.3, deadband=0.2))
  for commands in (jax.vmap(uniform.reset)(KEYS)["command"], after(uniform, left=1)["command"]):
    still = (np.asarray(commands) == 0).all(1)
    np.testing.assert_allclose(still.mean(), 0.3, atol=0.02)
    x, y, yaw = np.asarray(commands)[~still].T
    assert not y.any()
    np.testing.assert_allclose([x.min(), x.max(), yaw.min(), yaw.max()], [-1, 1, 0.5, 2], atol=1e-2)
    np.testing.assert_allclose((x == 0).mean(), 0.2, atol=0.02)
    assert np.abs(x[x != 0]).min() >= 0.2


@pytest.mark.parametrize(
  ("left", "terminated", "drawn", "fresh"), [(3, False, False, False), (1, False, True, True), (3, True, False, True)]
)
def test_a_command_lasts_its_time_which_the_end_of_an_episode_starts_over(
  left: int, terminated: bool, drawn: bool, fresh: bool
) -> None:
  info = after(bound(UniformVelocity(MAX, resample_s=0.2)), left, terminated)
  assert (info["command"] != OLD).any(-1).all() == drawn
  assert (info["command_steps_left"] == (10 if fresh else left - 1)).all()


def test_times_may_be_exponential() -> None:
  steps = jax.vmap(bound(UniformVelocity(MAX, resample_s=5.0, exponential=True)).reset)(KEYS)["command_steps_left"]
  assert steps.dtype == jnp.int32 and (steps >= 0).all()
  np.testing.assert_allclose([steps.mean(), steps.std()], 250, rtol=0.03)


def test_refusals() -> None:
  (term,) = bind("commands", {"mine": {"func": "uniform_velocity", "params": {"max": MAX, "min": [2.0, 0.0, 0.0]}}})
  with pytest.raises(
    ConfigError, match=r"^env\.commands\.mine\.params\.max=\[1\.5, .*\] must not be below min=\[2\.0, 0\.0, 0\.0\]"
  ):
    term.instantiate(SimpleNamespace(dt=0.02))
  with pytest.raises(ConfigError, match=r"velocity\.params\.nonzero_probability=.* must be 3 numbers from 0 to 1"):
    walk = {"func": "velocity_walk", "params": {"max": MAX, "nonzero_probability": (1.0, 1.0)}}
    bind("commands", {"velocity": walk})


# Gaits

ROBOT: Any = LeggedRobot.__new__(LeggedRobot)
ROBOT._gaits = {"walk": (0.0, np.pi), "jump": (0.0, 0.0), "late": (0.0, 1.5 * np.pi), "trot": (0.0, 1.0, 2.0)}
ROBOT.feet = np.array([3, 4])


def gait(*modes: str, **options: Any) -> Gait:
  return bound(Gait(modes, (1.0, 2.0), **options), ROBOT)


def test_what_a_gait_draws() -> None:
  info = jax.vmap(gait("walk", "jump", foot_height=(0.1, 0.3)).reset)(KEYS)
  np.testing.assert_allclose([info["gait_freq"].min(), info["gait_freq"].max()], [1, 2], atol=0.01)
  np.testing.assert_allclose([info["foot_height"].min(), info["foot_height"].max()], [0.1, 0.3], atol=0.01)
  np.testing.assert_allclose(info["gait"].mean(), 0.5, atol=0.05)
  np.testing.assert_allclose(info["phase"], jnp.array([[0, np.pi], [0, 0]])[info["gait"]])
  np.testing.assert_allclose(info["phase_dt"], 2 * np.pi * 0.02 * info["gait_freq"], rtol=1e-6)
  assert "foot_height" not in gait("walk").reset(KEYS[0])


def roll(of: Gait, still: list[bool]) -> np.ndarray:
  """Phases after each step."""
  info, phases = of.reset(KEYS[0]), []
  for now in still:
    c = context((0.0, 0.0, 0.0) if now else (1.0, 0.0, 0.0), **info)
    info = info | of.step(c, KEYS[0])
    phases.append(info["phase"])
  return np.array(phases)


def test_feet_stay_half_a_period_apart() -> None:
  phases = roll(gait("walk"), [True, False] * 50)  # this gait goes on when still
  assert (phases >= -np.pi).all() and (phases <= np.pi).all()
  np.testing.assert_allclose(np.exp(1j * phases[:, 0]), -np.exp(1j * phases[:, 1]), atol=1e-4)
  steps = np.angle(np.exp(1j * np.diff(phases[:, 0])))
  assert (steps > 0).all()
  np.testing.assert_allclose(steps, steps[0], rtol=1e-3)


def test_after_a_rest_the_gait_begins_anew() -> None:
  phases = roll(gait("walk", rest_when_still=True), [False, True, True, False, False])
  assert (phases[1:3] == np.float32(np.pi)).all()
  np.testing.assert_array_equal(phases[3], phases[0])


def test_swing_height() -> None:
  phases = jnp.array([-np.pi, -np.pi / 2, 0.0, np.pi / 2, np.pi])
  np.testing.assert_allclose(swing_height(phases, 0.2), [0, 0.1, 0.2, 0.1, 0], atol=1e-6)
  np.testing.assert_allclose(swing_height(jnp.array(-0.75 * np.pi), 1.0), 3 / 16 - 2 / 64, rtol=1e-5)


def test_gaits_are_the_robots() -> None:
  np.testing.assert_allclose(gait("late").reset(KEYS[0])["phase"], [0.0, -0.5 * np.pi], rtol=1e-6)
  with pytest.raises(UnknownNameError, match=r"^params\.modes: 'wlk' is unknown.*Did you mean 'walk'"):
    gait("wlk")
  with pytest.raises(ConfigError, match=r"env\.robot\.gaits\.trot must hold 2 phases"):
    gait("trot")
  with pytest.raises(ConfigError, match=r"^params\.modes=\[\] must name a gait"):
    gait()


def test_a_robot_without_gaits() -> None:
  robot: Any = LeggedRobot.__new__(LeggedRobot)
  robot._gaits = {}
  (term,) = bind("commands", {"gait": {"params": {"modes": ["walk"]}}})
  message = r"^env\.commands\.gait: env\.robot\.gaits is empty or missing, so that there is no gait 'walk'\.$"
  with pytest.raises(ConfigError, match=message):
    term.instantiate(SimpleNamespace(dt=0.02, robot=robot))
