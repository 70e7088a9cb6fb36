"""Hands with a cube as in Playground 0.2.0."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from mujoco.mjx._src.math import normalize

from playground.compat020.arms import NoForward
from playground.envs.manipulation import reorient, rotate
from playground.envs.manipulation.in_hand import HandTask
from playground.mdp import events
from playground.mdp.poses import Pose, sensed_pose, uniform_quat


class _HandTask(NoForward, HandTask):
  """The goal is a cube that collides."""

  def scene(self, config: Any) -> mujoco.MjSpec:
    spec = super().scene(config)
    block = spec.body("goal").geoms[-1]
    block.contype = block.conaffinity = 1
    return spec


class RotateZ(_HandTask, rotate.RotateZ):
  """Rotation about the vertical."""


class Reorient(_HandTask, reorient.Reorient):
  """Reorientation; noise of `pose_noise.angle` is on each entry of the quaternion, about three times the angle."""

  def sense_cube(self, info: Mapping[str, Any], pose: Pose) -> Pose:
    if not self.pose_noise:
      return pose
    noise, level = self.pose_noise, self.config.noise_level
    pos, _ = sensed_pose(info["pose_key"], pose, noise, level)
    _, quat_key, wrong_key, _, wrong_quat_key = jax.random.split(info["pose_key"], 5)
    quat = normalize(pose[1] + level * noise.angle * jax.random.normal(quat_key, (4,)))
    wrong = level * jax.random.bernoulli(wrong_key, noise.injection)
    return pos, quat * (1 - wrong) + uniform_quat(wrong_quat_key) * wrong


@dataclasses.dataclass
class PushObjectByWrench(events.PushObjectByWrench):
  """Forces and torques whose strengths come from one draw."""

  def strength(self, key: jax.Array) -> jax.Array:
    ranges = (self.velocity, self.angular_velocity)
    return jnp.repeat(jnp.array([jax.random.uniform(key, minval=low, maxval=high) for low, high in ranges]), 3)
