"""A box that one arm hands over to the other."""

from typing import Any

import jax
import jax.numpy as jnp

from playground.envs.manipulation.arm import Bimanual, ProgressTask
from playground.mdp.manipulators import ArmContext
from playground.physics.backend import PhysicsData, mjx

_MEETING = (0.0, 0.0, 0.24)  # m, where the box changes hands
_PICK_X, _PASS_X = -0.1, 0.0  # m: the box's x up to which it is the left hand's, and from which the right one's
_LIFTED, _FALLEN = 0.15, 0.05  # m: heights at which the box counts as picked up, and then as dropped
_DROP_COST = 0.1
_HOLDING_RATE = 0.02  # of the potential, in every step once the right hand has the box


class HandOver(ProgressTask, Bimanual):
  """The left arm picks the box up and passes it to the right one, which brings it to the goal. (Not in the paper.)

  The reward is the gain of the terms' weighted mean over its best so far in the episode; a dropped box costs and ends
  the episode. The left gripper does not close below 1 cm, which helps exploration.

  Metrics of an evaluation: `success` is whether the box is within `success_distance` of the goal, and the left hand on
  its own side, when the episode ends; `position_error_cm` how far the box is then.
  """

  episode_info = ("picked",)

  def first_info(self, data: PhysicsData, key: jax.Array, model: mjx.Model) -> dict[str, Any]:
    return super().first_info(data, key, model) | {"picked": jnp.zeros((), bool)}

  def next_info(self, c: ArmContext, key: jax.Array) -> dict[str, Any]:
    return super().next_info(c, key) | {"picked": c.info["picked"] | (c.object_pos[2] > _LIFTED)}

  def bonus(self, c: ArmContext, potential: jax.Array) -> jax.Array:
    left_x = c.site_pos("left/gripper")[0]
    holding = _HOLDING_RATE * potential * _beyond(-left_x, 0.0) * _beyond(c.object_pos[0], 0.1)
    return holding - _DROP_COST * dropped(c)

  def at_goal(self, c: ArmContext) -> jax.Array:
    return super().at_goal(c) & (c.site_pos("left/gripper")[0] < 0)


def dropped(c: ArmContext) -> jax.Array:
  """The box is down after it was picked up in this episode."""
  return (c.info["picked"] | (c.object_pos[2] > _LIFTED)) & (c.object_pos[2] < _FALLEN)


def grippers_at_box_exp(c: ArmContext) -> jax.Array:
  """exp(-10 d), d from the left gripper to the box's top, m, until it is passed; then twice that of the right one.

  While the box is passed the right gripper's term, of the distance to the box's bottom, is added to the left one's.
  """
  left = _nearness(c.site_pos("box_top"), c.site_pos("left/gripper"))
  return left * (c.object_pos[0] < _PASS_X) + _right_holds(c)


def box_at_meeting_exp(c: ArmContext) -> jax.Array:
  """exp(-10 d), d from the box to where it changes hands, m; once passed, of the left gripper if that is nearer."""
  meeting, passed = jnp.array(_MEETING), c.object_pos[0] >= _PASS_X
  return jnp.maximum(_nearness(c.object_pos, meeting), _nearness(c.site_pos("left/gripper"), meeting) * passed)


def box_at_goal_exp(c: ArmContext) -> jax.Array:
  """exp(-10 d), d from the box to the goal, m, while the right gripper has the box and the left one is on its side."""
  return _nearness(c.goal_pos, c.object_pos) * _right_holds(c) * _beyond(-c.site_pos("left/gripper")[0], 0.0)


def finger_gaps(c: ArmContext, half_width: float) -> jax.Array:
  """How far each finger is open beyond the box's half width, m [4]."""
  model = c.env.mj_model
  fingers = [model.jnt_qposadr[i] for i in range(model.njnt) if model.joint(i).name.endswith("_finger")]
  return c.data.qpos[jnp.array(fingers)] - half_width


def _right_holds(c: ArmContext) -> jax.Array:
  """How near the right gripper is to the box's bottom from the passing on, twice as much once it is passed."""
  near, x = _nearness(c.site_pos("box_bottom"), c.site_pos("right/gripper")), c.object_pos[0]
  return near * (x >= _PICK_X) + near * (x >= _PASS_X)


def _nearness(a: jax.Array, b: jax.Array) -> jax.Array:
  """1 where two points meet, 0.37 at 10 cm."""
  return jnp.exp(-10 * jnp.linalg.norm(a - b))


def _beyond(x: jax.Array, threshold: float) -> jax.Array:
  """1 where x is some cm above the threshold (m), 0 where below."""
  return jax.nn.sigmoid(100 * (x - threshold))
