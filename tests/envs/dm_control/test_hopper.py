"""Hopper: rewards and observation by hand, and where episodes start."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.envs.dm_control.hopper import Hopper
from tests.envs.dm_control.states import state_at
from tests.envs.golden import load_task, terms

UPRIGHT = np.zeros(7)  # the leg straight, the foot's underside 6 cm above the floor
LYING = np.array([0, 0, np.pi / 2, 0, 0, 0, 0])


@pytest.fixture(scope="module")
def stand() -> Hopper:
  return load_task("HopperStand")


@pytest.fixture(scope="module")
def hop() -> Hopper:
  return load_task("HopperHop")


@pytest.mark.parametrize(("speed", "hopping"), [(-1, 0), (0, 0), (1, 0.5), (1.5, 0.75), (2, 1), (5, 1)])
def test_hopping_is_forward_speed_while_standing(hop: Hopper, speed: float, hopping: float) -> None:
  qvel = [speed, *[0.0] * 6]
  standing = hop.post_step(state_at(hop, qpos=UPRIGHT, qvel=qvel), {}, jnp.ones(4))
  np.testing.assert_allclose(standing.reward, hopping, atol=1e-6)
  lying = hop.post_step(state_at(hop, qpos=LYING, qvel=qvel), {}, jnp.ones(4))
  assert lying.reward == 0 and terms(lying).keys() == {"reward/standing", "reward/hopping"}
  np.testing.assert_allclose(lying.metrics["reward/hopping"], hopping, atol=1e-6)


@pytest.mark.parametrize(("action", "reward"), [(0, 1), (0.5, 0.95), (-1, 0.8), (3, 0.8)])
def test_standing_asks_for_small_control(stand: Hopper, action: float, reward: float) -> None:
  state = stand.post_step(state_at(stand, qpos=UPRIGHT), {}, jnp.full(4, action))
  np.testing.assert_allclose(state.reward, reward, atol=1e-6)
  assert stand.post_step(state_at(stand, qpos=LYING), {}, jnp.full(4, action)).reward == 0


@pytest.mark.parametrize(("shift", "standing"), [(0.001, 1), (-0.001, 0)])
def test_standing_is_0_6_m_from_foot_to_torso(stand: Hopper, shift: float, standing: int) -> None:
  data = state_at(stand, qpos=UPRIGHT)
  torso, foot = (stand.mj_model.body(name).id for name in ("torso", "foot"))
  height = data.xipos[foot, 2] + 0.6 + shift
  data = data.replace(xipos=data.xipos.at[torso, 2].set(height))
  assert stand.post_step(data, {}, jnp.zeros(4)).metrics["reward/standing"] == standing


def test_observation(stand: Hopper) -> None:
  qpos, qvel = [9, -0.061, 0, 0, 0, 0, 0], np.arange(7)
  obs = np.array(stand.observe(state_at(stand, qpos=qpos, qvel=qvel)))
  np.testing.assert_allclose(obs[:13], [*qpos[1:], *qvel], atol=1e-6)  # where along x does not show
  assert (obs[13:] > 1).all()  # the foot is flat on the floor, 1 mm into it
  lifted = np.array(stand.observe(state_at(stand, qpos=UPRIGHT)))
  np.testing.assert_array_equal(lifted[13:], 0)


def test_initial_pose(stand: Hopper) -> None:
  qpos = jax.jit(jax.vmap(stand.initial))(jax.random.split(jax.random.PRNGKey(0), 2000))["qpos"]
  assert not qpos[:, :2].any()
  low, high = np.concatenate([[[-np.pi, np.pi]], np.radians([[-30, 30], [-170, 10], [5, 150], [-45, 45]])]).T
  np.testing.assert_allclose(qpos[:, 2:].min(0), low, atol=0.03)
  np.testing.assert_allclose(qpos[:, 2:].max(0), high, atol=0.03)
  assert np.abs(np.corrcoef(qpos[:, 2:].T) - np.eye(5)).max() < 0.1
