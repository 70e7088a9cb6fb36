"""A block pushed with torques: starts, delays, noise, rewards, ends, and goals that move away. Without physics."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.envs.base import State
from playground.envs.wrappers import PRESERVE_INFO, wrap_for_training
from playground.errors import ConfigError
from tests.envs.dm_control.states import state_at
from tests.envs.golden import load_task, without_physics

TASK = "PandaRobotiqPushCube"
N = 256
SILENT: dict[str, Any] = {"noise_level": 0.0}


@pytest.fixture(scope="module")
def push() -> Any:
  return without_physics(TASK, **SILENT)


@pytest.fixture(scope="module")
def start(push: Any) -> State:
  return jax.jit(jax.vmap(push.reset))(jax.random.split(jax.random.PRNGKey(0), N))


@pytest.fixture(scope="module")
def state(push: Any, start: State) -> State:
  """A state in the keyframe, the block a little off a goal that has its attitude."""
  qpos = np.array(push.mj_model.key("home").qpos)
  qpos[16:20] = [1, 0, 0, 0]
  goal = qpos[13:16] + np.array([0.02, 0.0, 0.0])
  data = state_at(push, qpos=qpos, mocap_pos=goal[None], mocap_quat=np.array([[1.0, 0, 0, 0]]))
  first = jax.tree.map(lambda x: x[0], start)
  return first.replace(data=data.replace(time=jnp.array(1.0)))


def step(env: Any, state: State, action: Any = 0.0, data: Any = None, **info: Any) -> State:
  action = jnp.broadcast_to(jnp.asarray(action, jnp.float32), (7,))
  return env.post_step(state.data if data is None else data, state.info | info, action)


def past(state: State) -> jax.Array:
  """The observations before they are late, the newest first."""
  return state.info["observation_buffers"]["delayed"]


def marked() -> dict[str, jax.Array]:
  """Buffers that tell how late an observation is."""
  return {"delayed": jnp.arange(13.0)[:, None] * jnp.ones(48)}


def moved(state: State, env: Any, box: Any) -> Any:
  return state.data.replace(xpos=state.data.xpos.at[env.mj_model.body("box").id].set(jnp.asarray(box)))


def test_starts(push: Any, start: State) -> None:
  home = np.array(push.mj_model.key("home").qpos)
  qpos, goal = np.asarray(start.data.qpos), np.asarray(start.data.mocap_pos[:, 0])
  np.testing.assert_allclose(qpos[:, 15], home[15], rtol=1e-6)
  for places, reach in ((qpos[:, 13:15], 0.15), (goal[:, :2], 0.05)):
    off = places - home[13:15]
    assert (np.abs(off) <= reach * np.array([0.4, 1]) + 1e-6).all()
    assert (np.ptp(off, axis=0) > 1.8 * reach * np.array([0.4, 1])).all()
  np.testing.assert_allclose(np.linalg.norm(qpos[:, 16:], axis=1), 1, rtol=1e-5)
  turned = 2 * np.arccos(np.clip(np.abs((qpos[:, 16:] * start.data.mocap_quat[:, 0]).sum(axis=1)), 0, 1))
  assert np.radians(40) < turned.max() <= np.radians(45.1)
  bent = qpos[:, :7] - home[:7]
  assert (np.abs(bent.mean(axis=0)) < 0.03).all() and (np.ptp(bent, axis=0) > 0.15).all()
  np.testing.assert_array_equal(past(start), np.repeat(np.asarray(start.obs)[:, None], 13, axis=1))


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_torques_come_late_and_are_bounded(push: Any, state: State, delay: int) -> None:
  history = jnp.arange(4.0)[:, None] * jnp.ones(7) * 0.1
  late = state.replace(info=state.info | {"action_history": history, "action_delay": jnp.array(delay)})
  ctrl = np.asarray(push.action_to_ctrl(late, jnp.full(7, -0.5)))
  applied = -0.5 if delay == 0 else 0.1 * (delay - 1)
  np.testing.assert_allclose(ctrl, [*[0.1 * applied] * 7, 0.82], rtol=1e-5, atol=1e-8)
  now = late.replace(info=late.info | {"action_delay": jnp.array(0)})
  full = np.asarray(push.action_to_ctrl(now, jnp.full(7, 100.0)))
  np.testing.assert_allclose(full[:7] * push.mj_model.actuator_gear[:7, 0], 8.0, rtol=1e-5)


def test_delays_reach_both_ends(push: Any, state: State) -> None:
  keys = jax.random.split(jax.random.PRNGKey(0), 200)
  after: Any = jax.vmap(lambda key: step(push, state, observation_buffers=marked(), rng=key))(keys)
  assert set(after.info["action_delay"].tolist()) == {1, 2, 3}
  assert set(after.obs[:, 0].tolist()) == set(range(5, 12))  # one step later: 6 to 12 steps ago


def test_a_critic_reads_what_the_policy_reads(state: State) -> None:
  """`state: {}` of another group, which replay buffers rely on (`off_policy.groups_inside`)."""
  env = without_physics(TASK, **{"observations.privileged_state": {"state": {}, "object_to_goal": {}}})
  obs = jax.jit(jax.vmap(lambda key: step(env, state, observation_buffers=marked(), rng=key).obs))
  late = obs(jax.random.split(jax.random.PRNGKey(0), 8))
  assert len(set(late["state"][:, 0].tolist())) > 1
  np.testing.assert_array_equal(late["privileged_state"][:, :48], late["state"])


def test_the_newest_observation_is_of_now(push: Any, state: State) -> None:
  now = past(step(push, state))[0]
  data = state.data
  gripper = push.mj_model.site("gripper").id
  np.testing.assert_allclose(now[:3], data.mocap_pos[0], rtol=1e-6)
  np.testing.assert_allclose(now[3:9], [0, 1, 0, 0, 0, 1], atol=1e-6)
  np.testing.assert_allclose(now[16:23], data.qpos[:7], rtol=1e-6)
  np.testing.assert_allclose(now[30:33], data.site_xpos[gripper], rtol=1e-6)
  np.testing.assert_allclose(now[33:39], data.site_xmat[gripper, 1:].ravel(), atol=1e-6)
  np.testing.assert_allclose(now[45:48], data.xpos[push.mj_model.body("box").id], rtol=1e-6)


@pytest.mark.parametrize(("name", "old"), [(TASK, False), (f"v020/{TASK}", True)])
def test_noise(push: Any, state: State, name: str, old: bool) -> None:
  env = without_physics(name)
  observe = lambda key: past(step(env, state, rng=key))[0]
  seen = np.asarray(jax.vmap(observe)(jax.random.split(jax.random.PRNGKey(0), N)))
  exact = np.asarray(past(step(push, state))[0])
  noise = seen - exact
  np.testing.assert_allclose(noise[:, :16], 0, atol=1e-6)  # the goal and the last action are known
  for part, scale in ((slice(16, 23), 0.1), (slice(23, 30), 0.1), (slice(30, 33), 0.02)):
    values = noise[:, part]
    low = 0 if old else -scale
    assert low - 1e-5 <= values.min() < low + 0.1 * scale and 0.9 * scale < values.max() <= scale + 1e-5
    assert (np.ptp(values, axis=1) < 1e-5).all() == old
  assert np.abs(noise[:, 45:]).max() <= 0.0151
  cosines = np.asarray(seen[:, 39:42] @ exact[39:42])
  assert np.cos(np.radians(7.6)) < cosines.min() < np.cos(np.radians(6))
  cosines = np.asarray(seen[:, 36:39] @ exact[36:39])  # of the gripper's axes
  assert np.cos(np.radians(5.1)) < cosines.min() < np.cos(np.radians(4))


def test_terms_by_hand(push: Any, state: State) -> None:
  block, gripper = push.mj_model.body("box").id, push.mj_model.site("gripper").id
  after = step(push, state, 1.0, last_act=jnp.full(7, 0.5))
  box, goal = np.asarray(state.data.xpos[block]), np.asarray(state.data.mocap_pos[0])
  away = box - goal
  behind = np.linalg.norm(box + 0.1 * away / np.linalg.norm(away) - state.data.site_xpos[gripper])
  expected = {
    "gripper_behind_object_tolerance": 2 * (1 if behind < 0.1 else 1 - 0.9 * (behind - 0.1)),
    "object_goal_distance_xy_tolerance": 8 / (1 + 9 * (0.02 - 0.005) / 0.4),
    "object_goal_angle_tolerance": 6,
    "contact_normal_horizontal": 0,
    "joint_deviation_tolerance": 0.75,
    "joint_vel_tolerance": 1,
    "joint_vel_within_limits": 3,
    "action_norm": -0.1 * np.sqrt(7),
    "action_rate_norm": -0.1 * 0.5 * np.sqrt(7),
  }
  for name, value in expected.items():
    np.testing.assert_allclose(after.metrics[f"reward/{name}"], value, rtol=1e-3, atol=1e-6, err_msg=name)
  np.testing.assert_allclose(after.reward, 0.005 * (sum(expected.values()) / 21.55 + 3), rtol=1e-4)
  reached = [float(after.metrics[name]) for name in ("success", "success_1", "success_2")]
  assert (reached, after.done) == ([0, 1, 1], 0)
  np.testing.assert_allclose(after.metrics["position_error_cm"], 2, rtol=1e-4)


def test_pushing_from_the_side_pays(push: Any, state: State) -> None:
  for normal, value in (((0.0, 0, -1), 0.0), ((0.0, 1, 0), 1.0), ((0.0, 0.6, 0.8), 0.6)):
    data = state.data.replace(sensordata=state.data.sensordata.at[:3].set(jnp.array(normal)))
    metrics = step(push, state, data=data).metrics
    np.testing.assert_allclose(metrics["reward/contact_normal_horizontal"], value, atol=1e-5)


def test_fast_joints_cost(push: Any, state: State) -> None:
  data = state.data.replace(qvel=state.data.qvel.at[6].set(-2.4))
  assert step(push, state, data=data).metrics["reward/joint_vel_within_limits"] == 0


@pytest.mark.parametrize(
  ("change", "done"),
  [
    ({}, 0),
    ({"box": (0.29, 0, 0.03)}, 1),
    ({"box": (0.5, 0.71, 0.03)}, 1),
    ({"box": (0.5, 0.0, -0.011)}, 1),
    ({"sensor": 18}, 1),
    ({"sensor": 23}, 1),
    ({"joint": (3, -0.2)}, 1),
    ({"joint": (3, -0.25)}, 0),
    ({"joint": (0, 2.7)}, 1),
    ({"gripper": (0.5, 0.0, 0.51)}, 1),
    ({"gripper": (0.76, 0.0, 0.3)}, 1),
  ],
)
def test_what_ends_an_episode(push: Any, state: State, change: dict[str, Any], done: int) -> None:
  data = state.data
  if "box" in change:
    data = moved(state, push, change["box"])
  if "gripper" in change:
    data = data.replace(site_xpos=data.site_xpos.at[push.mj_model.site("gripper").id].set(jnp.array(change["gripper"])))
  if "sensor" in change:
    data = data.replace(sensordata=data.sensordata.at[change["sensor"]].set(1.0))
  if "joint" in change:
    joint, angle = change["joint"]
    data = data.replace(qpos=data.qpos.at[joint].set(angle))
  after = step(push, state, data=data)
  assert (after.done, after.metrics["fall"]) == (done, done)
  assert (after.reward < 0) == bool(done)


def test_a_goal_is_reached_after_31_steps_and_the_next_appears(push: Any, state: State) -> None:
  current, goal = state, np.asarray(state.data.mocap_pos)
  for i in range(31):
    current = step(push, current)
    assert current.metrics["success"] == current.metrics["goals_reached"] == (i == 30)
    assert current.metrics["curriculum_level"] == (i == 30)
    assert (np.asarray(push.pre_step(current).data.mocap_pos) != goal).any() == (i == 30)
  assert current.reward > 2.5
  assert current.info["goal_steps"] == 0
  assert step(push, current).metrics["curriculum_level"] == 1


def test_a_success_is_of_place_and_of_turn(push: Any, state: State) -> None:
  goal, held = np.asarray(state.data.mocap_pos[0]), {"goal_steps": jnp.array(30)}
  tilted = jnp.array([np.cos(0.1), 0, 0, np.sin(0.1)])  # by 0.2 rad
  for place, turn, expected in (
    (goal, None, (1, 1, 1)),
    (goal + 0.1, None, (0, 0, 1)),
    (goal, tilted, (0, 1, 0)),
  ):
    data = moved(state, push, place)
    data = data if turn is None else data.replace(xquat=data.xquat.at[push.mj_model.body("box").id].set(turn))
    metrics = step(push, state, data=data, **held).metrics
    assert tuple(float(metrics[name]) for name in ("success", "success_1", "success_2")) == expected


def test_goals_move_away_with_the_level(push: Any, state: State) -> None:
  home = np.asarray(push.mj_model.key("home").qpos[13:16])

  @jax.jit
  @jax.vmap
  def after_success(key: jax.Array, level: jax.Array) -> State:
    info = {"rng": key, "goal_steps": jnp.array(30), PRESERVE_INFO: {"curriculum_id": level}}
    return push.pre_step(push.post_step(state.data, state.info | info, jnp.zeros(7)))

  for level, reach, angle, after in (
    (0, 0.05, 45, 1),
    (1, 0.1, 90, 2),
    (2, 0.2, 135, 3),
    (3, 0.2, 180, 4),
    (4, 0.2, 180, 4),
  ):
    goal = after_success(jax.random.split(jax.random.PRNGKey(0), N), jnp.full(N, level))
    off = np.asarray(goal.data.mocap_pos[:, 0]) - home
    turned = np.degrees(2 * np.arccos(np.clip(np.abs(np.asarray(goal.data.mocap_quat[:, 0, 0])), 0, 1)))
    assert (goal.metrics["curriculum_level"] == after).all()
    assert 0.85 * reach < np.abs(off[:, 1]).max() <= reach + 1e-6
    assert 0.9 * angle < turned.max() <= angle + 0.1
    assert np.abs(np.corrcoef(off[:, :2].T, turned)[2, :2]).max() < 0.3, "place and turn have keys of their own"


def test_the_level_outlasts_episodes_and_all_else_begins_anew(push: Any) -> None:
  def at_the_goal(model: Any, data: Any, ctrl: jax.Array, steps: int) -> Any:
    block = push.mj_model.body("box").id
    xpos = jnp.zeros((push.mj_model.nbody, 3)).at[block].set(data.mocap_pos[0])
    xquat = jnp.zeros((push.mj_model.nbody, 4)).at[block].set(data.mocap_quat[0])
    gripper = jnp.full(data.site_xpos.shape, 0.4)
    return data.replace(time=data.time + 0.005, xpos=xpos, xquat=xquat, site_xpos=gripper, ctrl=ctrl)

  env = load_task(TASK, {**SILENT, "episode_length": 40, "success_steps": 10, "action_repeat": 1})
  env.physics.forward = lambda model, data: data
  env.physics.step = at_the_goal
  for full_reset in (False, True):
    wrapped = wrap_for_training(env, full_reset=full_reset)
    state = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), 2))
    run = jax.jit(
      lambda s, wrapped=wrapped: jax.lax.scan(lambda s, _: (wrapped.step(s, jnp.ones((2, 7))), s), s, None, 50)
    )
    last, states = run(state)
    assert states.info["AutoResetWrapper_done_count"][-1].tolist() == [1, 1]
    # in the first episode 0, 1, 2 and 3 goals, in the second none again
    assert states.metrics["goals_reached"][[10, 11, 22, 33, 41], 0].tolist() == [0, 1, 2, 3, 0]
    assert states.metrics["curriculum_level"][1:45:11, 0].tolist() == [0, 1, 2, 3]
    assert (last.info[PRESERVE_INFO]["curriculum_id"] == 3).all()
    assert last.info["goal_steps"].tolist() == [10, 10]  # of the second episode alone


@pytest.mark.parametrize(
  ("overrides", "message"),
  [
    ({"action_delay": [4, 3]}, r"env\.action_delay=\[4, 3\] must be"),
    ({"observation_delay": [-1, 3]}, r"env\.observation_delay=\[-1, 3\] must be"),
    ({"curriculum.angle": [0.5]}, "an entry for each level"),
    ({"reward_total": "product"}, r"env\.reward_total=product: this task's reward is a mean of terms: leave it at sum"),
  ],
)
def test_refuses(overrides: dict[str, Any], message: str) -> None:
  with pytest.raises(ConfigError, match=message):
    load_task(TASK, overrides)


def test_a_clipped_reward_and_any_turn(state: State) -> None:
  env = without_physics(TASK, **SILENT, reward_clip=[0.0, 1e-5], success_angle=None)
  after = step(env, state)
  assert after.reward == pytest.approx(1e-5) and after.metrics["success_2"] == 1
