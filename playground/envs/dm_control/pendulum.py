"""A pendulum that is swung up and held there (DM Control Suite)."""

import math

import jax

from playground.envs.dm_control.suite import SuiteTask, Terms, draw_angle
from playground.mdp.tolerance import tolerance
from playground.physics.backend import PhysicsData

UPRIGHT = math.cos(math.radians(8))


class PendulumSwingup(SuiteTask):
  """Swings a pole up with a motor too weak to lift it (action in [-1, 1]).

  Observation [3]: sine and cosine of the pole's angle, its velocity rad/s. The reward is 1 within 8 degrees of upright,
  else 0.

  An episode starts at rest, anywhere on the circle.
  """

  domain = "pendulum"
  derived = ("xmat",)

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    return {"qpos": draw_angle(jax.random.split(rng)[1], (1,))}

  def parts(self, data: PhysicsData) -> dict[str, jax.Array]:
    axis = data.xmat[self.body["pole"], :, 2]
    return {"pole_sin": axis[0], "pole_cos": axis[2], "velocity": data.qvel}

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    return tolerance(data.xmat[self.body["pole"], 2, 2], (UPRIGHT, math.inf)), {}
