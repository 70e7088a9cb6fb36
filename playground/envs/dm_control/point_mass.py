"""A point mass that is pushed to the middle of a table (DM Control Suite)."""

from typing import Any

import jax
import jax.numpy as jnp

from playground.envs.dm_control.suite import SuiteTask, Terms, load_spec
from playground.envs.physics import PhysicsData
from playground.mdp.tolerance import tolerance


class PointMass(SuiteTask):
  """Moves the mass to the target in the middle with one motor along each axis (actions in [-1, 1]).

  Observation [4]: position (x, y) m, velocity m/s. The reward is near_target * small_control. An episode starts at
  rest, anywhere between the walls.
  """

  derived = ("geom_xpos",)

  def __init__(self, config: Any):
    """Loads the model. `config`: see `configs/env/PointMass.yaml`."""
    super().__init__(config, load_spec("point_mass").compile())
    self._target, self._mass = (self.mj_model.geom(name).id for name in ("target", "pointmass"))
    self._target_radius = float(self.mj_model.geom("target").size[0])

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    return {"state": {"position": 2, "velocity": 2}}

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    low, high = self.mj_model.jnt_range.T
    return {"qpos": jax.random.uniform(jax.random.split(rng)[1], (2,), minval=low, maxval=high)}

  def observe(self, data: PhysicsData) -> jax.Array:
    return jnp.concatenate([data.qpos, data.qvel])

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    distance = jnp.linalg.norm(data.geom_xpos[self._target] - data.geom_xpos[self._mass])
    control = tolerance(action, margin=1, sigmoid="quadratic", value_at_margin=0).mean()
    terms = {
      "near_target": tolerance(distance, (0.0, self._target_radius), margin=self._target_radius),
      "small_control": (4 + control) / 5,
    }
    return terms["near_target"] * terms["small_control"], terms
