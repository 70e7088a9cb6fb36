"""Directions, orientations as unit quaternions (w, x, y, z), and noise on the pose that a camera gives of an object."""

from typing import Any

import jax
import jax.numpy as jnp
from mujoco.mjx._src.math import axis_angle_to_quat, norm, normalize, quat_inv, quat_mul, quat_to_mat

Pose = tuple[jax.Array, jax.Array]  # position m [3], orientation [4]

_INJECTED_REACH = 0.5  # m


def horizontal(key: jax.Array) -> jax.Array:
  """Draws a horizontal unit vector, shape [3]."""
  angle = jax.random.uniform(key, maxval=2 * jnp.pi)
  return jnp.array([jnp.cos(angle), jnp.sin(angle), 0.0])


def uniform_quat(key: jax.Array) -> jax.Array:
  """Draws an orientation, all equally likely, shape [4] (Shoemake 1992)."""
  u, v, w = jax.random.uniform(key, (3,))
  v, w = 2 * jnp.pi * v, 2 * jnp.pi * w
  inner, outer = jnp.sqrt(1 - u), jnp.sqrt(u)
  return jnp.array([inner * jnp.sin(v), inner * jnp.cos(v), outer * jnp.sin(w), outer * jnp.cos(w)])


def turn_at_random(key: jax.Array, quat: jax.Array, max_angle: float | jax.Array) -> jax.Array:
  """Turns `quat` [4] about an axis in any direction by an angle U[0, `max_angle`) rad."""
  axis_key, angle_key = jax.random.split(key)
  axis = normalize(jax.random.normal(axis_key, (3,)))
  return quat_mul(axis_angle_to_quat(axis, jax.random.uniform(angle_key) * max_angle), quat)


def angle_between(quat: jax.Array, goal: jax.Array) -> jax.Array:
  """Returns the smallest angle that turns `quat` into `goal`, rad in [0, pi], shape []."""
  difference = normalize(quat_mul(quat, quat_inv(goal)))
  return 2 * jnp.arcsin(jnp.minimum(norm(difference[1:]), 1.0))


def two_rows(quat: jax.Array) -> jax.Array:
  """Returns the last two rows of the rotation matrix, shape [6]: without the double cover of a quaternion."""
  return quat_to_mat(quat).ravel()[3:]


def sensed_pose(key: jax.Array, pose: Pose, config: Any, level: float) -> Pose:
  """Returns a tracker's reading of a pose (paper, Appendix C.4); `level` is a factor on all three.

  `config` has `pos` (m, uniform in +- on each axis), `angle` (rad, largest turn, about a random axis) and `injection`:
  with this probability the reading has nothing to do with the pose: within +- 0.5 m, in any orientation.
  """
  pos_key, quat_key, wrong_key, wrong_pos_key, wrong_quat_key = jax.random.split(key, 5)
  offset = jax.random.uniform(pos_key, (3,), minval=-1.0, maxval=1.0)
  pos, quat = pose[0] + level * config.pos * offset, turn_at_random(quat_key, pose[1], level * config.angle)
  wrong = jax.random.bernoulli(wrong_key, jnp.minimum(level * config.injection, 1.0))
  wrong_pos = jax.random.uniform(wrong_pos_key, (3,), minval=-_INJECTED_REACH, maxval=_INJECTED_REACH)
  return jnp.where(wrong, wrong_pos, pos), jnp.where(wrong, uniform_quat(wrong_quat_key), quat)
