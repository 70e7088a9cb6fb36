"""A point mass that is pushed to the middle of a table (DM Control Suite)."""

import jax
import jax.numpy as jnp

from playground.envs.dm_control.suite import SuiteTask, Terms, small_control
from playground.mdp.tolerance import tolerance
from playground.physics.backend import PhysicsData


class PointMass(SuiteTask):
  """Moves the mass to the target in the middle with one motor along each axis (actions in [-1, 1]).

  Observation [4]: position (x, y) m, velocity m/s. The reward is near_target * small_control. An episode starts at
  rest, anywhere between the walls.
  """

  domain = "point_mass"
  derived = ("geom_xpos",)

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    return {"qpos": self.draw_joints(jax.random.split(rng)[1])}

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    distance = jnp.linalg.norm(data.geom_xpos[self.geom["target"]] - data.geom_xpos[self.geom["pointmass"]])
    radius = self.mj_model.geom("target").size[0]
    terms = {"near_target": tolerance(distance, (0.0, radius), margin=radius), "small_control": small_control(action)}
    return terms["near_target"] * terms["small_control"], terms
