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
  gait tracking, with a joystick and in place) in `gait_tracking.yaml`. It tracks `feet_air_time`, `swing_peak` and
  `last_contact` in `info`. What differs from Playground 0.2.0 is in docs/differences.md.
  """

  episode_info = ("feet_air_time", "swing_peak", "last_contact")

  def first_info(self, data: PhysicsData, key: jax.Array, model: mjx.Model) -> dict[str, Any]:
    none = jnp.zeros(len(self.robot.feet))
    return {"feet_air_time": none, "swing_peak": none, "last_contact": none.astype(bool)}

  def next_info(self, c: LeggedContext, key: jax.Array) -> dict[str, Any]:
    since_contact = lambda value: jnp.where(c.contact, 0.0, value)
    air_time, peak = since_contact(c.feet_air_time), since_contact(c.swing_peak)
    return {"feet_air_time": air_time, "swing_peak": peak, "last_contact": c.contact}

  def measure(self, c: LeggedContext) -> dict[str, jax.Array]:
    return super().measure(c) | {"swing_peak": jnp.where(c.contact, 0.0, c.swing_peak).mean()}
