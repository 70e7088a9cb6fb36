"""Finger: rewards and observations by hand, touch, and what differs from 0.2.0."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.envs.dm_control.finger import FingerSpin, FingerTurn
from tests.envs.dm_control.states import state_at
from tests.envs.golden import load_task

HINGE = np.array([0.2, 0, 0.4])
REACH = 0.13
NO_ACTION = jnp.zeros(2)


@pytest.fixture(scope="module")
def spin() -> FingerSpin:
  return load_task("FingerSpin")


@pytest.fixture(scope="module")
def turn() -> FingerTurn:
  return load_task("FingerTurnEasy")


@pytest.mark.parametrize(("velocity", "reward"), [(-15.0, 1), (-30.0, 1), (-14.9, 0), (0.0, 0), (20.0, 0)])
def test_spinning_fast_one_way_is_rewarded(spin: FingerSpin, velocity: float, reward: float) -> None:
  data = state_at(spin, qvel=[0, 0, velocity])
  assert spin.post_step(data, {}, NO_ACTION).reward == reward


def test_observation(spin: FingerSpin) -> None:
  data = state_at(spin, qpos=[0.3, -0.4, 0.5], qvel=[1, 2, 3])
  touched = data.replace(sensordata=data.sensordata.at[14:16].set(jnp.array([1.0, 3.0])))
  tip = REACH * np.array([-np.sin(0.5), np.cos(0.5)])  # the hinge turns about -y
  expected = [0.3, -0.4, *tip, 1, 2, 3, np.log(2), np.log(4)]
  np.testing.assert_allclose(spin.observe(touched), expected, atol=1e-6)


def test_touch_is_felt(spin: FingerSpin) -> None:
  poses = [[-0.2, 0.09, -2.32], [0.66, -0.69, 1.31], [0.44, -0.44, 3.08], [-1.57, 0.0, 0.0]]
  touch = np.array([spin.observe(state_at(spin, qpos=pose))[-2:] for pose in poses])
  assert (touch > 0.5).tolist() == [[True, False], [False, True], [True, True], [False, False]]


@pytest.mark.parametrize(("name", "radius"), [("FingerTurnEasy", 0.07), ("FingerTurnHard", 0.03)])
def test_the_tip_in_the_target_is_rewarded(name: str, radius: float) -> None:
  env = load_task(name)
  for gap in (0.0, 0.9 * radius, 1.1 * radius, 0.2):
    data = state_at(env, mocap_pos=[HINGE + np.array([gap, 0, REACH])])  # the tip points up
    state = env.post_step(data, {}, NO_ACTION)
    np.testing.assert_allclose(state.obs[9:], [gap, REACH, gap - radius], atol=1e-6)
    assert state.reward == (gap < radius)


def test_models_differ_where_the_tasks_do(spin: FingerSpin, turn: FingerTurn) -> None:
  assert (spin.mj_model.dof_damping[2], turn.mj_model.dof_damping[2]) == (0.03, 0.5)
  assert (spin.mj_model.site("target").rgba[3], spin.mj_model.site("tip").rgba[3]) == (0, 0)
  assert turn.mj_model.site("target").size[0] == 0.07


@pytest.mark.parametrize("name", ["FingerTurnEasy", "v020/FingerTurnEasy"])
def test_initial_angles(name: str) -> None:
  env = load_task(name)
  fields = jax.jit(jax.vmap(env.initial))(jax.random.split(jax.random.PRNGKey(0), 2000))
  target = fields["mocap_pos"][:, 0] - HINGE
  angles = np.column_stack([fields["qpos"], np.arctan2(target[:, 0], target[:, 2])])
  limits = [np.radians(110)] * 2 + [np.pi] * 2
  np.testing.assert_allclose(np.abs(angles).max(0), limits, rtol=0.02)
  assert (np.abs(angles) <= limits).all()
  correlation = np.corrcoef(angles.T) - np.eye(4)
  assert (correlation[0, 2] > 0.99) if name.startswith("v020") else (np.abs(correlation).max() < 0.1)
