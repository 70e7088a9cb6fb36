"""Hands with a cube: what is rewarded, what a goal does, where episodes start and what noise touches.

On recorded states of Playground 0.2.0, with what is looked at replaced: no physics is computed.
"""

import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mujoco.mjx._src.math import quat_integrate

from playground.envs.base import State
from playground.envs.manipulation.reorient import new_spin
from playground.mdp.poses import angle_between
from playground.robots.scene import find_mjcf
from tests.envs.golden import golden, recorded, without_physics

REORIENT, ROTATE = "LeapCubeReorient", ("LeapCubeRotateZAxis", "AeroCubeRotateZAxis")
TASKS = (REORIENT, *ROTATE)
GOAL = jnp.array([0.5, 0.5, -0.5, 0.5])


@functools.cache
def build(name: str, **overrides: Any) -> Any:
  """A task without physics, and without noise unless overrides say so; `a__b` stands for the key `a.b`."""
  overrides = {"noise_level": 0.0} | {key.replace("__", "."): value for key, value in overrides.items()}
  return without_physics(name, **overrides)


def sense(env: Any, state: State, **readings: Any) -> State:
  """The state with sensors' readings replaced."""
  data = state.data.sensordata
  for name, reading in readings.items():
    sensor = env.mj_model.sensor(name)
    data = data.at[sensor.adr[0] : sensor.adr[0] + sensor.dim[0]].set(jnp.asarray(reading, float))
  return state.replace(data=state.data.replace(sensordata=data))


def step(env: Any, state: State) -> State:
  return env.post_step(state.data, state.info, jnp.zeros(env.action_size))


# Reorient


def at_goal(turned: float = 0.0, **info: Any) -> State:
  quat = quat_integrate(GOAL, jnp.array([turned, 0, 0]), jnp.array(1.0))
  return sense(build(REORIENT), recorded(REORIENT, **info), cube_orientation=quat, cube_goal_orientation=GOAL)


def test_reaching_the_goal_pays_and_sends_it_on() -> None:
  env = build(REORIENT)
  after = step(env, at_goal(steps_since_success=jnp.array(7)))
  assert (after.metrics["success"], after.metrics["rotations"], after.metrics["reward/success"]) == (1, 1, 100)
  assert after.metrics["reward/cube_orientation_linear"] == 5.0
  assert (after.metrics["success_count"], after.metrics["steps_since_last_success"]) == (1, 0)
  assert after.info["steps_since_success"] == 0
  assert float(after.metrics["rotation_error_deg"]) == pytest.approx(0, abs=0.1)
  assert jnp.linalg.norm(after.info["goal_spin"]) > 1 and after.info["goal_spin"].min() >= 1

  missed = step(env, at_goal(turned=0.2, steps_since_success=jnp.array(7)))
  assert (missed.metrics["success"], missed.info["steps_since_success"]) == (0, 8)
  assert float(missed.metrics["rotation_error_deg"]) == pytest.approx(np.rad2deg(0.2), abs=0.1)
  assert float(after.reward - missed.reward) == pytest.approx(100, abs=0.2)


def test_a_goal_comes_to_rest_at_least_a_quarter_turn_away() -> None:
  dt, keys = build(REORIENT).dt, jax.random.split(jax.random.PRNGKey(0), 500)
  spins, upstream = (jax.vmap(lambda key, turn=turn: new_spin(key, turn, dt))(keys) for turn in (jnp.pi / 2, 0.0))

  def travel(spin: jax.Array) -> jax.Array:
    goal = lambda q, k: (quat_integrate(q, spin * 0.8**k, jnp.array(2 * dt)), None)
    return angle_between(jax.lax.scan(goal, GOAL, jnp.arange(60))[0], GOAL)

  turned = np.asarray(jax.jit(jax.vmap(travel))(spins))
  assert turned.min() > np.pi / 2 - 2e-3
  assert turned.max() > 3 and turned.std() > 0.2
  shorter = np.linalg.norm(upstream, axis=1) < np.pi
  np.testing.assert_allclose(spins[~shorter], upstream[~shorter])
  assert 0 < shorter.mean() < 0.1


def test_the_goal_moves_as_it_spins_and_slows_down() -> None:
  env, state = build(REORIENT), recorded(REORIENT, goal_spin=jnp.array([1.0, 0.0, 0.0]))
  after = step(env, state)
  np.testing.assert_allclose(after.info["goal_spin"], [0.8, 0, 0], rtol=1e-6)
  moved = angle_between(after.data.mocap_quat[0], state.data.mocap_quat[0])
  assert float(moved) == pytest.approx(0.8 * 2 * env.dt, abs=2e-3)


def test_rotations_count_until_the_hand_is_stuck() -> None:
  env = build(REORIENT)
  limit = round(30 / env.dt)
  waiting = step(env, recorded(REORIENT, steps_since_success=jnp.array(limit - 1)))
  assert not waiting.info["stuck"]
  assert step(env, waiting).info["stuck"]
  late = step(env, at_goal(stuck=jnp.array(True)))
  assert (late.metrics["success"], late.metrics["rotations"], bool(late.info["stuck"])) == (1, 0, True)


