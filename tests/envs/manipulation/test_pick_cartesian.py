"""A hand that moves in a plane: where its tip goes, what it earns, and what an episode begins with. Without physics."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.envs.base import State
from playground.robots.panda.kinematics import forward_kinematics
from tests.envs.golden import recorded, without_physics

TASK, OLD = "PandaPickCubeCartesian", "v020/PandaPickCubeCartesian"
N = 64
START = (0.66105318, -0.00051778, 0.17906836)  # of the tip, m


def prepared(name: str = TASK, **overrides: Any) -> Any:
  env = without_physics(name, **overrides)
  env.pre_step, env.action_to_ctrl = jax.jit(env.pre_step), jax.jit(env.action_to_ctrl)
  return env


@pytest.fixture(scope="module")
def task() -> Any:
  return prepared()


@pytest.fixture(scope="module")
def state() -> State:
  """A recorded state amid an episode, a little above the start."""
  return recorded(TASK)


def step(env: Any, state: State, action: Any, box: Any = None) -> State:
  """A step in which the servos get their targets and the cube is where it is said to be."""
  action = jnp.array(action, jnp.float32)
  data = state.data.replace(ctrl=env.action_to_ctrl(state, action))
  if box is not None:
    data = data.replace(xpos=data.xpos.at[env.mj_model.body("box").id].set(jnp.array(box)))
  return env.post_step(data, state.info, action)


def tip(state: State) -> np.ndarray:
  return np.asarray(forward_kinematics(state.data.ctrl[:7])[0])


def test_where_the_cube_starts(task: Any) -> None:
  start: Any = jax.jit(jax.vmap(task.reset))(jax.random.split(jax.random.PRNGKey(0), N))
  box = np.asarray(start.data.qpos[:, 9:12])
  np.testing.assert_allclose(box[:, 2], 0.03, atol=1e-6)
  assert -0.05 <= box[:, 1].min() < -0.04 and 0.04 < box[:, 1].max() <= 0.05
  np.testing.assert_allclose(start.data.mocap_pos[:, 0], np.stack([box[:, 0], np.zeros(N), np.full(N, 0.2)], axis=1))
  assert (start.obs[:, 66:] == 0).all()
  np.testing.assert_allclose(start.info["current_pos"], np.tile(START, (N, 1)), atol=1e-6)


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
  np.testing.assert_allclose(after.metrics["reward/no_ik_solution"], -0.01)
  assert np.asarray(after.obs)[66] == 1


def test_0_2_0_moves_on_where_the_arm_cannot_go(state: State) -> None:
  there = state.replace(info=state.info | {"current_pos": jnp.array([0.75, 0.0, 0.49])})
  after = step(prepared(OLD), there, (1, 0, 1))
  np.testing.assert_array_equal(after.data.ctrl[:7], state.data.ctrl[:7])
  np.testing.assert_allclose(after.info["current_pos"], [0.75, 0.005, 0.49], atol=1e-6)


def test_only_progress_pays(task: Any, state: State) -> None:
  still = (0, 0, 1)
  calm = state.replace(info=state.info | {"best_potential": jnp.zeros(()), "last_act": jnp.array([0.0, 0, 1])})
  first = step(task, calm, still, box=(0.63, 0, 0.03))
  assert first.reward > 0.3
  again = step(task, calm.replace(info=first.info), still, box=(0.63, 0, 0.03))
  assert again.reward == 0
  up = step(task, calm.replace(info=again.info), still, box=(0.63, 0, 0.06))
  near = "reward/object_gripper_distance_tanh"
  lifted = up.metrics["reward/object_lifted"] + up.metrics[near] - first.metrics[near]
  np.testing.assert_allclose(up.reward, lifted, rtol=1e-4)
  assert step(task, calm.replace(info=up.info), still, box=(0.63, 0, 0.03)).reward == 0


def test_a_clip_holds_for_the_progress_of_a_step(state: State) -> None:
  still, task = (0, 0, 1), prepared(reward_clip=[0.0, 0.2])
  calm = state.replace(info=state.info | {"best_potential": jnp.zeros(()), "last_act": jnp.array([0.0, 0, 1])})
  first = step(task, calm, still, box=(0.63, 0, 0.03))
  assert first.reward == pytest.approx(0.2) and first.info["best_potential"] > 0.3
  up = step(task, calm.replace(info=first.info), still, box=(0.63, 0, 0.04))
  assert 0 < up.reward < 0.2


def test_the_first_step_pays_nothing(task: Any, state: State) -> None:
  new = state.replace(info=state.info | {"first_step": jnp.array(True), "best_potential": jnp.zeros(())})
  after = step(task, new, (0, 0, 1))
  assert after.reward == 0 and after.info["best_potential"] > 0.3 and not after.info["first_step"]


@pytest.mark.parametrize(("offset", "success"), [(0.049, 1), (0.051, 0)])
def test_success_ends_the_episode(task: Any, state: State, offset: float, success: int) -> None:
  after = step(task, state, (0, 0, -1), box=np.add(state.data.mocap_pos[0], [0, offset, 0]))
  assert (after.done, after.metrics["success"]) == (success, success)
  assert (after.metrics["fall"], after.metrics["termination/object_at_goal"]) == (0, success)
  away = step(task, state, (0, 0, -1), box=(1.1, 0, 0.03))
  assert (away.done, away.metrics["fall"], away.metrics["termination/object_at_goal"]) == (1, 1, 0)
  assert after.metrics["reward/object_at_goal"] == 2 * success


def test_the_gripper_lags_behind(state: State) -> None:
  env = prepared(gripper_delay=2)
  late = state.info | {"action_history": jnp.array([1.0, -1, 1]), "action_delay": jnp.array(2)}
  drawn = lambda key: env.post_step(state.data, late | {"rng": key}, jnp.zeros(3)).info["action_delay"]
  assert {int(drawn(key)) for key in jax.random.split(jax.random.PRNGKey(1), 30)} == {0, 1, 2}
  held = state.replace(info=late, data=state.data.replace(ctrl=state.data.ctrl.at[7].set(0.03)))
  fingers = lambda state: float(env.action_to_ctrl(state, jnp.array([0.0, 0, 1]))[7])
  assert fingers(held) == pytest.approx(0.01)  # closes as it was to, two steps ago
  assert fingers(held.replace(info=late | {"action_delay": jnp.array(1)})) > 0.03  # opens, as it was to one step ago


def begun(env: Any, state: State, **info: Any) -> State:
  """The state before the physics of an episode's first step."""
  return env.pre_step(state.replace(info=state.info | {"first_step": jnp.array(True)} | info))


