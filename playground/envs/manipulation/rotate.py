"""Turn a cube in the hand about the vertical, on and on."""

import jax
import jax.numpy as jnp

from playground.envs.manipulation.in_hand import InHand
from playground.mdp.hand_rewards import angvel
from playground.mdp.hands import Context


class RotateZ(InHand):
  """Turns the cube about the world's z axis, counterclockwise, without letting it fall (paper, Appendix C.1).

  The defaults differ from Playground 0.2.0 as in `InHand`. In both modes numbers that are not finite end an episode
  (0.2.0: not here, but its other tasks), and `turns` is how many times an episode turned the cube around.
  """

  def _measure(self, now: Context) -> dict[str, jax.Array]:
    return {"turns": angvel(now) * self.dt / (2 * jnp.pi)}
