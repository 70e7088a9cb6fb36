"""The joystick task on two legs: gait, pushes, starts and endings, on recorded states and without compiling physics."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground import registry
from playground.config import compose
from playground.envs.base import State
from playground.envs.task import InitialState
from playground.errors import ConfigError
from playground.robots.scene import find_mjcf
from tests.envs.golden import load_task, recorded

G1, T1, APOLLO = "G1JoystickFlatTerrain", "T1JoystickFlatTerrain", "ApolloJoystickFlatTerrain"
BERKELEY = "BerkeleyHumanoidJoystickFlatTerrain"


@pytest.fixture(scope="module")
def g1() -> Any:
  return load_task(G1)


@pytest.fixture(scope="module")
def t1() -> Any:
  return load_task(T1)


def evaluate(env: Any, state: State, **data: Any) -> State:
  return env.post_step(state.data.replace(**data), state.info, jnp.zeros(env.action_size))


def test_the_phase_is_observed_and_goes_on(t1: Any) -> None:
  state = recorded(T1)
  after = evaluate(t1, state)
  seen = after.obs["state"][-4:]  # pyright: ignore[reportArgumentType, reportCallIssue]
  phase = state.info["phase"]
  np.testing.assert_allclose(seen, jnp.concatenate([jnp.cos(phase), jnp.sin(phase)]), atol=1e-6)
  np.testing.assert_allclose(after.info["phase"] - phase, state.info["phase_dt"], rtol=1e-5)


def test_feet_rest_when_told_to_stand_still(t1: Any) -> None:
  after = evaluate(t1, recorded(T1, command=jnp.zeros(3)))
  assert (after.info["phase"] == np.float32(np.pi)).all()
  walking = evaluate(t1, after.replace(info=after.info | {"command": jnp.ones(3)}))
  np.testing.assert_allclose(jnp.diff(walking.info["phase"]) % (2 * np.pi), np.pi, rtol=1e-5)


def test_a_push_changes_the_velocity_at_once(g1: Any) -> None:
  due = recorded(G1, push_step=jnp.array(9), push_interval_steps=jnp.array(10))
  after = g1.pre_step(due)
  gained = after.data.qvel - due.data.qvel
  assert 0.1 <= jnp.linalg.norm(gained) <= 2.0 and not gained[2:].any()
  np.testing.assert_allclose(gained[:2] / jnp.linalg.norm(gained), after.info["push"], rtol=1e-4)
  early = recorded(G1, push_step=jnp.array(8), push_interval_steps=jnp.array(10))
  np.testing.assert_array_equal(g1.pre_step(early).data.qvel, early.data.qvel)


def test_feet_that_touch_each_other_end_the_episode(g1: Any) -> None:
  state = recorded(G1)
  assert evaluate(g1, state).done == 0
  address = g1.mj_model.sensor("right_foot_left_foot_found").adr[0]
  after = evaluate(g1, state, sensordata=state.data.sensordata.at[address].set(1.0))
  assert after.done == 1
  assert after.metrics["reward/is_terminated"] == -100
  np.testing.assert_allclose(after.reward, -2, atol=0.2)  # not clipped


def test_starts_stay_within_the_joints_limits(t1: Any) -> None:
  initial = InitialState(t1.robot.init_qpos, jnp.zeros(t1.mj_model.nv))
  keys = jax.random.split(jax.random.PRNGKey(0), 200)
  qpos = jax.jit(jax.vmap(lambda key: t1.events.start(key, t1, initial).qpos))(keys)
  lower, upper = t1.robot.joint_range
  assert ((qpos[:, 7:] >= lower) & (qpos[:, 7:] <= upper)).all()
  assert len(np.unique(qpos[:, 10])) > 100


@pytest.mark.parametrize(("task", "at_zero"), [(APOLLO, False), (f"v020/{APOLLO}", True)])
def test_apollo_starts_with_its_targets_where_its_joints_are(
  task: str, at_zero: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
  env = load_task(task)
  monkeypatch.setattr(env.physics, "forward", lambda model, data: data)
  data = env.reset(jax.random.PRNGKey(0)).data
  np.testing.assert_array_equal(data.ctrl, np.zeros(32) if at_zero else data.qpos[7:])


def test_noise_has_an_amplitude_for_each_joint() -> None:
  env = load_task(BERKELEY)
  state = recorded(BERKELEY)
  c = env.context(env, state.data, state.info, jnp.zeros(12))
  obs = jax.jit(jax.vmap(lambda key: env.observations.compute(c, key)[0]["state"]))
  joints = slice(12, 24)  # after velocity, gyro, gravity and command
  seen = obs(jax.random.split(jax.random.PRNGKey(0), 500))[:, joints]
  error = jnp.abs(seen - (state.data.qpos[7:] - env.robot.default_pose)).max(0)
  np.testing.assert_allclose(error, 2 * [0.03, 0.03, 0.03, 0.05, 0.08, 0.03], rtol=0.03)


@pytest.mark.parametrize("unit", ["radian", "degree"])  # of the MJCF's angles
def test_restricted_joint_range(unit: str, tmp_path: Path) -> None:
  robot = tmp_path / "robot.xml"
  robot.write_text(find_mjcf("g1").read_text().replace('angle="radian"', f'angle="{unit}"'))
  model = load_task(G1, {"restricted_joint_range": True, "robot.mjcf": str(robot)}).mj_model
  np.testing.assert_allclose(model.joint("left_hip_yaw_joint").range, [-0.7, 0.7])
  np.testing.assert_allclose(model.actuator("left_hip_yaw_joint").ctrlrange, [-0.7, 0.7])
  with pytest.raises(ConfigError, match="robot=t1 has no restricted_range"):
    load_task(T1, {"restricted_joint_range": True})


@pytest.mark.parametrize(("env", "size"), [("joystick", 81), ("biped_joystick", 85)])
def test_any_biped_can_be_named(env: str, size: int) -> None:
  task = registry.build(compose([f"env={env}", "robot=t1"]).env)
  assert isinstance(task.observation_size, dict)
  assert task.observation_size["state"] == (size,)
