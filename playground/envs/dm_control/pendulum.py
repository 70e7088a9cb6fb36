"""A pendulum that is swung up and held there (DM Control Suite)."""

import math
from typing import Any

import jax
import jax.numpy as jnp

from playground.envs.dm_control.suite import SuiteTask, Terms, load_spec
from playground.envs.physics import PhysicsData
from playground.mdp.tolerance import tolerance

UPRIGHT = math.cos(math.radians(8))


class PendulumSwingup(SuiteTask):
  """Swings a pole up with a motor too weak to lift it (action in [-1, 1]).

  Observation [3]: sine and cosine of the pole's angle, its velocity rad/s. The reward is 1 within 8 degrees of upright,
  else 0.

  An episode starts at rest, anywhere on the circle.
  """

  derived = ("xmat",)

  def __init__(self, config: Any):
    """Loads the model. `config`: see `configs/env/PendulumSwingup.yaml`."""
    super().__init__(config, load_spec("pendulum").compile())
    self._pole = self.mj_model.body("pole").id

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    return {"state": {"pole_sin": 1, "pole_cos": 1, "velocity": 1}}

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    return {"qpos": jax.random.uniform(jax.random.split(rng)[1], (1,), minval=-jnp.pi, maxval=jnp.pi)}

  def observe(self, data: PhysicsData) -> jax.Array:
    axis = data.xmat[self._pole, :, 2]
    return jnp.stack([axis[0], axis[2], data.qvel[0]])

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    return tolerance(data.xmat[self._pole, 2, 2], (UPRIGHT, math.inf)), {}
