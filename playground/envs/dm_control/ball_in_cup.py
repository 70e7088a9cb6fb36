"""A ball on a string that is caught with a cup (DM Control Suite)."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from playground.envs.dm_control.suite import SuiteTask, Terms
from playground.physics.backend import PhysicsData

_XZ = slice(0, 3, 2)  # the plane of the task
_LOW, _HIGH = np.array([-0.2, 0.2]), np.array([0.2, 0.5])  # the ball's x and z at the start of an episode, m
_TRIES = 16  # the cup takes a sixth of that area: no try is free in one of 10^12 episodes


class BallInCup(SuiteTask):
  """Moves the cup with one motor along x and one along z (actions in [-1, 1]): reward 1 with the ball in it, else 0.

  Observation [8]: displacements of cup and ball (x and z of each) m, their velocities m/s.

  An episode starts at rest, the ball anywhere about the cup (or in it) where it does not touch, as in DM Control.
  """

  domain = "ball_in_cup"
  derived = ("site_xpos", "xpos")

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    tries = jax.random.uniform(rng, (_TRIES, 2), minval=_LOW, maxval=_HIGH)
    free = self._clearance(tries) > 0
    return {"qpos": jnp.concatenate([jnp.zeros(2), tries[jnp.argmax(free)]])}  # the first that is free

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    offset = (data.site_xpos[self.site["target"]] - data.xpos[self.body["ball"]])[_XZ]
    play = self.mj_model.site("target").size - self.mj_model.geom("ball").size[0]  # half the target's, m
    return (jnp.abs(offset) < jnp.array(play)[_XZ]).all().astype(jnp.float32), {}

  def _clearance(self, ball: jax.Array) -> jax.Array:
    """Gap m between the ball, displaced by `ball` [n, 2], and the cup at rest, shape [n]; negative where they meet."""
    model, data = self.mj_model, mujoco.MjData(self.mj_model)
    mujoco.mj_kinematics(model, data)
    walls = [f"cup_part_{i}" for i in range(5)]  # capsules
    middle = np.stack([data.geom(wall).xpos[_XZ] for wall in walls])
    half = np.stack([data.geom(wall).xmat[2::3][_XZ] * model.geom(wall).size[1] for wall in walls])  # middle to end
    radius = np.array([model.geom(wall).size[0] for wall in walls]) + model.geom("ball").size[0]
    offset = ball[:, None] + model.body("ball").pos[_XZ] - middle
    along = jnp.clip((offset * half).sum(-1) / (half**2).sum(-1), -1.0, 1.0)[..., None]
    return (jnp.linalg.norm(offset - along * half, axis=-1) - radius).min(axis=1)
