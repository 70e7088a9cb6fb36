"""Rewards for progress alone."""

import jax.numpy as jnp
import numpy as np

from playground.mdp.progress import progress


def test_gains_add_up_to_the_best_and_going_back_and_forth_earns_nothing() -> None:
  best, gains = jnp.array(0.2), []
  for potential in (0.1, 0.5, 0.3, 0.5, 0.6):
    gain, best = progress(jnp.array(potential), best)
    gains.append(gain)
  np.testing.assert_allclose(gains, [0, 0.3, 0, 0, 0.1], atol=1e-7)
  np.testing.assert_allclose(best, 0.6)
