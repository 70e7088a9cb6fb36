"""Hands with a cube: what is rewarded, what a goal does, what an episode forgets and what noise touches.

On recorded states of Playground 0.2.0, with what is looked at replaced: no physics is computed.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco.mjx._src.math import quat_integrate

from playground.envs.base import State
from playground.envs.manipulation.in_hand import InHand
from playground.envs.manipulation.reorient import Reorient, new_spin
from playground.mdp.rotations import angle_between
from tests.envs.golden import golden, load_task

TASKS = ["LeapCubeReorient", "LeapCubeRotateZAxis", "AeroCubeRotateZAxis"]
ROTATE = TASKS[1:]
GOAL = jnp.array([0.5, 0.5, -0.5, 0.5])


@functools.cache
def build(name: str, **overrides: Any) -> Any:
  """A task whose `evaluate` is compiled, without noise unless overrides say so; `a__b` stands for the key `a.b`."""
  overrides = {"noise__level": 0.0} | overrides
  env = load_task(name, {key.replace("__", "."): value for key, value in overrides.items()})
  env.evaluate = jax.jit(env.evaluate)
  return env


@pytest.fixture(scope="module")
def reorient() -> Reorient:
  return build("LeapCubeReorient")


@pytest.fixture(params=ROTATE, scope="module")
def rotate(request: pytest.FixtureRequest) -> tuple[str, InHand]:
  return request.param, build(request.param)


def amid(name: str, **info: Any) -> State:
  """A recorded state amid an episode."""
  state = jax.tree.map(lambda x: x[4], golden(name).states)
  return state.replace(info=state.info | info)


def sense(env: InHand, state: State, **readings: Any) -> State:
  """The state with sensors' readings replaced."""
  data = state.data.sensordata
  for name, reading in readings.items():
    sensor = env.mj_model.sensor(name)
    data = data.at[sensor.adr[0] : sensor.adr[0] + sensor.dim[0]].set(jnp.asarray(reading, float))
  return state.replace(data=state.data.replace(sensordata=data))


def step(env: InHand, state: State, action: Any = None) -> State:
  return env.evaluate(state.data, state.info, jnp.zeros(env.action_size) if action is None else action)


def observe(env: InHand, state: State) -> Any:
  """The observation alone, which compiles faster than a step."""
  action = jnp.zeros(env.action_size)
  return jax.jit(lambda data, info: env.evaluate(data, info, action).obs)(state.data, state.info)


def at_goal(env: InHand, **info: Any) -> State:
  return sense(env, amid("LeapCubeReorient", **info), cube_orientation=GOAL, cube_goal_orientation=GOAL)


# Reorient


def test_reaching_the_goal_pays_and_sends_it_on(reorient: Reorient) -> None:
  after = step(reorient, at_goal(reorient, steps_since_success=jnp.array(7)))
  assert (after.metrics["success"], after.metrics["rotations"], after.metrics["reward/success"]) == (1, 1, 100)
  assert after.metrics["reward/orientation"] == 5.0
  assert after.info["steps_since_success"] == 0
  assert float(after.metrics["rotation_error_deg"]) == pytest.approx(0, abs=0.1)
  assert jnp.linalg.norm(after.info["goal_spin"]) > 1 and after.info["goal_spin"].min() >= 1

  off = sense(
    reorient, at_goal(reorient), cube_orientation=quat_integrate(GOAL, jnp.array([0.2, 0, 0]), jnp.array(1.0))
  )
  missed = step(reorient, off)
  assert (missed.metrics["success"], missed.info["steps_since_success"]) == (
    0,
    amid("LeapCubeReorient").info["steps_since_success"] + 1,
  )
  assert float(missed.metrics["rotation_error_deg"]) == pytest.approx(np.rad2deg(0.2), abs=0.1)
  assert float(after.reward - missed.reward) == pytest.approx(100, abs=0.2)


