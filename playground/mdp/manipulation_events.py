"""Reset events of arms at a table: where objects, goals and joints are when an episode starts."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from mujoco.mjx._src.math import axis_angle_to_quat, normalize

from playground.errors import ConfigError
from playground.limits import AtLeast0, Vector

if TYPE_CHECKING:
  from playground.envs.manipulation.arm import TabletopTask
  from playground.envs.task import InitialState


def reset_body_uniform(
  key: jax.Array, env: "TabletopTask", initial: "InitialState", body: str, reach: Vector
) -> "InitialState":
  """Moves a free body by U[-reach, reach) along x, y and z, m."""
  place = env.robot.free_joint(body)
  return initial.replace(qpos=initial.qpos.at[place].add(_uniform(key, [-r for r in reach], reach, 3)))


def reset_goal_uniform(
  key: jax.Array,
  env: "TabletopTask",
  initial: "InitialState",
  low: Vector,
  high: Vector,
  turn: AtLeast0 = 0.0,
  at_least: Vector | None = None,
) -> "InitialState":
  """Draws the goal's position U[low, high), m, and turns it about a random axis.

  Args:
    key: random key.
    env: the task.
    initial: the state that an episode starts with.
    low: lower ends of x, y and z.
    high: upper ends.
    turn: rad; the angle is U[0, turn). The axis's entries are uniform, so that it points rather to a cube's corners, as
      in Playground 0.2.0, for which the published settings are.
    at_least: coordinates that are below are raised to these.
  """
  del env
  place_key, axis_key, angle_key = jax.random.split(key, 3)
  goal = _uniform(place_key, low, high, 3)
  goal = goal if at_least is None else jnp.maximum(goal, jnp.array(at_least))
  axis = normalize(jax.random.uniform(axis_key, (3,), minval=-1.0, maxval=1.0))
  quat = axis_angle_to_quat(axis, jax.random.uniform(angle_key, maxval=turn))
  return initial.replace(mocap_pos=goal[None], mocap_quat=quat[None])


def reset_joints_uniform(
  key: jax.Array, env: "TabletopTask", initial: "InitialState", low: Sequence[float], high: Sequence[float]
) -> "InitialState":
  """Adds U[low, high) rad to each joint of the arm, within its range; the servos hold it there."""
  robot = env.robot
  joints = initial.qpos[robot.qpos] + _uniform(key, low, high, len(robot.joint_names))
  joints = jnp.clip(joints, *robot.joint_range)
  ctrl = robot.init_ctrl if initial.ctrl is None else initial.ctrl
  qpos = initial.qpos.at[robot.qpos].set(joints)
  return initial.replace(qpos=qpos, ctrl=ctrl.at[robot.servos].set(joints))


def _uniform(key: jax.Array, low: Sequence[float], high: Sequence[float], size: int) -> jax.Array:
  if not len(low) == len(high) == size or any(a > b for a, b in zip(low, high, strict=True)):
    raise ConfigError(
      f"env.events: low={list(low)} and high={list(high)} must be {size} numbers each, none above high."
    )
  return jax.random.uniform(key, (size,), minval=jnp.array(low), maxval=jnp.array(high))
