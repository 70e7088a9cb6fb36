"""Delay buffers: what goes in comes out as many steps later as it should."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.mdp.delays import delayed, draw_delay, push, start


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_a_signal_arrives_so_many_steps_later(delay: int) -> None:
  signal = jnp.arange(1.0, 11.0)[:, None] * jnp.array([1.0, -1.0])
  buffer, out = start(jnp.zeros(2), 4), []
  for value in signal:
    buffer = push(buffer, value)
    out.append(delayed(buffer, jnp.array(delay)))
  np.testing.assert_array_equal(out[delay:], signal[: len(signal) - delay])
  assert not np.any(out[:delay])
  assert buffer.shape == (4, 2)


def test_before_the_first_value_is_the_first_value() -> None:
  buffer = push(start(jnp.array([5.0]), 3), jnp.array([6.0]))
  np.testing.assert_array_equal(buffer[:, 0], [6, 5, 5])


def test_beyond_the_buffer_is_its_oldest() -> None:
  buffer = push(push(start(jnp.array(0), 2), jnp.array(1)), jnp.array(2))
  assert [int(delayed(buffer, steps)) for steps in (0, 1, 2, 9)] == [2, 1, 1, 1]


def test_delays_are_drawn_with_both_ends() -> None:
  draws = jax.vmap(lambda key: draw_delay(key, (1, 3)))(jax.random.split(jax.random.PRNGKey(0), 300))
  values, counts = np.unique(draws, return_counts=True)
  assert values.tolist() == [1, 2, 3] and counts.min() > 70
