"""Playground 0.2.0's arms, upstream bugs included."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from mujoco.mjx._src.math import axis_angle_to_quat, quat_mul, quat_to_mat

from playground.envs.base import State
from playground.envs.manipulation import arm, handover, peg, pick_cartesian, push
from playground.envs.task import InitialState, Task
from playground.envs.wrappers import PRESERVE_INFO
from playground.mdp.manipulators import ArmContext, ArmRobot
from playground.physics.backend import PhysicsData, mjx
from playground.robots.panda.kinematics import JOINT_RANGE, inverse_kinematics


class NoForward(Task):
  """Resets compute no kinematics, so poses and sensors are 0 at first; an auto-reset keeps all of `info`."""

  adds = False
  episode_info = ()

  def start_physics(self, model: mjx.Model, initial: InitialState) -> PhysicsData:
    del model
    given = {name: value for name, value in vars(initial).items() if value is not None}
    return self.physics.make(**{"ctrl": self.rest_ctrl(initial), **given})


class ArmTask(NoForward, arm.ArmTask):
  """Once the hand has reached the object, it counts as reached in all later episodes of the environment."""


class SinglePegInsertion(NoForward, peg.SinglePegInsertion):
  """The first observation lacks poses."""


class HandOver(NoForward, handover.HandOver):
  """The first observation lacks poses."""

  episode_info = ("first_step", "best_potential", "picked")


class _UnseenGoalContext(ArmContext):
  """The goal is an entry of `info`; its marker stays elsewhere."""

  @property
  def goal_pos(self) -> jax.Array:
    return self.info["target_pos"]


class OpenCabinet(ArmTask):
  """Joint 4 starts beyond its limit, and a pose that it cannot have is asked for; the marker is in the arm's base."""

  context = _UnseenGoalContext

  def make_robot(self, mj_model: mujoco.MjModel, config: Any) -> ArmRobot:
    robot = super().make_robot(mj_model, config)
    key = mj_model.key(config.keyframe)
    robot.init_qpos, robot.init_ctrl = jnp.array(key.qpos), jnp.array(key.ctrl)
    robot.default_pose = robot.init_qpos[robot.qpos]
    robot.joint_range = jnp.array([-jnp.inf, jnp.inf])[:, None] * jnp.ones(7)
    return robot

  def first_info(self, data: PhysicsData, key: jax.Array, model: mjx.Model) -> dict[str, Any]:
    x = jax.random.uniform(key, minval=0.2, maxval=0.4)
    return super().first_info(data, key, model) | {"target_pos": jnp.stack([x, jnp.zeros(()), jnp.array(0.5)])}


class PickCubeCartesian(NoForward, pick_cartesian.PickCubeCartesian):
  """The cube starts 3 cm inside the floor, the hand is called back from a start with the cube, no limits are known."""

  episode_info = ("reached_box", "first_step", "best_potential", "current_pos", "last_act")

  def __init__(self, config: Any):
    super().__init__(config)
    self._guide_tip = self._tip

  def initial_state(self, key: jax.Array, model: mjx.Model) -> InitialState:
    initial = super().initial_state(key, model)
    return initial.replace(qpos=initial.qpos.at[self.robot.free_joint("box").stop - 1].set(0.0))

  def _plan(
    self, ctrl: jax.Array, info: Mapping[str, Any], action: jax.Array
  ) -> tuple[jax.Array, jax.Array, jax.Array]:
    step = self._action_scale * jnp.array([0.0, action[0], action[1]])
    tip = jnp.clip(info["current_pos"] + step, *pick_cartesian.WORKSPACE)
    joints = inverse_kinematics(tip, self.attitude, ctrl[6], near=ctrl[:7])
    return tip, joints, jnp.isfinite(joints).all()


class PickCubeCartesianVision(PickCubeCartesian, pick_cartesian.PickCubeCartesianVision):
  """A red goal stands in the robot's base, and the light hangs above the robot; resets compute kinematics."""

  context = _UnseenGoalContext

  def start_physics(self, model: mjx.Model, initial: InitialState) -> PhysicsData:
    data = super().start_physics(model, initial.replace(mocap_pos=jnp.zeros((1, 3))))
    return self.physics.forward(model, data)

  def first_info(self, data: PhysicsData, key: jax.Array, model: mjx.Model) -> dict[str, Any]:
    goal = self.initial_state(key, model).mocap_pos
    assert goal is not None
    return super().first_info(data, key, model) | {"target_pos": goal[0]}