@pytest.mark.parametrize(("name", "called_back"), [(TASK, False), (OLD, True)])
def test_some_episodes_begin_with_the_cube_in_the_hand(name: str, called_back: bool, state: State) -> None:
  env = prepared(name, guide_probability=1.0)
  picked = env.mj_model.key("picked")
  fresh, later = begun(env, state), env.pre_step(state)
  np.testing.assert_allclose(fresh.data.qpos, picked.qpos, rtol=1e-6)
  np.testing.assert_allclose(fresh.data.ctrl, picked.ctrl, rtol=1e-6)
  np.testing.assert_array_equal(later.data.qpos, state.data.qpos)
  np.testing.assert_array_equal(later.info["current_pos"], state.info["current_pos"])
  there = forward_kinematics(jnp.array(picked.ctrl[:7]))[0]
  next_tip = forward_kinematics(env.action_to_ctrl(fresh, jnp.array([0.0, 0, -1]))[:7])[0]
  np.testing.assert_allclose(next_tip, START if called_back else there, atol=1e-5)


def test_late_fingers_hold_the_cube_that_they_begin_with(state: State) -> None:
  env = prepared(gripper_delay=2, guide_probability=1.0)
  for delay in (0, 1, 2):
    late = begun(env, state, action_history=jnp.ones(3), action_delay=jnp.array(delay))
    assert env.action_to_ctrl(late, jnp.array([0.0, 0, -1]))[7] == 0
