"""A hand with a cube: scene and targets of its actuators. The terms of a task's config define everything else."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from playground.envs.base import State
from playground.envs.task import InitialState, Task
from playground.errors import lookup
from playground.mdp.manipulators import Hand, HandContext
from playground.mdp.poses import Pose, sensed_pose
from playground.physics.backend import PhysicsData, mjx
from playground.robots.in_hand import build_in_hand_scene

_AWAY = (-100.0, -100.0, -100.0)  # m, place of the goal's marker in tasks without a goal

# The base of an action: the targets that hold the keyframe `home`, or those of the step before.
_ACTION_BASES: dict[str, Callable[[Hand, PhysicsData], jax.Array]] = {
  "home": lambda hand, data: hand.init_ctrl,
  "last_target": lambda hand, data: data.ctrl,
}


class HandTask(Task):
  """A hand, palm up, with a cube: target = base + action_scale * action, within the targets' range.

  Terms read the cube's true pose, or the tracked one (`sensed_*`), which has the noise of `env.pose_noise`. What
  differs from Playground 0.2.0 is in docs/differences.md.
  """

  context = HandContext
  derived = ("sensordata", "actuator_force", "qfrc_actuator")

  def __init__(self, config: Any):
    """Builds the scene and binds the terms; `config` is that of `configs/env/_in_hand.yaml`."""
    super().__init__(config, self.scene(config))
    self._action_base = lookup(_ACTION_BASES, config.action_base, "env.action_base")
    self._action_scale = self.scales(config.action_scale)
    self.pose_noise = config.pose_noise if config.noise_level else None

  def scene(self, config: Any) -> mujoco.MjSpec:
    """Returns the scene to compile; called before everything else."""
    spec = build_in_hand_scene(config.robot)
    if not config.torque_limits:
      for joint in spec.joints:
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    for geom in spec.body("goal").geoms:  # a marker that nothing touches
      geom.contype = geom.conaffinity = 0
    return spec

  def make_robot(self, mj_model: mujoco.MjModel, config: Any) -> Hand:
    return Hand(mj_model, config.robot)

  def initial_state(self, key: jax.Array, model: mjx.Model) -> InitialState:
    return super().initial_state(key, model).replace(mocap_pos=jnp.array([_AWAY]))

  def rest_ctrl(self, initial: InitialState) -> jax.Array:
    return initial.qpos[self.robot.qpos] if self.robot.has_servos else self.robot.init_ctrl

  def first_info(self, data: PhysicsData, key: jax.Array, model: mjx.Model) -> dict[str, Any]:
    return {"pose_key": key} if self.pose_noise else {}

  def pre_step(self, state: State) -> State:
    state = super().pre_step(state)
    if not self.pose_noise:
      return state
    rng, key = jax.random.split(state.info["rng"])
    return state.replace(info=state.info | {"rng": rng, "pose_key": key})

  def action_to_ctrl(self, state: State, action: jax.Array) -> jax.Array:
    target = self._action_base(self.robot, state.data) + self._action_scale * action
    target = jnp.clip(target, *self.robot.ctrl_range)
    return self.config.ema_alpha * target + (1 - self.config.ema_alpha) * state.data.ctrl

  def sense_cube(self, info: Mapping[str, Any], pose: Pose) -> Pose:
    """Returns the cube's pose as it is tracked in this step."""
    level = self.config.noise_level
    return sensed_pose(info["pose_key"], pose, self.pose_noise, level) if self.pose_noise else pose
