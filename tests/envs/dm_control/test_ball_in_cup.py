"""Ball in cup: reward by hand, and the start of an episode."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from tests.envs.dm_control.states import state_at
from tests.envs.golden import load_task

IN_THE_CUP = 0.35  # m, the ball's z displacement from its place to the target's


@pytest.fixture(scope="module")
def env() -> Any:
  return load_task("BallInCup")


@pytest.mark.parametrize(("x", "z", "reward"), [(0, 0, 1), (0.024, -0.024, 1), (0.026, 0, 0), (0, -0.026, 0)])
def test_the_ball_in_the_cup_is_rewarded(env: Any, x: float, z: float, reward: float) -> None:
  data = state_at(env, qpos=[0.1, 0.2, 0.1 + x, 0.2 + IN_THE_CUP + z], qvel=[1, 2, 3, 4])
  state = env.post_step(data, {}, jnp.zeros(2))
  assert state.reward == reward
  np.testing.assert_allclose(state.obs, [*data.qpos, 1, 2, 3, 4], rtol=1e-6)


def test_the_ball_starts_clear_of_cup_and_string(env: Any) -> None:
  qpos = np.asarray(jax.vmap(env.initial)(jax.random.split(jax.random.PRNGKey(0), 1000))["qpos"])
  data = mujoco.MjData(env.mj_model)
  for data.qpos[:] in qpos:
    mujoco.mj_forward(env.mj_model, data)
    assert data.nefc == 0
  np.testing.assert_allclose([qpos.min(0), qpos.max(0)], [[0, 0, -0.2, 0.2], [0, 0, 0.2, 0.5]], atol=5e-3)
  inside = np.abs(qpos[:, 2:] - [0, IN_THE_CUP]).max(axis=1) < 0.025
  assert 0 < inside.mean() < 0.03


def test_clearance_is_that_of_the_collision_test(env: Any) -> None:
  data = mujoco.MjData(env.mj_model)
  tries = np.random.default_rng(0).uniform([-0.1, 0.2], [0.1, 0.5], (500, 2))
  touching = []
  for data.qpos[2:] in tries:
    mujoco.mj_forward(env.mj_model, data)
    touching.append(data.ncon > 0)
  assert ((np.asarray(env._clearance(jnp.array(tries))) < 0) == touching).all()
  assert 50 < sum(touching) < 450


def test_the_ball_hangs_in_0_2_0() -> None:
  assert load_task("v020/BallInCup").initial(jax.random.PRNGKey(0)) == {}
