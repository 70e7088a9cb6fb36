"""Reacher: reward and observation by hand, where targets are, and the wrist's limit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.envs.dm_control.states import state_at
from tests.envs.golden import load_task

TASKS = {"ReacherEasy": 0.05, "ReacherHard": 0.015}  # radius of the target, m
FINGER = 0.01  # radius, m


@pytest.mark.parametrize("name", TASKS)
def test_touching_the_target_is_rewarded(name: str) -> None:
  env = load_task(name)
  for gap in (0.0, TASKS[name] + FINGER - 1e-4, TASKS[name] + FINGER + 1e-4, 0.2):
    # The arm is stretched out along y; heights do not count.
    data = state_at(env, qpos=[np.pi / 2, 0], qvel=[3, 4], mocap_pos=[[gap, 0.24, 0.5]])
    state = env.post_step(data, {}, jnp.zeros(2))
    np.testing.assert_allclose(state.obs, [np.pi / 2, 0, gap, 0, 3, 4], atol=1e-6)
    assert state.reward == (gap < TASKS[name] + FINGER)


def test_an_episode_starts_anywhere() -> None:
  start = jax.vmap(load_task("ReacherEasy").initial)(jax.random.split(jax.random.PRNGKey(0), 500))
  qpos, target = start["qpos"], start["mocap_pos"][:, 0]
  limits = np.array([np.pi, np.radians(160)])
  np.testing.assert_allclose([qpos.min(0), qpos.max(0)], [-limits, limits], atol=0.1)
  distance, angle = np.hypot(*target[:, :2].T), np.arctan2(*target[:, :2].T)
  np.testing.assert_allclose([distance.min(), distance.max()], [0.05, 0.2], atol=2e-3)
  np.testing.assert_allclose([angle.min(), angle.max()], [-np.pi, np.pi], atol=0.1)
  assert (target[:, 2] == jnp.float32(0.01)).all()
  assert abs(np.corrcoef(np.stack([*qpos.T, distance, angle]))[np.triu_indices(4, 1)]).max() < 0.15