def test_a_goal_comes_to_rest_at_least_a_quarter_turn_away(reorient: Reorient) -> None:
  spins = jax.vmap(lambda key: new_spin(key, jnp.pi / 2, reorient.dt))(jax.random.split(jax.random.PRNGKey(0), 500))

  def travel(spin: jax.Array) -> jax.Array:
    goal = lambda q, k: (quat_integrate(q, spin * 0.8**k, jnp.array(2 * reorient.dt)), None)
    return angle_between(jax.lax.scan(goal, GOAL, jnp.arange(60))[0], GOAL)

  turned = np.asarray(jax.jit(jax.vmap(travel))(spins))
  assert turned.min() > np.pi / 2 - 2e-3
  assert turned.max() > 3 and turned.std() > 0.2
  upstream = jax.vmap(lambda key: new_spin(key, 0.0, reorient.dt))(jax.random.split(jax.random.PRNGKey(0), 500))
  shorter = np.linalg.norm(upstream, axis=1) < np.pi
  np.testing.assert_allclose(spins[~shorter], upstream[~shorter])
  assert 0 < shorter.mean() < 0.1


def test_the_goal_moves_as_it_spins_and_slows_down(reorient: Reorient) -> None:
  state = amid("LeapCubeReorient", goal_spin=jnp.array([1.0, 0.0, 0.0]))
  after = step(reorient, state)
  np.testing.assert_allclose(after.info["goal_spin"], [0.8, 0, 0], rtol=1e-6)
  moved = angle_between(after.data.mocap_quat[0], state.data.mocap_quat[0])
  assert float(moved) == pytest.approx(0.8 * 2 * reorient.dt, abs=2e-3)


def test_rotations_count_until_the_hand_is_stuck(reorient: Reorient) -> None:
  limit = round(30 / reorient.dt)
  waiting = step(reorient, amid("LeapCubeReorient", steps_since_success=jnp.array(limit - 1)))
  assert not waiting.info["stuck"]
  stuck = step(reorient, waiting)
  assert stuck.info["stuck"]
  late = step(reorient, at_goal(reorient, stuck=jnp.array(True)))
  assert (late.metrics["success"], late.metrics["rotations"], bool(late.info["stuck"])) == (1, 0, True)


def test_noise_is_on_what_the_actor_sees_of_the_cube_only() -> None:
  noisy = build("LeapCubeReorient", noise__level=1.0, noise__pose__injection=1.0)
  state = amid("LeapCubeReorient")
  seen, exact = (observe(env, state) for env in (noisy, build("LeapCubeReorient")))
  parts = noisy.observation_parts
  assert {group: sum(sizes.values()) for group, sizes in parts.items()} == {"state": 57, "privileged_state": 128}
  start = 0
  differs = {}
  for part, size in parts["state"].items():
    piece = slice(start, start + size)
    differs[part] = float(jnp.abs(seen["state"][piece] - exact["state"][piece]).max())
    start += size
  joints = {"joint_pos", "target_error_history"}
  assert {part for part, gap in differs.items() if gap > 0} == {*joints, *(p for p in parts["state"] if "cube" in p)}
  assert max(differs[part] for part in joints) <= 0.05 + 1e-6
  assert min(differs[part] for part in parts["state"] if "cube" in part) > 0.05  # plainly wrong
  np.testing.assert_array_equal(seen["privileged_state"][57:], exact["privileged_state"][57:])


def test_histories_hold_the_last_observations_parts() -> None:
  env = build("LeapCubeReorient", history__target_error=2, history__sensed_cube_pos_error=3)
  assert sum(env.observation_parts["state"].values()) == 57 + 16 + 6
  start = jax.eval_shape(env.reset, jax.random.PRNGKey(0)).obs["state"]
  state = amid("LeapCubeReorient").replace(obs={"state": jnp.arange(1.0, start.shape[0] + 1), "privileged_state": 0})
  seen = observe(env, env.disturb(state))["state"]
  np.testing.assert_array_equal(seen[32:48], jnp.arange(17.0, 33.0))  # the newest of the last step
  np.testing.assert_array_equal(seen[51:57], jnp.arange(49.0, 55.0))


