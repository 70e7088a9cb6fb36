"""Cheetah: rewards by hand, and a start at rest."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.envs.dm_control.cheetah import CheetahRun
from tests.envs.dm_control.states import state_at
from tests.envs.golden import load_task


@pytest.fixture(scope="module")
def cheetah() -> CheetahRun:
  return load_task("CheetahRun")


@pytest.mark.parametrize(("speed", "reward"), [(-3, 0), (0, 0), (2.5, 0.25), (10, 1), (12, 1)])
def test_reward_is_the_speed(cheetah: CheetahRun, speed: float, reward: float) -> None:
  data = state_at(cheetah, qpos=[7, 0.5, 0.1, *[0.0] * 6], qvel=[speed, *[0.0] * 8])
  state = cheetah.post_step(data, {}, jnp.ones(6))
  np.testing.assert_allclose(state.reward, reward, atol=1e-6)
  np.testing.assert_allclose(cheetah.observe(data), [0.5, 0.1, *[0] * 6, speed, *[0] * 8], atol=1e-6)


def test_initial_pose(cheetah: CheetahRun) -> None:
  qpos = jax.jit(jax.vmap(cheetah.initial))(jax.random.split(jax.random.PRNGKey(0), 2000))["qpos"]
  assert not qpos[:, :3].any()
  low, high = cheetah.mj_model.jnt_range[3:].T
  np.testing.assert_allclose(qpos[:, 3:].min(0), low, atol=0.03)
  np.testing.assert_allclose(qpos[:, 3:].max(0), high, atol=0.03)


@pytest.mark.slow  # compiles the 200 steps in which a cheetah comes to rest
def test_episodes_start_at_rest(cheetah: CheetahRun) -> None:
  reset = jax.jit(cheetah.reset)
  first, second = (reset(jax.random.PRNGKey(seed)).data for seed in (0, 1))
  assert first.time == second.time == 0
  assert not first.ctrl.any()
  for data in (first, second):
    assert jnp.abs(data.qvel).max() < 0.5
    np.testing.assert_allclose(data.qacc_warmstart, 0, atol=5)  # no longer in the air, where it would be 9.8
  assert (first.qpos != second.qpos).all()  # each in its own place
