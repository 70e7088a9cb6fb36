"""A cube that the hand turns about the vertical."""

import jax
import jax.numpy as jnp

from playground.envs.manipulation.in_hand import HandTask
from playground.mdp.manipulators import HandContext
from playground.mdp.rewards import cube_ang_vel_z


class RotateZ(HandTask):
  """Turns the cube about the world's z axis, counterclockwise, without letting it fall (paper, Appendix C.1).

  Metric: `turns` is how many times an episode turned the cube around.
  """

  def measure(self, c: HandContext) -> dict[str, jax.Array]:
    return {"turns": cube_ang_vel_z(c) * self.dt / (2 * jnp.pi)}
