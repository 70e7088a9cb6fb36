"""A double pendulum that swings its tip up to a target, with dense or sparse reward (DM Control Suite)."""

from typing import Any

import jax
import jax.numpy as jnp

from playground.envs.dm_control.suite import SuiteTask, Terms, load_spec
from playground.envs.physics import PhysicsData
from playground.mdp.tolerance import tolerance


class Acrobot(SuiteTask):
  """Swings two links up with one motor at the elbow (action in [-1, 1]) and holds the tip at the target above them.

  Observation [6]: sine of the upper and of the lower arm's angle to the vertical, their cosines, velocities of shoulder
  and elbow rad/s. The reward is 1 with the tip in the target; outside it falls with the distance, or is 0 if sparse. An
  episode starts at rest, with both joints anywhere.
  """

  derived = ("xmat", "site_xpos")

  def __init__(self, config: Any):
    """Loads the model. `config`: see `configs/env/_acrobot.yaml`."""
    super().__init__(config, load_spec("acrobot").compile())
    self._arms = jnp.array([self.mj_model.body(name).id for name in ("upper_arm", "lower_arm")])
    self._target, self._tip = (self.mj_model.site(name).id for name in ("target", "tip"))
    self._target_radius = float(self.mj_model.site("target").size[0])
    self._margin: float = config.margin

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    return {"state": {"arm_sin": 2, "arm_cos": 2, "velocity": 2}}

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    return {"qpos": jax.random.uniform(jax.random.split(rng)[1], (2,), minval=-jnp.pi, maxval=jnp.pi)}

  def observe(self, data: PhysicsData) -> jax.Array:
    axes = data.xmat[self._arms, :, 2]
    return jnp.concatenate([axes[:, 0], axes[:, 2], data.qvel])

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    distance = jnp.linalg.norm(data.site_xpos[self._target] - data.site_xpos[self._tip])
    return tolerance(distance, (0.0, self._target_radius), self._margin), {}