def test_pushes_act_on_the_cube() -> None:
  env = build("LeapCubeReorient", pushes__enable=True)
  names = ("push_step", "pert_interval", "pert_duration", "pert_mag", "pert_dir", "pert_mass")
  start = env._pushes.start(dict.fromkeys(env._pushes.keys, jax.random.PRNGKey(0)), jnp.array(0.108))
  assert set(start) == set(names)
  assert 60 <= start["pert_interval"] < 150 and 1 <= start["pert_duration"] < 100
  kicked = {"push_step": jnp.array(70), "pert_interval": jnp.array(60), "pert_duration": jnp.array(20)}
  kicked |= {"pert_mag": jnp.array([2.0, 2, 2, 0.4, 0.4, 0.4]), "pert_dir": jnp.ones(6) / np.sqrt(6)}
  after = env.disturb(amid("LeapCubeReorient", **start | kicked))
  wrench = np.asarray(after.data.xfrc_applied)
  np.testing.assert_allclose(wrench[env.hand.cube, :3], 0.5 * 0.108 * 2 / (20 * 0.05) / np.sqrt(6), rtol=1e-3)
  np.testing.assert_allclose(wrench[env.hand.cube, 3:], 0.2 * wrench[env.hand.cube, :3], rtol=1e-5)
  assert not np.delete(wrench, env.hand.cube, axis=0).any()
  quiet = env.disturb(amid("LeapCubeReorient", **start | kicked | {"push_step": jnp.array(85)}))
  assert not quiet.data.xfrc_applied.any()


# Rotate


def test_turning_the_cube_pays_by_its_sign(rotate: tuple[str, InHand]) -> None:
  name, env = rotate
  state = sense(env, amid(name, last_act=jnp.zeros(env.action_size)), cube_angvel=[9.0, 9.0, 3.0])
  after = step(env, state)
  assert float(after.metrics["reward/angvel"]) == pytest.approx(3.0)
  assert float(after.reward) == pytest.approx(3.0 * env.dt, rel=1e-5)
  assert float(after.metrics["turns"]) == pytest.approx(3.0 * env.dt / (2 * np.pi), rel=1e-5)
  back = step(env, sense(env, state, cube_angvel=[0.0, 0.0, -3.0]))
  assert float(back.reward) == pytest.approx(-3.0 * env.dt, rel=1e-5)


def test_observations_have_the_parts_that_they_say(rotate: tuple[str, InHand]) -> None:
  name, env = rotate
  sizes = {group: sum(parts.values()) for group, parts in env.observation_parts.items()}
  assert (
    sizes
    == {
      "LeapCubeRotateZAxis": {"state": 32, "privileged_state": 105},
      "AeroCubeRotateZAxis": {"state": 14, "privileged_state": 81},
    }[name]
  )


def test_targets_are_those_of_the_grasp_plus_the_action(rotate: tuple[str, InHand]) -> None:
  name, env = rotate
  state, action = amid(name), jnp.linspace(-1, 1, env.action_size)
  expected = env.mj_model.key("home").ctrl + np.asarray(env.config.action_scale) * action
  np.testing.assert_allclose(env.control(state, action), expected, rtol=1e-5)
  lower, upper = env.mj_model.actuator_ctrlrange.T
  far = np.asarray(env.control(state, 100 * jnp.ones(env.action_size)))
  np.testing.assert_allclose(far, upper, rtol=1e-6)
  assert (lower < far).all()


# All


@pytest.mark.parametrize("name", TASKS)
def test_a_cube_that_falls_ends_the_episode_and_costs(name: str) -> None:
  env: Any = golden(name).env
  held, fallen = (step(env, sense(env, amid(name), cube_position=[0.1, 0.0, z])) for z in (0.0, -0.06))
  assert (held.done, fallen.done) == (0, 1)
  assert (held.metrics["reward/termination"], fallen.metrics["reward/termination"]) == (0, -100)


