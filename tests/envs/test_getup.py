"""The getup task: where episodes start, what actions mean, what ends an episode, and what differs between robots."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground import registry
from playground.config import compose
from playground.envs.base import State
from tests.envs.golden import golden, load_task, terms

TASK = "Go1Getup"
N = 256


@pytest.fixture(scope="module")
def getup() -> Any:
  env = load_task(TASK, {"settle_s": 0.0})
  env.physics.forward = lambda model, data: data  # nothing here reads what it computes
  return env


@pytest.fixture(scope="module")
def start(getup: Any) -> State:
  """Starts before they come to rest."""
  return jax.jit(jax.vmap(getup.reset))(jax.random.split(jax.random.PRNGKey(0), N))


@pytest.fixture(scope="module")
def state() -> State:
  """A recorded state, which any variant of the task may go on from."""
  return jax.tree.map(lambda x: x[4], golden(TASK).states)


def evaluate(env: Any, state: State, **data: Any) -> State:
  return env.post_step(state.data.replace(**data), state.info, jnp.zeros(12))


def test_observation_parts_add_up(getup: Any, start: State) -> None:
  sizes = {group: sum(parts.values()) for group, parts in getup.observation_parts.items()}
  assert sizes == {name: value.shape[-1] for name, value in dict(start.obs).items()}
  assert sizes == {"state": 42, "privileged_state": 91}


def test_start_is_a_drop_or_the_standing_pose(getup: Any, start: State) -> None:
  qpos = np.asarray(start.data.qpos)
  dropped = qpos[:, 2] == 0.5
  np.testing.assert_array_equal(qpos[~dropped], np.tile(getup.robot.init_qpos, (N - dropped.sum(), 1)))
  assert abs(dropped.mean() - 0.6) < 4 * np.sqrt(0.6 * 0.4 / N)
  np.testing.assert_array_equal(start.data.ctrl, qpos[:, 7:])


def test_a_start_comes_to_rest_before_time_begins(monkeypatch: pytest.MonkeyPatch) -> None:
  env = load_task(TASK)
  monkeypatch.setattr(env.physics, "forward", lambda model, data: data)
  rest = lambda model, data, ctrl, steps: data.replace(time=0.004 * steps, qvel=jnp.full(18, 1.0 * steps), ctrl=ctrl)
  monkeypatch.setattr(env.physics, "step", rest)
  data = jax.jit(lambda key: env.reset(key).data)(jax.random.PRNGKey(0))
  assert data.time == 0 and (data.qvel == 125).all()  # 0.5 s in steps of 4 ms


def test_targets_start_from_where_the_joints_are(getup: Any, state: State) -> None:
  action = jnp.linspace(-1, 1, 12)
  np.testing.assert_allclose(getup.action_to_ctrl(state, action), state.data.qpos[7:] + 0.5 * action, rtol=1e-6)
  previous = load_task(TASK, {"action_base": "last_target"})  # the paper's
  np.testing.assert_allclose(previous.action_to_ctrl(state, action), state.data.ctrl + 0.5 * action, rtol=1e-6)


def test_spots_targets_stay_within_the_servos_range(state: State) -> None:
  spot = load_task("SpotGetup")
  lower, upper = spot.mj_model.actuator_ctrlrange.T
  for sign, limit in ((-1, lower), (1, upper)):
    np.testing.assert_allclose(spot.action_to_ctrl(state, jnp.full(12, sign * 20.0)), limit, rtol=1e-6)


def test_rewards_of_a_robot_that_stands(getup: Any, state: State) -> None:
  sensors, q = getup.mj_model.sensor("upvector").adr[0], getup.robot.init_qpos
  up = state.data.sensordata.at[sensors : sensors + 3].set(jnp.array([0.0, 0.0, 1.0]))
  site = state.data.site_xpos.at[getup.robot.base_site, 2].set(0.275)
  after = evaluate(getup, state, sensordata=up, site_xpos=site, qpos=q, qvel=jnp.zeros(18), qacc=jnp.zeros(18))
  rewards = {name.removeprefix("reward/"): float(value) for name, value in terms(after).items()}
  best = {
    "upright_exp": 1.0,
    "base_height_expm1": np.exp(0.275) - 1,
    "pose_exp_when_upright": 1.0,
    "action_exp_when_up": 1.0,
  }
  np.testing.assert_allclose([rewards[name] for name in best], list(best.values()), rtol=1e-5)
  assert rewards["joint_vel_limits_l2"] == rewards["joint_acc_l2"] == rewards["joint_pos_limits"] == 0
  np.testing.assert_allclose(after.reward, 0.02 * sum(rewards.values()), rtol=1e-5)


def test_power_cutoff(state: State) -> None:
  """The first stage of the paper: 400 W ends an episode; without a threshold nothing does."""
  force, velocity = jnp.full(12, -10.0), jnp.zeros(18).at[6:].set(3.4)  # 408 W, all of it braking
  for power, done in ((400.0, 1.0), (409.0, 0.0), (None, 0.0)):
    cutoff = {} if power is None else {"terminations.power_above": {"params": {"limit": power}}}
    after = evaluate(load_task(TASK, cutoff), state, actuator_force=force, qvel=velocity)
    assert after.done == done


def test_spot_ends_with_a_joint_past_its_limit() -> None:
  spot = load_task("SpotGetup")
  now = jax.tree.map(lambda x: x[1], golden("SpotGetup").states)
  past = now.data.qpos.at[7].set(spot.robot.joint_range[1, 0] + 0.01)
  assert (evaluate(spot, now).done, evaluate(spot, now, qpos=past).done) == (0, 1)


def test_spot_senses_gravity_whatever_its_heading() -> None:
  spot = load_task("SpotGetup", {"noise_level": 0.0})
  now = jax.tree.map(lambda x: x[1], golden("SpotGetup").states)
  site, start = spot.robot.base_site, spot.mj_model.sensor("upvector").adr[0]

  def seen(yaw: float) -> np.ndarray:
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    tilt = turn @ np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
    data = {
      "site_xmat": now.data.site_xmat.at[site].set(tilt),
      "sensordata": now.data.sensordata.at[start : start + 3].set(tilt[:, 2]),
    }
    return np.asarray(evaluate(spot, now, **data).obs)[3:6]

  for yaw in (0.0, 1.0):
    np.testing.assert_allclose(seen(yaw), [0.6, 0, -0.8], atol=1e-6)


def test_any_robot_with_a_body_can_be_named() -> None:
  assert registry.build(compose(["env=getup", "robot=spot"]).env).action_size == 12
