"""Events: where episodes start, and pushes: when they come, how long they last and what they add up to."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from flax import struct

from playground.envs.task import InitialState
from playground.errors import ConfigError
from playground.mdp import events
from playground.mdp.events import PushByForce, PushByForceRegularly, PushBySettingVelocity, PushObjectByWrench
from playground.mdp.terms import bind

KEYS = jax.random.split(jax.random.PRNGKey(0), 2000)
MASS = 12.0
MODEL: Any = SimpleNamespace(body_mass=jnp.array([0.0, 0.1]))
LOWER, UPPER = np.array([-0.1, -1.0]), np.array([0.4, 1.0])
KEYFRAME = jnp.array([9.0, 9.0, 0.2, 0.0, 1.0, 0.0, 0.0, 0.3, -0.3])


def env(dt: float = 0.02) -> Any:
  """A robot with a free root and two joints, and the cube of a hand."""
  robot = SimpleNamespace(
    qpos=slice(7, None), joint_range=jnp.array([LOWER, UPPER]), root=1, mass=lambda model: jnp.array(MASS),
    keyframe=lambda name: {"crouch": KEYFRAME}[name], cube=1, cube_qpos=slice(0, 7), ground_peak=0.25,
  )  # fmt: skip
  return SimpleNamespace(dt=dt, robot=robot, mj_model=SimpleNamespace(njnt=3, jnt_type=[mujoco.mjtJoint.mjJNT_FREE]))


# Starts

BOUNDS = {"low": [0.0, 0.0, 2.0], "high": [1.0, 1.0, 1.0]}

START = InitialState(jnp.array([1.0, 2.0, 0.3, 0.8, 0.0, 0.6, 0.0, 0.2, -0.5]), jnp.full(8, 7.0))


def starts(name: str, **params: Any) -> tuple[np.ndarray, np.ndarray]:
  """qpos and qvel of many episodes."""
  event = getattr(events, name)
  initial = jax.jit(jax.vmap(lambda key: event(key, env(), START, **params)))(KEYS)
  return np.asarray(initial.qpos), np.asarray(initial.qvel)


def changed(qpos: np.ndarray) -> list[int]:
  return np.flatnonzero((qpos != np.asarray(START.qpos)).any(0)).tolist()


def test_the_root_is_shifted_within_a_square() -> None:
  qpos, qvel = starts("reset_root_xy", distance=0.5)
  np.testing.assert_allclose([qpos[:, :2].min(0), qpos[:, :2].max(0)], [[0.5, 1.5], [1.5, 2.5]], atol=0.01)
  assert changed(qpos) == [0, 1] and (qvel == 7).all()


def test_the_root_is_turned_about_the_vertical() -> None:
  qpos, _ = starts("reset_root_yaw", angle=1.0)
  w, x, y, z = qpos[:, 3:7].T
  np.testing.assert_allclose(np.linalg.norm(qpos[:, 3:7], axis=1), 1, rtol=1e-5)
  np.testing.assert_allclose(1 - 2 * (x**2 + y**2), 1 - 2 * 0.6**2, rtol=1e-5)  # its tilt is the same
  yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
  np.testing.assert_allclose([yaw.min(), yaw.max()], [-1, 1], atol=0.01)
  assert set(changed(qpos)) <= {3, 4, 5, 6}


def test_the_root_is_given_a_velocity() -> None:
  qpos, qvel = starts("reset_root_velocity", speed=0.5)
  np.testing.assert_allclose([qvel[:, :6].min(0), qvel[:, :6].max(0)], [[-0.5] * 6, [0.5] * 6], atol=0.01)
  assert (qvel[:, 6:] == 7).all() and changed(qpos) == []


@pytest.mark.parametrize(
  ("name", "params"), [("reset_joints_by_scale", {"scale": [0.5, 4.0]}), ("reset_joints_gaussian", {"std": 1.0})]
)
def test_joints_are_spread_within_their_limits(name: str, params: Any) -> None:
  qpos, _ = starts(name, **params)
  assert changed(qpos) == [7, 8]
  np.testing.assert_allclose([qpos[:, 7].max(), qpos[:, 8].min()], [0.4, -1.0])
  assert (qpos[:, 7:] >= LOWER - 1e-6).all() and (qpos[:, 7:] <= UPPER + 1e-6).all()
  assert len(np.unique(qpos[:, 8])) > 500


def test_some_robots_fall_turned_anyhow_with_any_joint_angles() -> None:
  qpos, _ = starts("reset_fallen", probability=0.6, height=0.5)
  fallen = qpos[:, 2] == 0.25 + 0.5  # above the ground
  assert abs(fallen.mean() - 0.6) < 0.05
  assert changed(qpos[~fallen]) == []
  dropped = qpos[fallen]
  assert (dropped[:, :2] == START.qpos[:2]).all()
  np.testing.assert_allclose(np.linalg.norm(dropped[:, 3:7], axis=1), 1, rtol=1e-4)
  up = 1 - 2 * (dropped[:, 4] ** 2 + dropped[:, 5] ** 2)  # uniform in [-1, 1] for uniform rotations
  assert abs(up.mean()) < 0.07 and up.min() < -0.9 and up.max() > 0.9
  share = (dropped[:, 7:] - LOWER) / (UPPER - LOWER)
  assert share.min() >= 0 and share.max() <= 1
  np.testing.assert_allclose(share.mean(axis=0), 0.5, atol=0.04)


def test_some_episodes_start_in_a_keyframe_at_rest_where_the_root_is() -> None:
  qpos, qvel = starts("reset_to_keyframe", probability=0.3, keyframe="crouch")
  crouched = qpos[:, 2] == KEYFRAME[2]
  assert abs(crouched.mean() - 0.3) < 0.05
  np.testing.assert_array_equal(np.unique(qpos[crouched], axis=0), [[1, 2, *np.asarray(KEYFRAME)[2:]]])
  assert not qvel[crouched].any() and (qvel[~crouched] == 7).all() and changed(qpos[~crouched]) == []


def test_a_cube_lies_anyhow_about_a_place() -> None:
  qpos, _ = starts("reset_cube_pose", pos=[0.1, 0.0, 0.05], spread=0.01)
  low, high = [0.09, -0.01, 0.04], [0.11, 0.01, 0.06]
  np.testing.assert_allclose([qpos[:, :3].min(0), qpos[:, :3].max(0)], [low, high], atol=1e-3)
  np.testing.assert_allclose(np.linalg.norm(qpos[:, 3:7], axis=1), 1, rtol=1e-4)
  np.testing.assert_allclose(qpos[:, 3:7].mean(0), 0, atol=0.06)


def test_bounds_of_a_start_that_cannot_be_name_their_event() -> None:
  (term,) = bind("events", {"mine": {"func": "reset_goal_uniform", "mode": "reset", "params": BOUNDS}})
  message = r"^env\.events\.mine: low=\[0\.0, 0\.0, 2\.0\] and high=\[1\.0, 1\.0, 1\.0\] must be 3 numbers each"
  with pytest.raises(ConfigError, match=message):
    term(KEYS[0], env(), START)


@pytest.mark.parametrize(
  ("name", "params"),
  [
    ("reset_root_xy", {"distance": 1.0}),
    ("reset_root_yaw", {"angle": 1.0}),
    ("reset_root_velocity", {"speed": 1.0}),
    ("reset_fallen", {"probability": 1.0, "height": 0.5}),
  ],
)
def test_only_a_free_root_is_moved(name: str, params: dict[str, Any]) -> None:
  """On an arm or a hand these would move its first joints."""
  fixed = env()
  fixed.mj_model.jnt_type = [mujoco.mjtJoint.mjJNT_HINGE]
  (term,) = bind("events", {"mine": {"func": name, "mode": "reset", "params": params}})
  with pytest.raises(ConfigError, match=r"^env\.events\.mine: it needs a free joint as the first of the model"):
    term(KEYS[0], fixed, START)


# Pushes


class Body(struct.PyTreeNode):
  """The part of the physics that pushes change."""

  qvel: jax.Array
  xfrc_applied: jax.Array


def roll(push: Any, steps: int, dt: float = 0.02) -> tuple[dict[str, Any], Body, Any]:
  """The first `info`, and forces, gains of velocity and `info` of all steps."""
  push.bind(env(dt))
  info = {"rng": jax.random.PRNGKey(1), **push.reset(jax.random.PRNGKey(0), MODEL)}

  def step(info: dict[str, Any], _: None) -> tuple[dict[str, Any], Any]:
    still: Any = Body(jnp.zeros(6), jnp.zeros((2, 6)))
    body, new = push.step(still, info)
    return info | new, (body, info | new)

  body, infos = jax.jit(lambda i: jax.lax.scan(step, i, None, steps))(info)[1]
  return info, jax.tree.map(np.asarray, body), jax.tree.map(np.asarray, infos)


BY_FORCE = PushByForce(velocity=(1.0, 3.0), duration_s=(0.05, 0.2), interval_s=(0.5, 0.9))


def test_strengths_and_times_of_pushes_lie_in_their_ranges() -> None:
  BY_FORCE.bind(env())
  info = jax.vmap(lambda key: BY_FORCE.reset(key, None))(KEYS)  # pyright: ignore[reportArgumentType]
  for name, low, high in (("interval", 25, 45), ("duration", 0.05, 0.2), ("velocity", 1, 3)):
    np.testing.assert_allclose([info[f"push_{name}"].min(), info[f"push_{name}"].max()], [low, high], rtol=0.02)
  assert (info["push_mass"] == MASS).all()


def test_a_force_integrates_to_mass_times_velocity_over_pi() -> None:
  time = jnp.linspace(0, 0.15, 1001)
  impulse = PushByForce.force(time, jnp.array(MASS), jnp.array(2.0), jnp.array(0.15)).mean() * 0.15
  np.testing.assert_allclose(impulse, MASS * 2.0 / np.pi, rtol=1e-2)


@pytest.mark.parametrize("dt", [0.001, 0.02])
def test_pushes_by_force_in_time(dt: float) -> None:
  info, body, infos = roll(BY_FORCE, round(1.5 / dt), dt)
  forces = body.xfrc_applied[:, 1, :3]
  wait, duration = int(info["push_interval"]), round(float(info["push_duration"]) / dt)
  assert not forces[: wait + 1].any()  # a push starts from a force of 0
  assert not forces[wait + duration + 1 : 2 * wait + duration + 1].any()  # then the interval runs again
  assert not body.xfrc_applied[:, 0].any() and not body.xfrc_applied[:, 1, 2:].any() and not body.qvel.any()
  push = forces[wait : wait + duration + 1]
  time = jnp.arange(duration + 1) * dt
  expected = PushByForce.force(time, jnp.array(MASS), info["push_velocity"], info["push_duration"])
  np.testing.assert_allclose(np.linalg.norm(push, axis=1), np.abs(expected), rtol=1e-3, atol=1e-3)
  assert infos["pushing"][: wait + duration + 2].tolist() == [False] * wait + [True] * (duration + 1) + [False]
  if dt < 0.01:  # a coarse step samples a short half sine coarsely
    impulse = np.linalg.norm(push.sum(0)) * dt
    np.testing.assert_allclose(impulse, MASS * float(info["push_velocity"]) / np.pi, rtol=0.01)


def test_each_push_has_its_own_direction() -> None:
  forces = roll(BY_FORCE, 400)[1].xfrc_applied[:, 1]
  strong = forces[np.linalg.norm(forces, axis=1) > 1]
  directions = np.unique(np.round(np.arctan2(strong[:, 1], strong[:, 0]) % np.pi, 3))
  assert len(directions) > 5


def test_regular_pushes_in_time() -> None:
  push = PushByForceRegularly(velocity=(2.0, 2.0), duration_s=(0.08, 0.1), interval_s=(0.4, 0.6))
  info, body, infos = roll(push, 100)
  forces = body.xfrc_applied
  interval, duration = int(info["push_interval"]), int(info["push_duration"])
  assert 20 <= interval < 30 and duration == 4
  assert not forces[:, 0].any() and not forces[:, 1, 2:].any()
  since = np.arange(100) % interval
  pushed = (np.arange(100) >= interval) & (since < duration)
  np.testing.assert_array_equal(infos["pushing"], pushed)
  expected = np.where(pushed, 0.5 * np.sin(np.pi * since / duration) * MASS * 2.0 / (duration * 0.02), 0.0)
  np.testing.assert_allclose(np.linalg.norm(forces[:, 1], axis=1), expected, rtol=1e-4, atol=1e-3)
  angles = [np.arctan2(*forces[i * interval + 1, 1, :2]) for i in (1, 2, 3)]
  assert len(np.unique(np.round(angles, 3))) == 3


def test_an_object_is_pushed_by_forces_and_torques() -> None:
  push = PushObjectByWrench((1.0, 1.0), (0.1, 0.1), (0.4, 0.4), angular_velocity=(10.0, 10.0))
  _, body, infos = roll(push, 30)
  middle = body.xfrc_applied[22, 1]  # 2 of 5 steps
  scale = 0.5 * np.sin(0.4 * np.pi) * 0.1 / 0.1
  np.testing.assert_allclose(middle, scale * np.repeat([1.0, 10.0], 3) * infos["push_direction"][22], rtol=1e-4)
  np.testing.assert_allclose(np.linalg.norm(infos["push_direction"][22]), 1, rtol=1e-5)


def test_pushes_are_a_control_step_apart_at_least() -> None:
  """With an interval of 0 steps a push would never start, so it would have no direction."""
  by_force = {"velocity": (1.0, 1.0), "duration_s": (0.1, 0.1), "interval_s": (0.0, 0.0)}
  _, body, infos = roll(PushByForce(**by_force), 50)
  assert (np.linalg.norm(body.xfrc_applied[:, 1], axis=1) > 1).sum() >= 25 and infos["pushing"].sum() == 42
  assert roll(PushByForceRegularly(**by_force), 50)[2]["push_direction"][1:].any(axis=1).all()
  assert roll(PushBySettingVelocity((1.0, 1.0), interval_s=(0.0, 0.0)), 50)[2]["pushing"].all()


def test_a_push_takes_time() -> None:
  push = {"func": "push_by_force", "mode": "interval", "params": {"velocity": [0, 1], "interval_s": [1, 2]}}
  with pytest.raises(ConfigError, match=r"params.duration_s=\[0, 0.1\] must be 2 numbers above 0 "):
    bind("events", {"push": push | {"params": push["params"] | {"duration_s": [0, 0.1]}}})


def test_velocities_jump_in_time() -> None:
  info, body, infos = roll(PushBySettingVelocity(velocity=(0.5, 1.0), interval_s=(0.5, 0.9)), 100)
  interval, directions, gained = int(info["push_interval_steps"]), infos["push"], body.qvel
  assert 25 <= interval <= 45
  (steps,) = np.nonzero(directions.any(1))
  assert steps.tolist() == [i * interval - 1 for i in range(1, 100 // interval + 1)]
  np.testing.assert_array_equal(infos["pushing"], directions.any(1))
  speeds = np.linalg.norm(gained[steps, :2], axis=1)
  assert (speeds >= 0.5).all() and (speeds <= 1.0).all() and len(np.unique(speeds)) > 1
  np.testing.assert_allclose(gained[steps, :2], speeds[:, None] * directions[steps], rtol=1e-5)
  assert not np.delete(gained, steps, axis=0).any() and not gained[:, 2:].any()
