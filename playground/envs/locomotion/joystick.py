"""Follow a joystick's velocity commands on legs: one task for all robots, composed by config."""

from typing import Any

import jax
import jax.numpy as jnp

from playground.envs.locomotion.legged import LeggedTask
from playground.mdp.legged import LeggedContext
from playground.physics.backend import PhysicsData, mjx


class Joystick(LeggedTask):
  """Tracks commanded forward, sideways and turning velocity (paper: appendix "Locomotion", joystick tasks).

  Its terms are in `configs/env/joystick.yaml`, for two legs in `biped_joystick.yaml`, and for tracking a gait (paper:
  gait tracking, with a joystick and in place) in `gait_tracking.yaml`. It keeps account of the feet: `feet_air_time`,
  `swing_peak` and `last_contact`. What differs from Playground 0.2.0 is in docs/differences.md.
  """

  episode_info = (*LeggedTask.episode_info, "feet_air_time", "swing_peak", "last_contact")

  def first_info(self, data: PhysicsData, key: jax.Array, model: mjx.Model) -> dict[str, Any]:
    feet = len(self.robot.feet)
    return {
      "feet_air_time": jnp.zeros(feet),
      "swing_peak": jnp.zeros(feet),
      "last_contact": jnp.zeros(feet, bool),
    }

  def next_info(self, c: LeggedContext, key: jax.Array) -> dict[str, Any]:
    return {
      "feet_air_time": jnp.where(c.contact, 0.0, c.feet_air_time),
      "swing_peak": jnp.where(c.contact, 0.0, c.swing_peak),
      "last_contact": c.contact,
    }

  def measure(self, c: LeggedContext) -> dict[str, jax.Array]:
    return super().measure(c) | {"swing_peak": jnp.where(c.contact, 0.0, c.swing_peak).mean()}
