"""Statistics of the command samplers and of how long a command lasts."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ml_collections import ConfigDict

from playground.errors import UnknownNameError
from playground.mdp.commands import Box, Walk, exponential_steps, make_sampler, make_timer

KEYS = jax.random.split(jax.random.PRNGKey(0), 20_000)
WALK = Walk(min=(-1.5, -0.8, -1.2), max=(1.5, 0.8, 1.2), nonzero_probability=(0.9, 0.25, 0.5), change_probability=0.4)


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


def test_a_box_is_drawn_anew_or_zero() -> None:
  box = Box(min=(-1.0, 0.0, 0.5), max=(1.0, 0.0, 2.0), zero_probability=0.3, deadband=0.2)
  commands = np.asarray(jax.vmap(box.next, (0, None))(KEYS, jnp.full(3, 9.0)))
  still = (commands == 0).all(1)
  np.testing.assert_allclose(still.mean(), 0.3, atol=0.02)
  x, y, yaw = commands[~still].T
  assert not y.any()
  np.testing.assert_allclose([x.min(), x.max(), yaw.min(), yaw.max()], [-1, 1, 0.5, 2], atol=1e-2)
  np.testing.assert_allclose((x == 0).mean(), 0.2, atol=0.02)
  assert np.abs(x[x != 0]).min() >= 0.2


def test_random_keys_may_be_left_unused() -> None:
  box = Box(min=(0.0, 0.0, 0.0), max=(1.0, 1.0, 1.0), zero_probability=0.0, deadband=0.0, unused_keys=2)
  keys = jax.random.split(KEYS[0], 6)[2:5]
  np.testing.assert_array_equal(box.first(KEYS[0]), [jax.random.uniform(key) for key in keys])


@pytest.mark.parametrize(("ending", "duration"), [(False, 3), (True, None)])
def test_a_fixed_timer_counts_steps(ending: bool, duration: int | None) -> None:
  timer = make_timer(ConfigDict({"timer": "fixed", "duration": 0.06}), dt=0.02)
  info, dues = timer.start({}), []
  for _ in range(6):
    due, info = timer.advance(info, jnp.array(ending), {})  # an end starts the count anew
    dues.append(bool(due))
  assert dues == [duration is not None and step % duration == 0 for step in range(1, 7)]


def test_an_exponential_timer_draws_when_due_or_done() -> None:
  timer = make_timer(ConfigDict({"timer": "exponential", "duration": 5.0}), dt=0.02)
  keys = {"command_timer": KEYS[0]}
  fresh = timer.start(keys)["steps_until_next_cmd"]
  for steps, done, due, left in ((2, False, False, 1), (1, False, True, fresh), (2, True, False, fresh)):
    now, info = timer.advance({"steps_until_next_cmd": jnp.array(steps)}, jnp.array(done), keys)
    assert (bool(now), int(info["steps_until_next_cmd"])) == (due, left)


def test_made_from_configs() -> None:
  keys: dict[str, Any] = {"max": [1.0, 2.0, 3.0], "min": None, "nonzero_probability": [1.0, 1.0, 1.0]}
  keys |= {"change_probability": 0.5, "zero_probability": 0.1, "deadband": 0.0, "unused_keys": 0}
  walk = make_sampler(ConfigDict({"sampler": "walk", **keys}))
  assert walk == Walk((-1.0, -2.0, -3.0), (1.0, 2.0, 3.0), (1.0, 1.0, 1.0), 0.5)
  box = make_sampler(ConfigDict({"sampler": "box", **keys, "min": [0.0, 0.0, 0.0]}))
  assert box == Box((0.0, 0.0, 0.0), (1.0, 2.0, 3.0), 0.1, 0.0)
  with pytest.raises(UnknownNameError, match=r"env\.command\.sampler: 'wlk' is unknown.*Did you mean 'walk'"):
    make_sampler(ConfigDict({"sampler": "wlk", **keys}))
  with pytest.raises(UnknownNameError, match=r"env\.command\.timer: 'fixd' is unknown.*Did you mean 'fixed'"):
    make_timer(ConfigDict({"timer": "fixd", "duration": 1.0}), dt=0.02)
