"""Sensor noise."""

from collections.abc import Collection, Mapping

import jax
import numpy as np

Amplitude = float | np.ndarray  # one for all elements of a channel, one for each, or some that repeat over them


def uniform_noise(key: jax.Array, clean: jax.Array, amplitude: Amplitude, shared: bool = False) -> jax.Array:
  """Returns `clean` (one axis) plus U[-amplitude, amplitude) on every element.

  The draws are independent; with `shared` the elements over which the amplitudes once run have one among them.
  """
  pattern = np.atleast_1d(amplitude)
  if not pattern.any():
    return clean
  repeats = clean.size // pattern.size
  draws = jax.random.uniform(key, (repeats,) if shared else clean.shape)
  draws = draws.repeat(pattern.size) if shared else draws
  return clean + np.tile(pattern, repeats) * (2 * draws - 1)


def add_noise(
  rng: jax.Array,
  clean: Mapping[str, jax.Array],
  amplitudes: Mapping[str, Amplitude],
  shared: Collection[str] = (),
) -> tuple[jax.Array, dict[str, jax.Array]]:
  """Adds uniform noise to each channel from its own key.

  The keys do not depend on the amplitudes, so that the same seed gives the same episode with and without noise.

  Args:
    rng: random key.
    clean: channels by name; keys are split off in their order.
    amplitudes: for each channel, in its unit.
    shared: channels whose amplitudes repeat and whose elements share draws (see `uniform_noise`).

  Returns:
    The next random key, and the noisy channels.
  """
  noisy = {}
  for name, value in clean.items():
    rng, key = jax.random.split(rng)
    noisy[name] = uniform_noise(key, value, amplitudes[name], name in shared)
  return rng, noisy
