"""Orientations: drawn, turned, compared; noise on a tracked pose, and poses that are plainly wrong."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mujoco.mjx._src.math import axis_angle_to_quat, quat_mul, quat_to_mat

from playground.mdp.poses import angle_between, sensed_pose, turn_at_random, two_rows, uniform_quat

KEYS = jax.random.split(jax.random.PRNGKey(0), 2000)


def test_orientations_are_uniform() -> None:
  quats = jax.vmap(uniform_quat)(KEYS)
  np.testing.assert_allclose(jnp.linalg.norm(quats, axis=1), 1, rtol=1e-5)
  axes = jax.vmap(quat_to_mat)(quats)
  np.testing.assert_allclose(axes.mean(axis=0), np.zeros((3, 3)), atol=4 / np.sqrt(3 * len(KEYS)))
  # Uniform rotations: the angle has the density (1 - cos) / pi, with mean pi / 2 + 2 / pi.
  angles = jax.vmap(lambda q: angle_between(q, jnp.array([1.0, 0.0, 0.0, 0.0])))(quats)
  assert abs(angles.mean() - (np.pi / 2 + 2 / np.pi)) < 0.06


@pytest.mark.parametrize("angle", [0.0, 0.1, 1.5, 3.1, -2.0])
@pytest.mark.parametrize("sign", [1, -1])
def test_angle_between(angle: float, sign: int) -> None:
  quat = uniform_quat(KEYS[0])
  turned = quat_mul(axis_angle_to_quat(jnp.array([0.6, 0.0, 0.8]), jnp.array(angle)), quat)
  assert float(angle_between(sign * turned, quat)) == pytest.approx(abs(angle), abs=2e-3)


def test_a_turn_is_as_large_as_asked_and_about_any_axis() -> None:
  quat = uniform_quat(KEYS[1])
  turned = jax.vmap(lambda key: turn_at_random(key, quat, 0.3))(KEYS)
  angles = np.asarray(jax.vmap(lambda q: angle_between(q, quat))(turned))
  assert angles.max() <= 0.3 + 1e-3 and abs(angles.mean() - 0.15) < 0.01
  inverse = quat * jnp.array([1, -1, -1, -1])
  axes = jax.vmap(lambda q: quat_mul(q, inverse)[1:])(turned)
  np.testing.assert_allclose(axes.mean(axis=0) / np.abs(axes).mean(), np.zeros(3), atol=0.1)


def test_two_rows_do_not_depend_on_the_quaternions_sign() -> None:
  quat = uniform_quat(KEYS[2])
  np.testing.assert_allclose(two_rows(quat), two_rows(-quat), atol=1e-6)
  np.testing.assert_allclose(two_rows(quat), quat_to_mat(quat)[1:].ravel(), atol=1e-6)


# A tracked pose

POSE = jnp.array([0.1, -0.2, 0.3]), uniform_quat(jax.random.PRNGKey(3))
READINGS = jax.random.split(jax.random.PRNGKey(0), 1000)


def errors(level: float = 1.0, **config: float) -> tuple[np.ndarray, np.ndarray]:
  """Errors of position, m [1000, 3], and of orientation, rad [1000]."""
  settings: Any = SimpleNamespace(**{"pos": 0.02, "angle": 0.1, "injection": 0.0} | config)

  def draw(key: jax.Array) -> tuple[jax.Array, jax.Array]:
    pos, quat = sensed_pose(key, POSE, settings, level)
    return pos - POSE[0], angle_between(quat, POSE[1])

  pos, angle = jax.vmap(draw)(READINGS)
  return np.asarray(pos), np.asarray(angle)


def test_errors_stay_within_what_is_asked_and_fill_it() -> None:
  pos, angle = errors()
  assert np.abs(pos).max() <= 0.02 + 1e-6 and np.abs(pos).max(axis=0).min() > 0.019
  assert angle.max() <= 0.1 + 1e-3 and angle.max() > 0.095
  assert np.abs(np.corrcoef(pos.T) - np.eye(3)).max() < 0.15


def test_without_noise_a_pose_is_exact() -> None:
  pos, angle = errors(level=0.0, injection=1.0)
  assert np.abs(pos).max() < 1e-7 and angle.max() < 2e-3


def test_some_poses_are_plainly_wrong() -> None:
  pos, angle = errors(injection=0.3)
  wrong = np.abs(pos).max(axis=1) > 0.02 + 1e-6
  assert abs(wrong.mean() - 0.3) < 0.06
  assert angle[~wrong].max() <= 0.1 + 1e-3
  assert angle[wrong].mean() > 1.8
  assert np.abs(pos + POSE[0])[wrong].max() <= 0.5
  pos, angle = errors(level=0.5, injection=0.3)
  wrong = np.abs(pos).max(axis=1) > 0.01 + 1e-6
  assert abs(wrong.mean() - 0.15) < 0.04 and angle[wrong].mean() > 1.8 and angle[~wrong].max() <= 0.05 + 1e-3
