"""A double pendulum that swings its tip up to a target, with dense or sparse reward (DM Control Suite)."""

import jax
import jax.numpy as jnp

from playground.envs.dm_control.suite import SuiteTask, Terms, draw_angle
from playground.mdp.tolerance import tolerance
from playground.physics.backend import PhysicsData


class Acrobot(SuiteTask):
  """Swings two links up with one motor at the elbow (action in [-1, 1]) and holds the tip at the target above them.

  Observation [6]: sine of the upper and of the lower arm's angle to the vertical, their cosines, velocities of shoulder
  and elbow rad/s. The reward is 1 with the tip in the target; outside it falls with the distance, or is 0 if sparse. An
  episode starts at rest, with both joints anywhere.
  """

  domain = "acrobot"
  derived = ("xmat", "site_xpos")

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    return {"qpos": draw_angle(jax.random.split(rng)[1], (2,))}

  def parts(self, data: PhysicsData) -> dict[str, jax.Array]:
    axes = data.xmat[jnp.array([self.body["upper_arm"], self.body["lower_arm"]]), :, 2]
    return {"arm_sin": axes[:, 0], "arm_cos": axes[:, 2], "velocity": data.qvel}

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    distance = jnp.linalg.norm(data.site_xpos[self.site["target"]] - data.site_xpos[self.site["tip"]])
    return tolerance(distance, (0.0, self.mj_model.site("target").size[0]), self.config.margin), {}
