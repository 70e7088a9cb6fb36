"""Acrobot: rewards and observation by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.envs.dm_control.acrobot import Acrobot
from tests.envs.dm_control.states import state_at
from tests.envs.golden import load_task


@pytest.fixture(scope="module")
def dense() -> Acrobot:
  return load_task("AcrobotSwingup")


@pytest.fixture(scope="module")
def sparse() -> Acrobot:
  return load_task("AcrobotSwingupSparse")


@pytest.mark.parametrize(("distance", "reward"), [(0.0, 1.0), (0.19, 1.0), (1.2, 0.1), (4.0, 0.1**3.8**2)])
def test_the_reward_falls_with_the_distance_to_the_target(
  dense: Acrobot, sparse: Acrobot, distance: float, reward: float
) -> None:
  angle = 2 * np.arcsin(distance / 4)  # both arms in line, 2 m: a chord between tip and target
  data = state_at(dense, qpos=[angle, 0])
  np.testing.assert_allclose(dense.post_step(data, {}, jnp.zeros(1)).reward, reward, rtol=1e-4, atol=1e-9)
  assert sparse.post_step(data, {}, jnp.zeros(1)).reward == (distance < 0.2)


def test_observation(dense: Acrobot) -> None:
  data = state_at(dense, qpos=[0.5, 0.3], qvel=[2, -3])
  expected = [np.sin(0.5), np.sin(0.8), np.cos(0.5), np.cos(0.8), 2, -3]
  np.testing.assert_allclose(dense.observe(data), expected, atol=1e-6)


def test_an_episode_starts_anywhere(dense: Acrobot) -> None:
  qpos = jax.vmap(dense.initial)(jax.random.split(jax.random.PRNGKey(0), 500))["qpos"]
  assert abs(np.corrcoef(qpos.T)[0, 1]) < 0.15
  np.testing.assert_allclose([qpos.min(0), qpos.max(0)], [[-np.pi] * 2, [np.pi] * 2], atol=0.1)
