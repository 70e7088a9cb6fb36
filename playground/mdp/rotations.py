"""Rotations as unit quaternions (w, x, y, z): drawing them, and the angle between two."""

import jax
import jax.numpy as jnp
from mujoco.mjx._src.math import axis_angle_to_quat, norm, normalize, quat_inv, quat_mul, quat_to_mat


def uniform_quat(key: jax.Array) -> jax.Array:
  """An orientation, all equally likely, shape [4] (Shoemake 1992)."""
  u, v, w = jax.random.uniform(key, (3,))
  v, w = 2 * jnp.pi * v, 2 * jnp.pi * w
  inner, outer = jnp.sqrt(1 - u), jnp.sqrt(u)
  return jnp.array([inner * jnp.sin(v), inner * jnp.cos(v), outer * jnp.sin(w), outer * jnp.cos(w)])


def turn_at_random(key: jax.Array, quat: jax.Array, max_angle: float | jax.Array) -> jax.Array:
  """`quat` [4] turned about an axis in any direction by an angle that is uniform in [0, `max_angle`) rad."""
  axis_key, angle_key = jax.random.split(key)
  axis = normalize(jax.random.normal(axis_key, (3,)))
  return quat_mul(axis_angle_to_quat(axis, jax.random.uniform(angle_key) * max_angle), quat)


def angle_between(quat: jax.Array, goal: jax.Array) -> jax.Array:
  """The smallest angle that turns `quat` into `goal`, rad in [0, pi], shape []."""
  difference = normalize(quat_mul(quat, quat_inv(goal)))
  return 2 * jnp.arcsin(jnp.minimum(norm(difference[1:]), 1.0))


def two_rows(quat: jax.Array) -> jax.Array:
  """The last two rows of the rotation matrix, shape [6]: an orientation without the quaternion's double cover."""
  return quat_to_mat(quat).ravel()[3:]
