"""Fish: rewards and observations by hand, and what differs from 0.2.0."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.envs.dm_control.fish import FishSwim
from tests.envs.dm_control.states import state_at
from tests.envs.golden import load_task

MOUTH = np.array([0, 0.0745, 0.5])  # with the torso at a height of 0.5 m
UPRIGHT, OVER, SIDEWAYS = [1, 0, 0, 0], [0, 0, 1, 0], [np.sqrt(0.5), 0, np.sqrt(0.5), 0]  # rolled about y


@pytest.fixture(scope="module")
def fish() -> FishSwim:
  return load_task("FishSwim")


@pytest.mark.parametrize(
  ("quat", "distance", "in_target", "upright"),
  [(UPRIGHT, 0, 1, 1), (UPRIGHT, 0.0449, 1, 1), (OVER, 0, 1, 0), (SIDEWAYS, 0.135, 0.1, 0.5), (OVER, 5, 0, 0)],
)
def test_rewards_by_hand(fish: FishSwim, quat: list[float], distance: float, in_target: float, upright: float) -> None:
  data = state_at(fish, qpos=[0, 0, 0.5, *quat, *[0.0] * 7], mocap_pos=[MOUTH + np.array([0, distance, 0])])
  state = fish.post_step(data, {}, jnp.zeros(5))
  np.testing.assert_allclose(state.metrics["reward/in_target"], in_target, atol=1e-5)
  np.testing.assert_allclose(state.metrics["reward/upright"], upright, atol=1e-5)
  np.testing.assert_allclose(state.reward, (7 * in_target + upright) / 8, atol=1e-5)


def test_observation(fish: FishSwim) -> None:
  joints, velocity = 0.1 * np.arange(1, 8), np.arange(13)
  data = state_at(
    fish, qpos=[0, 0, 0.5, *UPRIGHT, *joints], qvel=velocity, mocap_pos=[MOUTH + np.array([0.1, 0.2, 0.3])]
  )
  to_target = [0.1, -0.3, 0.2]  # the mouth's z axis points forward (y), its y axis down
  np.testing.assert_allclose(fish.observe(data), np.hstack([1, joints, to_target, velocity]), atol=1e-6)


def test_initial_state(fish: FishSwim) -> None:
  fields = jax.jit(jax.vmap(fish.initial))(jax.random.split(jax.random.PRNGKey(0), 2000))
  qpos, target = np.asarray(fields["qpos"]), np.asarray(fields["mocap_pos"])[:, 0]
  assert not qpos[:, :3].any()
  np.testing.assert_allclose(np.linalg.norm(qpos[:, 3:7], axis=1), 1, atol=1e-6)
  np.testing.assert_allclose(np.square(qpos[:, 3:7]).mean(0), 0.25, atol=0.03)  # no direction preferred
  np.testing.assert_allclose(np.abs(qpos[:, 7:]).max(0), 0.2, rtol=0.02)
  np.testing.assert_allclose(target.min(0), [-0.4, -0.4, 0.1], atol=0.01)
  np.testing.assert_allclose(target.max(0), [0.4, 0.4, 0.3], atol=0.01)
