"""A Panda takes a body to a goal: picking up, opening. One task, composed by config."""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from playground.envs.manipulation.tabletop import TabletopTask
from playground.envs.physics import PhysicsData, mjx
from playground.mdp.arms import ArmContext


class ArmTask(TabletopTask):
  """The hand reaches an object, then takes it to the goal (paper, appendix "Manipulation").

  An action adds to the targets of the servos: the arm's seven joints and the fingers. `info["reached_box"]` is whether
  the hand has reached the object in this episode. What differs from Playground 0.2.0 is in docs/differences.md.

  Metrics of an evaluation: `success` is whether the object is within `success_distance` of the goal, and within
  `success_angle` of its turn where that is given, when the episode ends; `position_error_cm` and `rotation_error_deg`
  are how far it is then.
  """

  episode_info = (*TabletopTask.episode_info, "reached_box")
  summaries: ClassVar[Mapping[str, str]] = dict.fromkeys(("success", "position_error_cm", "rotation_error_deg"), "last")

  def at_goal(self, c: ArmContext) -> jax.Array:
    near = self.goal_distance(c) < self.config.success_distance
    return near if self.config.success_angle is None else near & (c.goal_angle < self.config.success_angle)

  def goal_distance(self, c: ArmContext) -> jax.Array:
    """Returns how far the object is from the goal as success counts it, m."""
    return jnp.linalg.norm(c.to_goal)

  def first_info(self, data: PhysicsData, key: jax.Array, model: mjx.Model) -> dict[str, Any]:
    return {"reached_box": jnp.zeros(())}

  def next_info(self, c: ArmContext, key: jax.Array) -> dict[str, Any]:
    return {"reached_box": c.reached}

  def measure(self, c: ArmContext) -> dict[str, jax.Array]:
    return {
      "success": c.at_goal.astype(jnp.float32),
      "position_error_cm": 100 * jnp.linalg.norm(c.to_goal),
      "rotation_error_deg": jnp.rad2deg(c.goal_angle),
    }
