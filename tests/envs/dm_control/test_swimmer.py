"""Swimmer: rewards and observations by hand, other numbers of links, and what differs from 0.2.0."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.envs.dm_control.swimmer import Swimmer
from playground.errors import ConfigError
from tests.envs.dm_control.states import state_at
from tests.envs.golden import load_task

NOSE = np.array([0, -0.06, 0.05])


@pytest.fixture(scope="module")
def swimmer() -> Swimmer:
  return load_task("SwimmerSwimmer6")


@pytest.mark.parametrize(("distance", "reward"), [(0, 1), (0.0999, 1), (0.35, 1 / 3.25), (0.6, 0.1)])
def test_rewards_by_hand(swimmer: Swimmer, distance: float, reward: float) -> None:
  data = state_at(swimmer, mocap_pos=[NOSE + np.array([distance, 0, 0])])
  np.testing.assert_allclose(swimmer.post_step(data, {}, jnp.zeros(5)).reward, reward, atol=1e-5)


def test_target_in_the_heads_frame(swimmer: Swimmer) -> None:
  nose = np.array([0.01, -0.05, 0.05])  # a quarter turn about the neck, 0.01 m from the nose
  data = state_at(swimmer, qpos=[0, 0, np.pi / 2, *[0.0] * 5], mocap_pos=[nose + np.array([1, 2, 0])])
  np.testing.assert_allclose(swimmer.observe(data)[5:7], [2, -1], atol=1e-6)


@pytest.mark.parametrize("links", [3, 6, 8])
def test_links(links: int) -> None:
  env = load_task("SwimmerSwimmer6", {"links": links})
  joints = 0.1 * np.arange(1, links)
  assert env.action_size == links - 1
  assert env.observe(state_at(env, qpos=[0, 0, 0, *joints])).shape == (4 * links + 1,)
  np.testing.assert_allclose(env.mj_model.jnt_range[3:], [np.radians([-360 / links, 360 / links])] * (links - 1))
  np.testing.assert_allclose(env.mj_model.camera("tracking1").pos, np.array([0, -0.2, 0.5]) * links / 6)
  # Turning about the neck at 1 rad/s, stretched out: every link goes sideways, the faster the farther.
  still = state_at(env, qvel=[0, 0, 1, *[0.0] * (links - 1)])
  velocities = [[-0.05 - 0.1 * i, 0, 1] for i in range(links)]
  np.testing.assert_allclose(env.observe(still)[links + 1 :].reshape(links, 3), velocities, atol=1e-6)
  np.testing.assert_allclose(env.observe(state_at(env, qpos=[0, 0, 0, *joints]))[: links - 1], joints, atol=1e-6)


def test_too_few_links() -> None:
  with pytest.raises(ConfigError, match=r"env.links=2 must be a whole number from 3 to 1000"):
    load_task("SwimmerSwimmer6", {"links": 2})


def test_initial_state(swimmer: Swimmer) -> None:
  fields = jax.jit(jax.vmap(swimmer.initial))(jax.random.split(jax.random.PRNGKey(0), 4000))
  qpos, target = np.asarray(fields["qpos"]), np.asarray(fields["mocap_pos"])[:, 0]
  assert not qpos[:, :2].any()
  np.testing.assert_allclose(np.abs(qpos[:, 2:]).max(0), [np.pi, *[np.pi / 3] * 5], rtol=0.02)
  np.testing.assert_allclose(np.abs(target).max(0), [2, 2, 0.05], rtol=0.02)
  near = (np.abs(target[:, :2]) < 0.3).all(1).mean()
  np.testing.assert_allclose(near, 0.2 + 0.8 * 0.15**2, atol=0.02)
