"""Point mass: reward and initial state by hand."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.envs.dm_control.states import state_at
from tests.envs.golden import load_task


@pytest.fixture(scope="module")
def env() -> Any:
  return load_task("PointMass")


@pytest.mark.parametrize(
  ("distance", "action", "near", "small"),
  [(0.0, [0, 0], 1, 1), (0.014, [0, 0], 1, 1), (0.03, [1, 0], 0.1, 0.9), (0.0, [1, -1], 1, 0.8)],
)
def test_reward(env: Any, distance: float, action: list[float], near: float, small: float) -> None:
  data = state_at(env, qpos=[0.6 * distance, -0.8 * distance], qvel=[1, 2])
  state = env.post_step(data, {}, jnp.array(action, jnp.float32))
  np.testing.assert_allclose(state.metrics["reward/near_target"], near, rtol=1e-5)
  np.testing.assert_allclose(state.metrics["reward/small_control"], small, rtol=1e-6)
  np.testing.assert_allclose(state.reward, near * small, rtol=1e-5)
  np.testing.assert_allclose(state.obs, [*data.qpos, 1, 2], rtol=1e-6)


def test_an_episode_starts_anywhere_between_the_walls(env: Any) -> None:
  qpos = jax.vmap(env.initial)(jax.random.split(jax.random.PRNGKey(0), 500))["qpos"]
  np.testing.assert_allclose([qpos.min(0), qpos.max(0)], [[-0.29] * 2, [0.29] * 2], atol=0.01)
