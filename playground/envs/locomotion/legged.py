"""Robots on legs: scene and joint targets. The terms of a task's config define everything else."""

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from playground.envs.task import InitialState, State, Task
from playground.errors import ConfigError, lookup
from playground.mdp.context import StepContext
from playground.mdp.legged import LeggedContext, LeggedRobot
from playground.physics.backend import PhysicsData, mjx
from playground.robots.scene import build_scene, check_keys, set_gains
from playground.robots.terrain import ground_peak

# The base of an action: the joints' default pose, their position, or their target in the step before.
_ACTION_BASES: dict[str, Callable[[LeggedRobot, PhysicsData], jax.Array]] = {
  "default_pose": lambda robot, data: robot.default_pose,
  "joint_pos": lambda robot, data: data.qpos[7:],
  "last_target": lambda robot, data: data.ctrl,
}
# Keys that the YAML of every robot on legs has (docs/add-a-robot.md).
_KEYS = ("mjcf", "root", "base_site", "feet", "keyframe", "joints", "pd", "sensors")
_KEYS += ("foot_linvel", "foot_contact", "floor_contacts")
_OPTIONAL = ("name", "mirror", "gaits", "pose_weights", "target_range", "restricted_range", "hips", "hip_rolls")
_OPTIONAL += ("knees", "foot_pos", "foot_force", "self_contact", "fatal_contact")
_ROUNDING = 1e-4  # rad, by which a keyframe may leave the joints' limits


class LeggedTask(Task):
  """A robot on legs whose actions move the joints' position targets: target = base + action_scale * action.

  Metrics: `upright` is whether the base is within 18 degrees of upright when the episode ends; with a velocity command,
  `tracking_error/lin_vel` (m/s) and `tracking_error/ang_vel` (rad/s) are means over an episode.
  """

  context = LeggedContext
  derived = ("sensordata", "actuator_force", "site_xpos", "site_xmat", "qacc")
  summaries: ClassVar[Mapping[str, str]] = {
    "upright": "last",
    "tracking_error/lin_vel": "mean",
    "tracking_error/ang_vel": "mean",
  }

  def __init__(self, config: Any):
    """Builds the scene and binds the terms; `config` is that of `configs/env/joystick.yaml`, `getup.yaml`, ..."""
    super().__init__(config, self.scene(config))
    self._action_base = lookup(_ACTION_BASES, config.action_base, "env.action_base")
    self._action_scale = self.scales(config.action_scale)
    self._target_range = self.robot.target_range if config.clip_targets else None
    self._settle_steps = round(config.settle_s / self.sim_dt)

  def scene(self, config: Any) -> mujoco.MjSpec:
    """Returns the scene to compile; called before everything else."""
    scene, robot = config.scene, config.robot
    check_keys(robot, _KEYS, "robot on legs", _OPTIONAL)
    ground = {"terrain": scene.terrain, "parameters": dict(scene.terrain_params or {})}
    spec = build_scene(robot.mjcf, **ground, collision=scene.collision, floor_contacts=tuple(robot.floor_contacts))
    if config.restricted_joint_range:
      if "restricted_range" not in config.robot:
        raise ConfigError(f"env.restricted_joint_range: robot={config.robot.get('name')} has no restricted_range.")
      joints = {joint.name: joint for joint in spec.joints if joint.name}
      for name, limits in config.robot.restricted_range.items():
        joint = lookup(joints, name, "env.robot.restricted_range")
        in_degrees = spec.compiler.degree and joint.type == mujoco.mjtJoint.mjJNT_HINGE  # the unit of the MJCF's angles
        joint.range = np.degrees(limits) if in_degrees else limits
    return spec

  def prepare_model(self, mj_model: mujoco.MjModel, config: Any) -> None:
    set_gains(mj_model, **(config.robot.pd or {}))
    if type(self).action_to_ctrl is LeggedTask.action_to_ctrl:
      _need_servos(mj_model, config.robot.mjcf)

  def make_robot(self, mj_model: mujoco.MjModel, config: Any) -> LeggedRobot:
    robot = LeggedRobot(mj_model, config.robot)
    if not config.restricted_joint_range:  # which may exclude the pose
      _check_pose(robot, config.robot.keyframe)
    robot.ground_peak = ground_peak(mj_model)
    return robot

  def rest_ctrl(self, initial: InitialState) -> jax.Array:
    return initial.qpos[7:]

  def start_physics(self, model: mjx.Model, initial: InitialState) -> PhysicsData:
    data = super().start_physics(model, initial)
    if self._settle_steps == 0:
      return data
    data = self.physics.step(model, data, data.ctrl, self._settle_steps)
    return data.replace(time=jnp.zeros_like(data.time))

  def action_to_ctrl(self, state: State, action: jax.Array) -> jax.Array:
    target = self._action_base(self.robot, state.data) + self._action_scale * action
    return target if self._target_range is None else jnp.clip(target, *self._target_range)

  def measure(self, c: StepContext) -> dict[str, jax.Array]:
    metrics = {"upright": (c.sensor("upvector")[2] > 0.95).astype(jnp.float32)}
    if "command" not in c.info:
      return metrics
    linvel, gyro = c.sensor("linvel"), c.sensor("gyro")
    return metrics | {
      "tracking_error/lin_vel": jnp.linalg.norm(c.command[:2] - linvel[:2]),
      "tracking_error/ang_vel": jnp.abs(c.command[2] - gyro[2]),
    }


def _check_pose(robot: LeggedRobot, keyframe: str) -> None:
  """Raises ConfigError where the pose in which episodes start is outside a joint's range."""
  pose, (lower, upper) = np.asarray(robot.default_pose), np.asarray(robot.joint_range)  # else each one is a JAX program
  for joint, at, low, high in zip(robot.joint_names, pose, lower, upper, strict=True):
    if not low - _ROUNDING <= at <= high + _ROUNDING:
      outside = f"is at {at:g}, outside its range of {low:g} to {high:g}"
      raise ConfigError(f"env.robot.keyframe={keyframe}: the joint {joint} {outside}.")


def _need_servos(mj_model: mujoco.MjModel, mjcf: str) -> None:
  """Raises ConfigError where an actuator does not hold its joint at `ctrl`: an action is a joint's target."""
  for i in range(mj_model.nu):
    name, gear = mj_model.actuator(i).name or f"number {i}", mj_model.actuator_gear[i, 0]
    affine = mj_model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE  # a motor ignores the bias of `pd.kp`
    integrates = mj_model.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_INTEGRATOR  # <intvelocity>: `ctrl` is a velocity
    kp, bias = mj_model.actuator_gainprm[i, 0], mj_model.actuator_biasprm[i]
    if not (affine and kp > 0 and bias[0] == 0 and bias[1] == -kp) or integrates:
      raise ConfigError(
        f"env.robot.mjcf={mjcf}: the actuator {name} is no position servo, and an action is a joint's target: "
        'use <position inheritrange="1">, or a task with its own action_to_ctrl.'
      )
    if gear != 1:  # the servo holds gear * angle at `ctrl`
      raise ConfigError(
        f"env.robot.mjcf={mjcf}: the actuator {name} has gear={gear:g}, and an action is its joint's target: "
        "leave gear out, with kp and kv times gear², and forcerange times gear."
      )
