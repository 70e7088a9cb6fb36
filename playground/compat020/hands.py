"""Hands with a cube as in Playground 0.2.0."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from mujoco.mjx._src.math import normalize

from playground.envs.manipulation import reorient, rotate
from playground.envs.manipulation.in_hand import HandTask
from playground.envs.task import InitialState
from playground.mdp import events
from playground.mdp.poses import Pose, sensed_pose
from playground.physics.backend import PhysicsData, mjx


class _HandTask(HandTask):
  """The goal is a cube that collides, a reset computes no kinematics, and `info` outlasts an auto-reset."""

  episode_info = ()

  def prepare_goal(self, goal: mujoco.MjsBody) -> None:
    del goal

  def start_physics(self, model: mjx.Model, initial: InitialState) -> PhysicsData:
    del model
    given = {name: value for name, value in vars(initial).items() if value is not None}
    return self.physics.make(**{"ctrl": self.rest_ctrl(initial), **given})


class RotateZ(_HandTask, rotate.RotateZ):
  """Rotation about the vertical."""


class Reorient(_HandTask, reorient.Reorient):
  """Reorientation; noise of `pose_noise.angle` is on each entry of the quaternion, about three times the angle."""

  def sense_cube(self, info: Mapping[str, Any], pose: Pose) -> Pose:
    if not self.pose_noise:
      return pose
    turn = lambda key, quat, size: normalize(quat + size * jax.random.normal(key, (4,)))
    return sensed_pose(info["pose_key"], pose, self.pose_noise, self.config.noise_level, turn)


@dataclasses.dataclass
class PushObjectByWrench(events.PushObjectByWrench):
  """Forces and torques whose strengths come from one draw."""

  def strength(self, key: jax.Array) -> jax.Array:
    ranges = (self.velocity, self.angular_velocity)
    return jnp.repeat(jnp.array([jax.random.uniform(key, minval=low, maxval=high) for low, high in ranges]), 3)