@pytest.mark.parametrize("field", ["qpos", "qvel"])
@pytest.mark.parametrize("name", TASKS)
def test_numbers_that_are_not_finite_end_an_episode(name: str, field: str) -> None:
  state, env = amid(name), golden(name).env
  spoilt = state.data.replace(**{field: getattr(state.data, field).at[3].set(jnp.nan)})
  assert env.evaluate(spoilt, state.info, jnp.zeros(env.action_size)).done == 1


@pytest.mark.parametrize("name", TASKS)
def test_an_episode_forgets_the_one_before(name: str) -> None:
  env = build(name)
  state = amid(name)
  dirty = state.replace(info=state.info | {key: jnp.ones_like(state.info[key]) for key in env.forgotten})
  beginning = dirty.replace(data=dirty.data.replace(time=jnp.zeros(())))
  assert all(not env.disturb(beginning).info[key].any() for key in env.forgotten)
  assert all(env.disturb(dirty).info[key].all() for key in env.forgotten)
  upstream = golden(name).env.disturb(beginning)
  assert all(upstream.info[key].all() for key in env.forgotten)


def test_targets_move_on_and_may_be_smoothed() -> None:
  state, action = amid("LeapCubeReorient"), jnp.linspace(-1, 1, 16)
  full, half = (
    env.control(state, action) for env in (build("LeapCubeReorient"), build("LeapCubeReorient", ema_alpha=0.5))
  )
  np.testing.assert_allclose(half, 0.5 * (full + state.data.ctrl), rtol=1e-5, atol=1e-6)
  lower, upper = build("LeapCubeReorient").mj_model.actuator_ctrlrange.T
  np.testing.assert_allclose(full, np.clip(state.data.ctrl + 0.5 * action, lower, upper), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", TASKS)
def test_starts(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
  env = build(name)
  monkeypatch.setattr(env.physics, "forward", lambda model, data: data)  # nothing here reads what it computes
  data = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 200)).data
  joints, cube = np.asarray(data.qpos[:, :16]), np.asarray(data.qpos[:, 16:])
  lower, upper = env.mj_model.jnt_range[:16].T
  assert (joints >= lower - 1e-6).all() and (joints <= upper + 1e-6).all() and (joints.std(axis=0) > 0.03).all()
  assert np.abs(cube[:, :3] - [0.1, 0.0, 0.05]).max() <= 0.01 + 1e-6 and np.ptp(cube[:, :3], axis=0).min() > 0.018
  np.testing.assert_allclose(np.linalg.norm(cube[:, 3:], axis=1), 1, rtol=1e-5)
  target = joints if name.startswith("Leap") else np.tile(env.mj_model.key("home").ctrl, (200, 1))
  np.testing.assert_allclose(data.ctrl, target, rtol=1e-6)
  goals = np.asarray(data.mocap_quat[:, 0])
  assert (goals.std(axis=0) > 0.3).all() == (name == "LeapCubeReorient")


@pytest.mark.parametrize("collides", [False, True])
def test_the_goal_is_a_mark_but_in_0_2_0(collides: bool) -> None:
  model: mujoco.MjModel = (golden("LeapCubeReorient").env if collides else build("LeapCubeReorient")).mj_model
  geoms = model.geom_bodyid == model.body("goal").id
  assert (model.geom_contype[geoms] | model.geom_conaffinity[geoms]).any() == collides
  assert model.geom("cube").contype[0] == 1


def test_limits_on_torques_can_be_lifted() -> None:
  limited, free = build("LeapCubeReorient").mj_model, build("LeapCubeReorient", torque_limits=False).mj_model
  np.testing.assert_allclose(limited.jnt_actfrcrange[:16], np.tile([-0.2196, 0.2196], (16, 1)))
  assert limited.jnt_actfrclimited[:16].all() and not free.jnt_actfrclimited.any()