class PushCube(NoForward, push.PushCube):
  """Zeros are observed until the first delayed observation arrives; delays and counters outlast an auto-reset.

  Limits are taken for ranges about 0, a new goal's place and turn come from one key, and levels have no end.
  """

  episode_info = ("goal_reached", "goals_reached")

  def __init__(self, config: Any):
    super().__init__(config)
    self.arm_spread = push.ARM_SPREAD * JOINT_RANGE

  def reset(self, rng: jax.Array, model: mjx.Model | None = None) -> Any:
    state = super().reset(rng, model)
    return state.replace(
      info=state.info | {"observation_buffers": jax.tree.map(jnp.zeros_like, state.info["observation_buffers"])}
    )

  def _next_level(self, c: ArmContext) -> jax.Array:
    return c.info[PRESERVE_INFO]["curriculum_id"] + self.goal_reached(c)

  def pre_step(self, state: State) -> State:
    data, level = state.data, state.info[PRESERVE_INFO]["curriculum_id"]
    _, key, _ = jax.random.split(state.info["rng"], 3)
    quat = quat_mul(data.xquat[self.mj_model.body("box").id], push.draw_yaw(key, self.angles[level]))
    quat = jnp.where(state.info["goal_reached"], quat, data.mocap_quat[0])[None]
    state = super().pre_step(state)
    return state.replace(data=state.data.replace(mocap_quat=quat))


# Terms of PushCube.


def applied_action_rate_norm(c: ArmContext) -> jax.Array:
  """|action - the action that acted in the step before|."""
  return jnp.linalg.norm(c.action - c.info["applied_act"])


def joint_pos_out_of_scaled_limits(c: ArmContext, factor: float) -> jax.Array:
  """Some joint is outside its limits, both times the factor: beyond the lower one for joint 4."""
  lower, upper = factor * JOINT_RANGE
  return ((c.joint_pos < lower) | (c.joint_pos > upper)).any()


def joint_pos_one_noise(c: ArmContext, noise: float) -> jax.Array:
  """Joint positions plus one number U[0, noise) for all of them, rad [7]."""
  return c.joint_pos + _one_of(c, "joint_pos", noise)


def joint_vel_one_noise(c: ArmContext, noise: float) -> jax.Array:
  """Joint velocities plus one number U[0, noise) for all of them, rad/s [7]."""
  return c.joint_vel + _one_of(c, "joint_vel", noise)


def gripper_pos_one_noise(c: ArmContext, noise: float) -> jax.Array:
  """Position of the gripper plus one number U[0, noise) for x, y and z, m [3]."""
  return c.gripper_pos + _one_of(c, "gripper_pos", noise)


def gripper_axes_normal_noise(c: ArmContext, noise: float) -> jax.Array:
  """Last two rows of the gripper's axes [6], turned by up to `noise` rad, in proportion to the joints' noise."""
  assert c.env.gripper is not None
  return _turned(c, c.site_axes(c.env.gripper), _one_of(c, "joint_pos", noise))


def box_axes_normal_noise(c: ArmContext, noise: float) -> jax.Array:
  """Last two rows of the block's axes [6], turned by up to `noise` rad."""
  return _turned(c, c.body_axes("box"), _one_of(c, "box_angle", noise))


_SALTS = {name: 2**20 + i for i, name in enumerate(("joint_pos", "joint_vel", "gripper_pos", "box_angle", "axis"))}


def _one_of(c: ArmContext, name: str, noise: float) -> jax.Array:
  return c.env.config.noise_level * noise * jax.random.uniform(jax.random.fold_in(c.info["rng"], _SALTS[name]))


def _turned(c: ArmContext, axes: jax.Array, angle: jax.Array) -> jax.Array:
  """The last two rows of axes, turned about a unit vector whose two angles are normally distributed."""
  around_key, down_key = jax.random.split(jax.random.fold_in(c.info["rng"], _SALTS["axis"]))
  around, down = 2 * jnp.pi * jax.random.normal(around_key), jnp.pi * jax.random.normal(down_key)
  axis = jnp.array([jnp.sin(down) * jnp.cos(around), jnp.sin(down) * jnp.sin(around), jnp.cos(down)])
  return (quat_to_mat(axis_angle_to_quat(axis, angle)) @ axes)[1:].ravel()
