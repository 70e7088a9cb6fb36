"""A hand that moves in a plane: where its tip goes, what it earns, and what an episode begins with. Without physics."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.envs.base import State
from playground.robots.panda.kinematics import forward_kinematics
from tests.envs.golden import golden, load_task

TASK = "PandaPickCubeCartesian"
N = 64


def prepared(**overrides: Any) -> Any:
  env = load_task(TASK, overrides)
  env.physics.forward = lambda model, data: data
  for name in ("evaluate", "control", "disturb"):
    setattr(env, name, jax.jit(getattr(env, name)))
  return env


@pytest.fixture(scope="module")
def task() -> Any:
  return prepared()


@pytest.fixture(scope="module")
def parity() -> Any:
  return prepared(parity=True)


@pytest.fixture(scope="module")
def state() -> State:
  """A recorded state amid an episode, a little above the start."""
  return jax.tree.map(lambda x: x[4], golden(TASK).states)


def step(env: Any, state: State, action: Any, box: Any = None) -> State:
  """A step in which the servos get their targets and the cube is where it is said to be."""
  action = jnp.array(action, jnp.float32)
  data = state.data.replace(ctrl=env.control(state, action))
  if box is not None:
    data = data.replace(xpos=data.xpos.at[env.mj_model.body("box").id].set(jnp.array(box)))
  return env.evaluate(data, state.info, action)


def tip(state: State) -> np.ndarray:
  return np.asarray(forward_kinematics(state.data.ctrl[:7])[0])


def test_observation_parts_add_up(task: Any, state: State) -> None:
  assert sum(task.observation_parts["state"].values()) == 70 == state.obs.shape[-1]
  assert task.action_size == 3


def test_where_the_cube_starts(task: Any) -> None:
  start: Any = jax.jit(jax.vmap(task.reset))(jax.random.split(jax.random.PRNGKey(0), N))
  box = np.asarray(start.data.qpos[:, 9:12])
  np.testing.assert_allclose(box[:, 2], 0.03, atol=1e-6)
  assert -0.05 <= box[:, 1].min() < -0.04 and 0.04 < box[:, 1].max() <= 0.05
  np.testing.assert_allclose(start.info["target_pos"], np.stack([box[:, 0], np.zeros(N), np.full(N, 0.2)], axis=1))
  assert (start.obs[:, 66:] == 0).all()


@pytest.mark.parametrize("action", [(1, 0, 1), (-1, 1, -1), (0.5, -1, 1)])
def test_the_tip_moves_along_y_and_z(task: Any, state: State, action: tuple[float, ...]) -> None:
  after = step(task, state, action)
  moved = np.asarray(state.info["current_pos"]) + 0.005 * np.array([0, action[0], action[1]])
  np.testing.assert_allclose(after.info["current_pos"], moved, atol=1e-6)
  np.testing.assert_allclose(tip(after), moved, atol=1e-5)
  fingers = np.clip(state.data.ctrl[7] + (0.02 if action[2] >= 0 else -0.02), 0, 0.04)
  np.testing.assert_allclose(after.data.ctrl[7], fingers)


@pytest.mark.parametrize("place", [(0.75, 0.0, 0.49), (0.4, 0.0, 0.2)], ids=["too far", "beyond a joint's limit"])
def test_where_the_arm_cannot_go_it_stays(task: Any, state: State, place: tuple[float, ...]) -> None:
  there = state.replace(info=state.info | {"current_pos": jnp.array(place)})
  after = step(task, there, (1, 0, 1))
  np.testing.assert_array_equal(after.data.ctrl[:7], state.data.ctrl[:7])
  np.testing.assert_array_equal(after.info["current_pos"], there.info["current_pos"])
  np.testing.assert_allclose(after.metrics["reward/no_solution"], -0.01)
  assert np.asarray(after.obs)[66] == 1


def test_parity_moves_on_where_the_arm_cannot_go(parity: Any, state: State) -> None:
  there = state.replace(info=state.info | {"current_pos": jnp.array([0.75, 0.0, 0.49])})
  after = step(parity, there, (1, 0, 1))
  np.testing.assert_array_equal(after.data.ctrl[:7], state.data.ctrl[:7])
  np.testing.assert_allclose(after.info["current_pos"], [0.75, 0.005, 0.49], atol=1e-6)


def test_only_progress_pays(task: Any, state: State) -> None:
  still = (0, 0, 1)
  calm = state.replace(info=state.info | {"best_reward": jnp.zeros(()), "last_act": jnp.array([0.0, 0, 1])})
  first = step(task, calm, still, box=(0.63, 0, 0.03))
  assert first.reward > 0.3
  again = step(task, calm.replace(info=first.info), still, box=(0.63, 0, 0.03))
  assert again.reward == 0
  up = step(task, calm.replace(info=again.info), still, box=(0.63, 0, 0.06))
  lifted = up.metrics["reward/lifted"] + up.metrics["reward/gripper_box"] - first.metrics["reward/gripper_box"]
  np.testing.assert_allclose(up.reward, lifted, rtol=1e-4)
  assert step(task, calm.replace(info=up.info), still, box=(0.63, 0, 0.03)).reward == 0


def test_the_first_step_pays_nothing(task: Any, state: State) -> None:
  new = state.replace(info=state.info | {"newly_reset": jnp.array(True), "best_reward": jnp.zeros(())})
  after = step(task, new, (0, 0, 1))
  assert after.reward == 0 and after.info["best_reward"] > 0.3


@pytest.mark.parametrize(("offset", "success"), [(0.049, 1), (0.051, 0)])
def test_success_ends_the_episode(task: Any, state: State, offset: float, success: int) -> None:
  after = step(task, state, (0, 0, -1), box=np.add(state.info["target_pos"], [0, offset, 0]))
  assert (after.done, after.metrics["success"], after.metrics["reward/success"]) == (success, success, 2 * success)


def test_the_gripper_lags_behind(state: State) -> None:
  env = prepared(gripper_delay=2)
  drawn = lambda key: env.disturb(state.replace(info=late | {"rng": key})).info["action_delay"]
  late = state.info | {"action_history": jnp.array([1.0, -1, 1]), "action_delay": jnp.array(2)}
  assert {int(drawn(key)) for key in jax.random.split(jax.random.PRNGKey(1), 30)} == {0, 1, 2}
  held = state.replace(info=late, data=state.data.replace(ctrl=state.data.ctrl.at[7].set(0.03)))
  assert env.control(held, jnp.array([0.0, 0, 1]))[7] == pytest.approx(0.01)  # closes as it was to, two steps ago
  sooner = held.replace(info=late | {"action_delay": jnp.array(1)})
  assert env.control(sooner, jnp.array([0.0, 0, 1]))[7] > 0.03  # opens, as it was to one step ago


def begun(env: Any, time: float, state: State) -> State:
  stale = {"best_reward": jnp.array(5.0), "reached_box": jnp.array(1.0), "action_history": jnp.array([-1.0])}
  data = state.data.replace(time=jnp.array(time))
  return env.disturb(state.replace(data=data, info=state.info | stale))


def test_an_episode_begins_anew(task: Any, state: State) -> None:
  fresh, later = begun(task, 0.0, state), begun(task, 0.05, state)
  assert fresh.info["newly_reset"] and not later.info["newly_reset"]
  assert fresh.info["best_reward"] == fresh.info["reached_box"] == 0
  assert later.info["best_reward"] == 5 and later.info["reached_box"] == 1
  assert not fresh.info["action_history"].any() and later.info["action_history"].any()
  np.testing.assert_allclose(fresh.info["current_pos"], (0.66105318, -0.00051778, 0.17906836), atol=1e-6)
  np.testing.assert_array_equal(later.info["current_pos"], state.info["current_pos"])


@pytest.mark.parametrize("mode", [{}, {"parity": True}])
def test_some_episodes_begin_with_the_cube_in_the_hand(mode: dict[str, Any], state: State) -> None:
  env = prepared(guide_probability=1.0, **mode)
  picked = env.mj_model.key("picked")
  fresh, later = begun(env, 0.0, state), begun(env, 0.05, state)
  np.testing.assert_allclose(fresh.data.qpos, picked.qpos, rtol=1e-6)
  np.testing.assert_allclose(fresh.data.ctrl, picked.ctrl, rtol=1e-6)
  np.testing.assert_array_equal(later.data.qpos, state.data.qpos)
  there, start = forward_kinematics(jnp.array(picked.ctrl[:7]))[0], (0.66105318, -0.00051778, 0.17906836)
  next_tip = forward_kinematics(env.control(fresh, jnp.array([0.0, 0, -1]))[:7])[0]
  np.testing.assert_allclose(next_tip, start if mode else there, atol=1e-5)  # 0.2.0 calls the hand back


@pytest.mark.parametrize("delay", [0, 1, 2])
def test_late_fingers_hold_the_cube_that_they_begin_with(delay: int, state: State) -> None:
  env = prepared(gripper_delay=2, guide_probability=1.0)
  info = state.info | {"action_history": jnp.ones(3), "action_delay": jnp.array(0)}
  fresh = env.disturb(state.replace(data=state.data.replace(time=jnp.array(0.0)), info=info))
  late = fresh.replace(info=fresh.info | {"action_delay": jnp.array(delay)})
  assert env.control(late, jnp.array([0.0, 0, -1]))[7] == 0