def test_noise_is_on_what_the_actor_sees_of_the_cube_only() -> None:
  noisy = build(REORIENT, noise_level=1.0, pose_noise__injection=1.0)
  state = recorded(REORIENT, pose_key=jax.random.PRNGKey(0))
  seen, exact = (step(env, state).obs for env in (noisy, build(REORIENT)))
  parts = noisy.observation_parts["state"]
  ends = np.cumsum([*parts.values()])
  gaps = np.split(np.abs(np.asarray(seen["state"] - exact["state"])), ends[:-1])
  differs = {part: float(gap.max()) for part, gap in zip(parts, gaps, strict=True)}
  cube = {part for part in parts if "cube" in part}
  assert {part for part, gap in differs.items() if gap > 0} == {"joint_pos", "target_error"} | cube
  assert max(differs["joint_pos"], differs["target_error"]) <= 0.05 + 1e-6
  assert min(differs[part] for part in cube) > 0.05  # plainly wrong
  np.testing.assert_array_equal(seen["privileged_state"][57:], exact["privileged_state"][57:])


# Rotate


@pytest.mark.parametrize("name", ROTATE)
def test_turning_the_cube_pays_by_its_sign(name: str) -> None:
  env = build(name)
  state = sense(env, recorded(name, last_act=jnp.zeros(env.action_size)), cube_angvel=[9.0, 9.0, 3.0])
  after = step(env, state)
  assert float(after.metrics["reward/cube_ang_vel_z"]) == pytest.approx(3.0)
  assert float(after.reward) == pytest.approx(3.0 * env.dt, rel=1e-5)
  assert float(after.metrics["turns"]) == pytest.approx(3.0 * env.dt / (2 * np.pi), rel=1e-5)
  back = step(env, sense(env, state, cube_angvel=[0.0, 0.0, -3.0]))
  assert float(back.reward) == pytest.approx(-3.0 * env.dt, rel=1e-5)


# All


def test_targets_are_those_of_the_grasp_or_the_last_ones_plus_the_action() -> None:
  for name in TASKS:
    env, state = build(name), recorded(name)
    lower, upper = env.mj_model.actuator_ctrlrange.T
    base = state.data.ctrl if name == REORIENT else env.mj_model.key("home").ctrl
    action = jnp.linspace(-1, 1, env.action_size)
    expected = np.clip(base + np.asarray(env.config.action_scale) * action, lower, upper)
    np.testing.assert_allclose(env.action_to_ctrl(state, action), expected, rtol=1e-5, atol=1e-6)
  half = build(REORIENT, ema_alpha=0.5).action_to_ctrl(recorded(REORIENT), jnp.ones(16))
  full = build(REORIENT).action_to_ctrl(recorded(REORIENT), jnp.ones(16))
  np.testing.assert_allclose(half, 0.5 * (full + recorded(REORIENT).data.ctrl), rtol=1e-5, atol=1e-6)


def test_targets_of_servos_without_a_range_have_no_limits(tmp_path: Path) -> None:
  hand, text = tmp_path / "hand.xml", find_mjcf("playground/robots/leap_hand/right_hand.xml").read_text()
  hand.write_text(text.replace(' inheritrange="1"', ""))
  env, state = build(REORIENT, robot__mjcf=str(hand)), recorded(REORIENT)
  moved = env.action_to_ctrl(state, jnp.full(16, 0.1)) - state.data.ctrl
  np.testing.assert_allclose(moved, 0.1 * env.config.action_scale, rtol=1e-5)


@pytest.mark.parametrize("name", TASKS)
def test_a_cube_that_falls_ends_the_episode_and_costs(name: str) -> None:
  env, state = build(name), recorded(name)
  held, fallen = (step(env, sense(env, state, cube_position=[0.1, 0.0, z])) for z in (0.0, -0.06))
  assert (held.done, fallen.done, fallen.metrics["termination/cube_fell"]) == (0, 1, 1)
  assert (held.metrics["reward/is_terminated"], fallen.metrics["reward/is_terminated"]) == (0, -100)


@pytest.mark.parametrize("name", TASKS)
def test_starts(name: str) -> None:
  env = build(name)
  data = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 200)).data
  joints, cube = np.asarray(data.qpos[:, :16]), np.asarray(data.qpos[:, 16:])
  lower, upper = env.mj_model.jnt_range[:16].T
  assert (joints >= lower - 1e-6).all() and (joints <= upper + 1e-6).all() and (joints.std(axis=0) > 0.03).all()
  assert np.abs(cube[:, :3] - [0.1, 0.0, 0.05]).max() <= 0.01 + 1e-6 and np.ptp(cube[:, :3], axis=0).min() > 0.018
  np.testing.assert_allclose(np.linalg.norm(cube[:, 3:], axis=1), 1, rtol=1e-5)
  target = joints if name.startswith("Leap") else np.tile(env.mj_model.key("home").ctrl, (200, 1))
  np.testing.assert_allclose(data.ctrl, target, rtol=1e-6)
  goals = np.asarray(data.mocap_quat[:, 0])
  assert (goals.std(axis=0) > 0.3).all() == (name == REORIENT)


def test_the_goal_is_a_mark_but_in_0_2_0() -> None:
  for env, collides in ((golden(REORIENT).env, True), (build(REORIENT), False)):
    model = env.mj_model
    geoms = model.geom_bodyid == model.body("goal").id
    assert (model.geom_contype[geoms] | model.geom_conaffinity[geoms]).any() == collides
    assert model.geom("cube").contype[0] == 1


def test_limits_on_torques_can_be_lifted() -> None:
  limited, free = build(REORIENT).mj_model, build(REORIENT, torque_limits=False).mj_model
  np.testing.assert_allclose(limited.jnt_actfrcrange[:16], np.tile([-0.2196, 0.2196], (16, 1)))
  assert limited.jnt_actfrclimited[:16].all() and not free.jnt_actfrclimited.any()


def test_a_reward_of_another_family_may_read_fields_that_the_hand_does_not_keep() -> None:
  plain, added = build(REORIENT), build(REORIENT, rewards__joint_acc_l2__weight=-1e-6)
  assert set(added.derived) - set(plain.derived) == {"qacc"}
