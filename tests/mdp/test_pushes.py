"""Kicks and jumps: when they come, how long they last and what they add up to."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from ml_collections import ConfigDict

from playground.errors import UnknownNameError
from playground.mdp.pushes import Jumps, advance_kick, kick_force, make_pushes, sample_kicks

MASS = jnp.array(12.0)
CONFIG = ConfigDict({"velocity": [1.0, 3.0], "duration": [0.05, 0.2], "interval": [0.5, 0.9]})


def roll(dt: float, steps: int) -> tuple[dict[str, Any], np.ndarray]:
  """The first `info` and the forces of all steps, shape [steps, 3]."""
  keys = jax.random.split(jax.random.PRNGKey(3), 4)
  info = {"rng": keys[3], **sample_kicks(keys[:3], CONFIG, dt)}

  def step(info: dict[str, Any], _: None) -> tuple[dict[str, Any], jax.Array]:
    force, changed = advance_kick(info, MASS, dt)
    return info | changed, force

  return info, np.asarray(jax.jit(lambda i: jax.lax.scan(step, i, None, steps))(info)[1])


def test_draws_lie_in_their_ranges() -> None:
  keys = jax.random.split(jax.random.PRNGKey(0), (1000, 3))
  info = jax.vmap(lambda k: sample_kicks(k, CONFIG, 0.02))(keys)
  assert info["steps_until_next_pert"].min() >= 25 and info["steps_until_next_pert"].max() <= 45
  assert info["pert_duration_seconds"].min() >= 0.05 and info["pert_duration_seconds"].max() <= 0.2
  np.testing.assert_allclose(info["pert_mag"].mean(), 2.0, atol=0.1)
  np.testing.assert_allclose(info["pert_duration"] * 0.02, info["pert_duration_seconds"], atol=0.0101)


def test_force_integrates_to_mass_times_velocity_over_pi() -> None:
  time = jnp.linspace(0, 0.15, 1001)
  impulse = kick_force(time, MASS, jnp.array(2.0), jnp.array(0.15)).mean() * 0.15
  np.testing.assert_allclose(impulse, 12.0 * 2.0 / np.pi, rtol=1e-2)


@pytest.mark.parametrize("dt", [0.001, 0.02])
def test_kicks_in_time(dt: float) -> None:
  info, forces = roll(dt, round(1.5 / dt))
  wait, duration = int(info["steps_until_next_pert"]), int(info["pert_duration"])
  assert not forces[: wait + 1].any()  # a kick starts from a force of 0
  kick = forces[wait : wait + duration + 1]
  assert not forces[wait + duration + 1 : 2 * wait + duration + 1].any()  # then the interval runs again
  assert not forces[:, 2].any()
  expected = kick_force(jnp.arange(duration + 1) * dt, MASS, info["pert_mag"], info["pert_duration_seconds"])
  np.testing.assert_allclose(np.linalg.norm(kick, axis=1), np.abs(expected), rtol=1e-3, atol=1e-3)
  if dt < 0.01:  # a coarse step samples a short half sine coarsely
    impulse = np.linalg.norm(kick.sum(0)) * dt
    np.testing.assert_allclose(impulse, 12.0 * float(info["pert_mag"]) / np.pi, rtol=0.01)


def test_each_kick_has_its_own_direction() -> None:
  _, forces = roll(0.02, 400)
  strong = forces[np.linalg.norm(forces, axis=1) > 1]
  directions = np.unique(np.round(np.arctan2(strong[:, 1], strong[:, 0]) % np.pi, 3))
  assert len(directions) > 5


class Pushed(struct.PyTreeNode):
  """The part of the physics that a kick changes."""

  xfrc_applied: jax.Array


class Body(struct.PyTreeNode):
  """The part of the physics that a jump changes."""

  qvel: jax.Array


def jumps(enable: bool) -> tuple[int, np.ndarray, np.ndarray]:
  """The interval, the directions shown and what they add to the velocity in 100 steps."""
  pushes = Jumps(enable, velocity=(0.5, 1.0), interval=(0.5, 0.9), dt=0.02)
  info = {"rng": jax.random.PRNGKey(1), **pushes.start({"push_interval": jax.random.PRNGKey(0)}, MASS)}

  def step(info: dict[str, Any], _: None) -> tuple[dict[str, Any], Any]:
    body: Any = Body(jnp.zeros(6))
    body, changed = pushes.act(body, info)
    return info | changed, (changed["push"], body.qvel)

  directions, gained = jax.jit(lambda i: jax.lax.scan(step, i, None, 100))(info)[1]
  return int(info["push_interval_steps"]), np.asarray(directions), np.asarray(gained)


def test_jumps_in_time() -> None:
  interval, directions, gained = jumps(enable=True)
  assert 25 <= interval <= 45
  (steps,) = np.nonzero(directions.any(1))
  assert steps.tolist() == [i * interval - 1 for i in range(1, 100 // interval + 1)]
  speeds = np.linalg.norm(gained[steps, :2], axis=1)
  assert (speeds >= 0.5).all() and (speeds <= 1.0).all() and len(np.unique(speeds)) > 1
  np.testing.assert_allclose(gained[steps, :2], speeds[:, None] * directions[steps], rtol=1e-5)
  assert not np.delete(gained, steps, axis=0).any() and not gained[:, 2:].any()


def test_no_jumps_unless_enabled() -> None:
  _, directions, gained = jumps(enable=False)
  assert not directions.any() and not gained.any()


def test_regular_kicks_in_time() -> None:
  config = {"enable": True, "velocity": [2.0, 2.0], "duration": [0.08, 0.1], "interval": [0.4, 0.6]}
  pushes = make_pushes(ConfigDict({"kind": "regular_kick", **config}), root=1, dt=0.02)
  keys = dict(zip(pushes.keys, jax.random.split(jax.random.PRNGKey(0), 3), strict=True))
  info = {"rng": jax.random.PRNGKey(1), **pushes.start(keys, MASS)}

  def step(info: dict[str, Any], _: None) -> tuple[dict[str, Any], Any]:
    body: Any = Pushed(jnp.zeros((2, 6)))
    body, changed = pushes.act(body, info)
    return info | changed, body.xfrc_applied

  forces = np.asarray(jax.jit(lambda i: jax.lax.scan(step, i, None, 100))(info)[1])
  interval, duration = int(info["pert_interval"]), int(info["pert_duration"])
  assert 20 <= interval < 30 and duration == 4
  assert not forces[:, 0].any() and not forces[:, 1, 2:].any()
  since = np.arange(100) % interval
  kicked = (np.arange(100) >= interval) & (since < duration)
  expected = np.where(kicked, 0.5 * np.sin(np.pi * since / duration) * 12.0 * 2.0 / (duration * 0.02), 0.0)
  np.testing.assert_allclose(np.linalg.norm(forces[:, 1], axis=1), expected, rtol=1e-4, atol=1e-3)
  angles = [np.arctan2(*forces[i * interval + 1, 1, :2]) for i in (1, 2, 3)]
  assert len(np.unique(np.round(angles, 3))) == 3


def test_unknown_kind() -> None:
  with pytest.raises(UnknownNameError, match=r"env\.pushes\.kind: 'kik' is unknown.*Did you mean 'kick'"):
    make_pushes(ConfigDict({"kind": "kik", "enable": True, **CONFIG}), root=1, dt=0.02)
