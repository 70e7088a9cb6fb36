"""Walker: rewards by hand, the height that 0.2.0 does not observe, and where episodes start."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.envs.dm_control.walker import Walker
from tests.envs.dm_control.states import state_at
from tests.envs.golden import load_task


@pytest.fixture(scope="module")
def tasks() -> dict[str, Walker]:
  return {name: load_task(name) for name in ("WalkerStand", "WalkerWalk", "WalkerRun")}


def pose(z: float = 1.3, pitch: float = 0.0) -> np.ndarray:
  """`qpos` with straight legs and the torso's centre at `z`."""
  return np.array([z - 1.3, 7, pitch, *[0.0] * 6])


STANDING = [  # pose, standing, upright
  (pose(), 1, 1),
  (pose(z=1.2, pitch=np.pi / 3), 1, 0.75),
  (pose(z=0.6), 0.1, 1),
  (pose(pitch=np.pi), 1, 0),
]


@pytest.mark.parametrize(("qpos", "standing", "upright"), STANDING)
def test_standing_weighs_three_times_uprightness(
  tasks: dict[str, Walker], qpos: np.ndarray, standing: float, upright: float
) -> None:
  stand = (3 * standing + upright) / 4
  for name, factor in [("WalkerStand", 1), ("WalkerWalk", 1 / 6), ("WalkerRun", 1 / 6)]:  # at rest
    state = tasks[name].post_step(state_at(tasks[name], qpos=qpos), {}, jnp.ones(6))
    np.testing.assert_allclose(state.reward, stand * factor, atol=1e-6)
    np.testing.assert_allclose(state.metrics["reward/stand"], stand, atol=1e-6)


@pytest.mark.parametrize(
  ("name", "speed", "move"),
  [("WalkerWalk", 0.5, 0.5), ("WalkerWalk", 1, 1), ("WalkerRun", 1, 0.125), ("WalkerRun", 4, 0.5), ("WalkerRun", 9, 1)],
)
def test_moving_is_forward_speed(tasks: dict[str, Walker], name: str, speed: float, move: float) -> None:
  data = state_at(tasks[name], qpos=pose(), qvel=[0, speed, *[0.0] * 7])
  np.testing.assert_allclose(tasks[name].post_step(data, {}, jnp.ones(6)).reward, (5 * move + 1) / 6, atol=1e-6)


def test_observation(tasks: dict[str, Walker]) -> None:
  env = tasks["WalkerStand"]
  qpos = pose(z=0.9, pitch=0.5)
  qpos[3] = 0.2  # the right hip turns the other way and takes its leg and foot along
  obs = env.observe(state_at(env, qpos=qpos, qvel=np.arange(9)))
  pitches = np.array([0.5, 0.3, 0.3, 0.3, 0.5, 0.5, 0.5])
  orientations = np.stack([np.cos(pitches), np.sin(pitches)], axis=1).ravel()
  np.testing.assert_allclose(obs, [*orientations, 0.9, *range(9)], atol=1e-6)


def test_height_is_uprightness_in_0_2_0(tasks: dict[str, Walker]) -> None:
  ours, theirs = tasks["WalkerRun"], load_task("v020/WalkerRun")
  look: Any = lambda env: np.array(env.observe(state_at(env, qpos=pose(z=0.9, pitch=0.5))))
  differing = np.flatnonzero(look(ours) != look(theirs))
  np.testing.assert_array_equal(differing, [14])
  np.testing.assert_allclose([look(ours)[14], look(theirs)[14]], [0.9, np.cos(0.5)], atol=1e-6)


def test_initial_pose(tasks: dict[str, Walker]) -> None:
  qpos = jax.jit(jax.vmap(tasks["WalkerStand"].initial))(jax.random.split(jax.random.PRNGKey(0), 2000))["qpos"]
  assert not qpos[:, :2].any()
  leg = [[-20, 100], [-150, 0], [-45, 45]]
  low, high = np.radians([[-180, 180], *leg, *leg]).T
  np.testing.assert_allclose(qpos[:, 2:].min(0), low, atol=0.03)
  np.testing.assert_allclose(qpos[:, 2:].max(0), high, atol=0.03)
