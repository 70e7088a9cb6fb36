"""Picking up and opening: starts, rewards, ends and measures. C MuJoCo computes poses and contacts."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.envs.base import State
from playground.errors import UnknownNameError
from tests.envs.dm_control.states import state_at
from tests.envs.golden import load_task, recorded, without_physics

CUBE, TURNED, CABINET = "PandaPickCube", "PandaPickCubeOrientation", "PandaOpenCabinet"
N = 256


@pytest.fixture(scope="module")
def pick() -> Any:
  return without_physics(TURNED)


@pytest.fixture(scope="module")
def cabinet() -> Any:
  return without_physics(CABINET)


def starts(env: Any) -> State:
  return jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), N))


def scene(env: Any, box: Any = (0.6, 0.1, 0.03), target: Any = (0.5, -0.1, 0.3), turn: float = 0.0) -> Any:
  """The cube and its target (m, and rad about the vertical) before the arm at home."""
  qpos = np.array(env.mj_model.key("home").qpos)
  qpos[9:12] = box
  quat = [np.cos(turn / 2), 0, 0, np.sin(turn / 2)]
  return state_at(env, qpos=qpos, mocap_pos=np.array([target]), mocap_quat=np.array([quat]))


def judge(env: Any, data: Any, reached: float = 0.0) -> State:
  info = {"rng": jax.random.PRNGKey(0), "last_act": jnp.zeros(8), "reached_box": jnp.array(reached)}
  return env.post_step(data, info, jnp.zeros(8))


def test_where_cube_and_target_start(pick: Any) -> None:
  state = starts(pick)
  home = pick.mj_model.key("home")
  box, target = np.asarray(state.data.qpos[:, 9:12]), np.asarray(state.data.mocap_pos[:, 0])
  np.testing.assert_allclose(state.data.qpos[:, :9], np.tile(home.qpos[:9], (N, 1)), rtol=1e-6)
  np.testing.assert_allclose(state.data.ctrl, np.tile(home.ctrl, (N, 1)), rtol=1e-6)
  for places, low, high in ((box, (0.5, -0.2, 0.03), (0.9, 0.2, 0.03)), (target, (0.5, -0.2, 0.23), (0.9, 0.2, 0.43))):
    assert (places >= np.array(low) - 1e-6).all() and (places <= np.array(high) + 1e-6).all()
    np.testing.assert_allclose(places.min(axis=0), low, atol=0.02)
    np.testing.assert_allclose(places.max(axis=0), high, atol=0.02)
  angle = 2 * np.arccos(state.data.mocap_quat[:, 0, 0])
  assert 0 <= angle.min() < np.radians(3) and np.radians(42) < angle.max() <= np.radians(45.1)


def test_terms_by_hand(pick: Any) -> None:
  data = scene(pick)
  far = judge(pick, data)
  gripper = np.asarray(data.site_xpos[0])
  distance = np.linalg.norm(np.array([0.6, 0.1, 0.03]) - gripper)
  expected = {"object_gripper_distance_tanh": 4 * (1 - np.tanh(5 * distance)), "object_goal_distance_tanh": 0.0}
  expected |= {"no_contact": 0.25, "joint_deviation_tanh": 0.3}
  for name, value in expected.items():
    np.testing.assert_allclose(far.metrics[f"reward/{name}"], value, rtol=1e-4, err_msg=name)
  np.testing.assert_allclose(far.reward, sum(expected.values()), rtol=1e-4)

  reached = judge(pick, data, reached=1.0)
  gap = 0.9 * np.linalg.norm([0.1, 0.2, -0.27])
  np.testing.assert_allclose(reached.metrics["reward/object_goal_distance_tanh"], 8 * (1 - np.tanh(5 * gap)), rtol=1e-4)


def test_the_targets_turn_counts_a_little(pick: Any) -> None:
  place = (0.6, 0.1, 0.03)
  turned = judge(pick, scene(pick, place, place, np.pi / 2), reached=1.0).metrics
  np.testing.assert_allclose(turned["reward/object_goal_distance_tanh"], 8 * (1 - np.tanh(5 * 0.1 * 2)), rtol=1e-4)


def test_reached_is_remembered_within_an_episode(pick: Any) -> None:
  gripper = np.asarray(scene(pick).site_xpos[0])
  assert judge(pick, scene(pick, np.add(gripper, [0, 0.011, 0]))).info["reached_box"] == 1
  assert judge(pick, scene(pick, np.add(gripper, [0, 0.013, 0]))).info["reached_box"] == 0
  assert judge(pick, scene(pick), reached=1.0).info["reached_box"] == 1
  assert "reached_box" in pick.episode_info and "reached_box" not in load_task(f"v020/{TURNED}").episode_info


def test_touching_the_floor_costs(pick: Any) -> None:
  data = scene(pick)
  for finger in range(3):
    touching = data.replace(sensordata=jnp.zeros(4).at[finger].set(1.0))
    assert judge(pick, touching).metrics["reward/no_contact"] == 0
  in_the_hand = data.replace(sensordata=jnp.zeros(4).at[3].set(1.0))
  np.testing.assert_allclose(judge(pick, in_the_hand).metrics["reward/no_contact"], 0.25)


@pytest.mark.parametrize(
  ("offset", "degrees", "success"), [(0.0, 0.0, 1), (0.029, 9.0, 1), (0.031, 0.0, 0), (0.0, 11.0, 0)]
)
def test_success_and_errors(pick: Any, offset: float, degrees: float, success: int) -> None:
  target = np.array([0.5, -0.1, 0.3])
  state = judge(pick, scene(pick, np.add(target, [0, offset, 0]), target, np.radians(degrees)))
  assert state.metrics["success"] == success
  np.testing.assert_allclose(state.metrics["position_error_cm"], 100 * offset, atol=1e-3)
  np.testing.assert_allclose(state.metrics["rotation_error_deg"], degrees, atol=0.05)


def test_any_turn_is_good_where_none_is_asked_for() -> None:
  env, target = load_task(CUBE), np.array([0.5, -0.1, 0.3])
  assert judge(env, scene(env, target, target, 1.0)).metrics["success"] == 1


@pytest.mark.parametrize(("box", "done"), [((0.6, 0.1, 0.03), 0), ((0.6, -1.01, 0.03), 1), ((0.6, 0.1, -0.001), 1)])
def test_a_cube_that_is_gone_ends_the_episode(pick: Any, box: tuple[float, ...], done: int) -> None:
  state = judge(pick, scene(pick, box))
  assert (state.done, state.metrics["termination/object_out_of_bounds"]) == (done, done)


@pytest.mark.parametrize("field", ["qpos", "qvel"])
def test_nan_ends_the_episode(pick: Any, field: str) -> None:
  data = scene(pick)
  assert judge(pick, data.replace(**{field: getattr(data, field).at[3].set(jnp.nan)})).done == 1


@pytest.mark.parametrize("name", [CUBE, CABINET])
def test_actions_move_the_targets_within_their_range(name: str) -> None:
  env = load_task(name)
  state = recorded(name)
  low, high = env.mj_model.actuator_ctrlrange.T
  action = jnp.linspace(-1, 1, 8)
  moved = np.clip(state.data.ctrl + 0.04 * action, low, high)
  np.testing.assert_allclose(env.action_to_ctrl(state, action), moved, rtol=1e-6)
  np.testing.assert_allclose(env.action_to_ctrl(state, 1e4 * action), np.where(action > 0, high, low), rtol=1e-6)


def test_the_drawer_starts_closed_before_an_arm_within_its_limits(cabinet: Any) -> None:
  state = starts(cabinet)
  qpos, ctrl = np.asarray(state.data.qpos), np.asarray(state.data.ctrl)
  low, high = cabinet.mj_model.jnt_range[:7].T
  assert (qpos[:, :7] >= low - 1e-6).all() and (qpos[:, :7] <= high + 1e-6).all()
  assert np.ptp(qpos[:, :7], axis=0).min() > 0.9
  np.testing.assert_array_equal(qpos[:, :7], ctrl[:, :7])
  np.testing.assert_array_equal(qpos[:, 7:], 0)
  target = np.asarray(state.data.mocap_pos[:, 0])
  assert 0.2 <= target[:, 0].min() < 0.21 and 0.39 < target[:, 0].max() <= 0.4
  np.testing.assert_allclose(target[:, 1:], np.tile([0, 0.5], (N, 1)))


def opened(env: Any, by: float) -> Any:
  qpos = np.zeros(10)
  qpos[9] = -by
  return state_at(env, qpos=qpos, mocap_pos=np.array([[0.3, 0, 0.5]]))


def test_an_open_drawer_is_a_success(cabinet: Any) -> None:
  for by, error in ((0.2, 0.0), (0.175, 2.5), (0.1, 10.0)):
    state = judge(cabinet, opened(cabinet, by), reached=1.0)
    np.testing.assert_allclose(state.metrics["position_error_cm"], error, atol=1e-3)
    assert state.metrics["success"] == (error < 3)
    pays = 8 * (1 - np.tanh(0.05 * error))
    np.testing.assert_allclose(state.metrics["reward/object_goal_distance_tanh"], pays, rtol=1e-4)


def test_the_hand_should_stay_outside_the_cabinet(cabinet: Any) -> None:
  free = opened(cabinet, 0.1)
  assert judge(cabinet, free).metrics["reward/no_contact"] == 0.25
  qpos = np.zeros(10)
  qpos[[1, 3, 5]] = 1.4, -0.1, 1.9  # stretched forward
  inside = state_at(cabinet, qpos=qpos)
  assert inside.site_xpos[0, 0] > 0.52
  assert judge(cabinet, inside).metrics["reward/no_contact"] == 0


def test_names_in_parameters_are_checked_when_the_task_is_built() -> None:
  with pytest.raises(UnknownNameError, match=r"gripper_pos\.params\.site names the site 'griper', .*'gripper'"):
    load_task("PandaPickCube", {"observations.state.gripper_pos.params.site": "griper"})
