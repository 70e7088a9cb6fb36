"""What sensors and trackers read of a robot that handles an object."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from mujoco.mjx._src.math import axis_angle_to_quat, quat_mul, quat_to_mat

from playground.mdp.noise import uniform_noise
from playground.mdp.rotations import turn_at_random


class Readings(NamedTuple):
  """Readings, or what there is to read: rad, rad/s, m; axes are the columns of a rotation matrix [3, 3]."""

  joint_pos: jax.Array
  joint_vel: jax.Array
  gripper_pos: jax.Array
  gripper_axes: jax.Array
  box_pos: jax.Array
  box_quat: jax.Array


def sensed(rng: jax.Array, true: Readings, noise: Any, parity: bool) -> tuple[jax.Array, Readings]:
  """Adds noise to what there is to read.

  Args:
    rng: random key.
    true: what there is.
    noise: `level`, a factor on all others; `joint_pos`, `joint_vel`, `gripper_pos` and `box_pos`: uniform in +- on each
      number; `gripper_angle` and `box_angle` rad: the largest turn about a random axis.
    parity: as Playground 0.2.0: the first three are one number from 0 on for all of the channel's, the axes' angles are
      normally distributed, and the gripper's turn is in proportion to the joint angles' noise.

  Returns:
    The next random key, and the readings.
  """
  rng, box_angle_key, box_turn_key, box_pos_key = jax.random.split(rng, 4)
  rng, pos_key, vel_key, gripper_key, turn_key = jax.random.split(rng, 5)
  level = noise.level
  box_pos = uniform_noise(box_pos_key, true.box_pos, level * noise.box_pos)
  if parity:
    one_of = lambda key, scale: level * scale * jax.random.uniform(key)
    turn = axis_angle_to_quat(_direction(turn_key), one_of(pos_key, noise.gripper_angle))
    box_turn = axis_angle_to_quat(_direction(box_turn_key), one_of(box_angle_key, noise.box_angle))
    joint_pos = true.joint_pos + one_of(pos_key, noise.joint_pos)
    joint_vel = true.joint_vel + one_of(vel_key, noise.joint_vel)
    gripper_pos = true.gripper_pos + one_of(gripper_key, noise.gripper_pos)
  else:
    nothing = jnp.array([1.0, 0.0, 0.0, 0.0])
    turn = turn_at_random(turn_key, nothing, level * noise.gripper_angle)
    box_turn = turn_at_random(box_turn_key, nothing, level * noise.box_angle)
    joint_pos = uniform_noise(pos_key, true.joint_pos, level * noise.joint_pos)
    joint_vel = uniform_noise(vel_key, true.joint_vel, level * noise.joint_vel)
    gripper_pos = uniform_noise(gripper_key, true.gripper_pos, level * noise.gripper_pos)
  axes = quat_to_mat(turn) @ true.gripper_axes
  return rng, Readings(joint_pos, joint_vel, gripper_pos, axes, box_pos, quat_mul(box_turn, true.box_quat))


def _direction(key: jax.Array) -> jax.Array:
  """0.2.0's direction: a unit vector [3] whose two angles are normally distributed."""
  around_key, down_key = jax.random.split(key)
  around, down = 2 * jnp.pi * jax.random.normal(around_key), jnp.pi * jax.random.normal(down_key)
  return jnp.array([jnp.sin(down) * jnp.cos(around), jnp.sin(down) * jnp.sin(around), jnp.cos(down)])
