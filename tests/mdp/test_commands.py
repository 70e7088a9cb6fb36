"""Statistics of the command sampler and of how long a command lasts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ml_collections import ConfigDict

from playground.errors import UnknownNameError
from playground.mdp.commands import Walk, exponential_steps, make_sampler

KEYS = jax.random.split(jax.random.PRNGKey(0), 20_000)
WALK = Walk(max=(1.5, 0.8, 1.2), nonzero_probability=(0.9, 0.25, 0.5), change_probability=0.4)


def test_first_command_fills_the_range() -> None:
  commands = jax.vmap(WALK.first)(KEYS)
  np.testing.assert_allclose(commands.max(0), WALK.max, rtol=1e-2)
  np.testing.assert_allclose(commands.min(0), -jnp.array(WALK.max), rtol=1e-2)
  np.testing.assert_allclose(commands.mean(0), 0, atol=0.02)


def test_next_command_keeps_zeroes_or_redraws_each_component() -> None:
  old = jnp.array([9.0, 9.0, 9.0])  # outside the range, so that what was kept can be told
  commands = jax.vmap(WALK.next, (0, None))(KEYS, old)
  kept, zero = (commands == old).mean(0), (commands == 0).mean(0)
  np.testing.assert_allclose(kept, 0.6, atol=0.02)
  np.testing.assert_allclose(zero, 0.4 * (1 - jnp.array(WALK.nonzero_probability)), atol=0.02)
  drawn = jnp.where((commands == old) | (commands == 0), 0, commands)
  np.testing.assert_allclose(jnp.abs(drawn).max(0), WALK.max, rtol=2e-2)


def test_durations_are_exponential() -> None:
  steps = jax.vmap(lambda key: exponential_steps(key, mean=5.0, dt=0.02))(KEYS)
  assert steps.dtype == jnp.int32 and (steps >= 0).all()
  np.testing.assert_allclose([steps.mean(), steps.std()], 250, rtol=0.03)


def test_make_sampler() -> None:
  keys = {"max": [1.0, 2.0, 3.0], "nonzero_probability": [1.0, 1.0, 1.0], "change_probability": 0.5}
  assert make_sampler(ConfigDict({"sampler": "walk", **keys})) == Walk((1.0, 2.0, 3.0), (1.0, 1.0, 1.0), 0.5)
  with pytest.raises(UnknownNameError, match=r"env\.command\.sampler: 'wlk' is unknown.*Did you mean 'walk'"):
    make_sampler(ConfigDict({"sampler": "wlk", **keys}))
