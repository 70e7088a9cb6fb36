"""Noise on a tracked pose, and poses that are plainly wrong."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from playground.mdp.pose_noise import sensed_pose
from playground.mdp.rotations import angle_between, uniform_quat

POSE = jnp.array([0.1, -0.2, 0.3]), uniform_quat(jax.random.PRNGKey(3))
KEYS = jax.random.split(jax.random.PRNGKey(0), 1000)


def errors(level: float = 1.0, **config: float) -> tuple[np.ndarray, np.ndarray]:
  """Errors of position, m [1000, 3], and of orientation, rad [1000]."""
  settings: Any = SimpleNamespace(**{"pos": 0.02, "angle": 0.1, "injection": 0.0} | config)

  def draw(key: jax.Array) -> tuple[jax.Array, jax.Array]:
    pos, quat = sensed_pose(key, POSE, settings, level)
    return pos - POSE[0], angle_between(quat, POSE[1])

  pos, angle = jax.vmap(draw)(KEYS)
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
