"""Pendulum: reward and observation by hand, and what differs from 0.2.0."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.envs.dm_control.states import state_at
from tests.envs.golden import load_task

TASKS = {"PendulumSwingup": False, "v020/PendulumSwingup": True}  # whether it is 0.2.0's


@pytest.mark.parametrize(("degrees", "reward"), [(0, 1), (7.9, 1), (-7.9, 1), (8.1, 0), (180, 0)])
def test_upright_is_rewarded(degrees: float, reward: float) -> None:
  env = load_task("PendulumSwingup")
  data = state_at(env, qpos=[np.radians(degrees)], qvel=[3])
  assert env.post_step(data, {}, jnp.zeros(1)).reward == reward
  expected = [np.sin(np.radians(degrees)), np.cos(np.radians(degrees)), 3]
  np.testing.assert_allclose(env.observe(data), expected, atol=1e-6)


@pytest.mark.parametrize(("name", "old"), TASKS.items())
def test_a_cosine_above_1(name: str, old: bool) -> None:
  env = load_task(name)
  data = state_at(env)
  data = data.replace(xmat=data.xmat * (1 + 1e-6))
  assert env.post_step(data, {}, jnp.zeros(1)).reward == (0 if old else 1)


@pytest.mark.parametrize(("name", "old"), TASKS.items())
def test_an_episode_starts_anywhere_on_the_circle(name: str, old: bool) -> None:
  qpos = jax.vmap(load_task(name).initial)(jax.random.split(jax.random.PRNGKey(0), 500))["qpos"]
  np.testing.assert_allclose([qpos.min(), qpos.max()], [0 if old else -np.pi, np.pi], atol=0.1)
