"""Sensor noise."""

from collections.abc import Mapping

import jax
import numpy as np

Amplitude = float | np.ndarray  # one for all elements of a channel, or one for each


def uniform_noise(key: jax.Array, clean: jax.Array, amplitude: Amplitude) -> jax.Array:
  """Returns `clean` plus independent U[-amplitude, amplitude) on every element."""
  return clean if not np.any(amplitude) else clean + amplitude * (2 * jax.random.uniform(key, clean.shape) - 1)


def add_noise(
  rng: jax.Array, clean: Mapping[str, jax.Array], amplitudes: Mapping[str, Amplitude]
) -> tuple[jax.Array, dict[str, jax.Array]]:
  """Adds uniform noise to each channel from its own key.

  The keys do not depend on the amplitudes, so that the same seed gives the same episode with and without noise.

  Args:
    rng: random key.
    clean: channels by name; keys are split off in their order.
    amplitudes: one for each channel, in its unit.

  Returns:
    The next random key, and the noisy channels.
  """
  noisy = {}
  for name, value in clean.items():
    rng, key = jax.random.split(rng)
    noisy[name] = uniform_noise(key, value, amplitudes[name])
  return rng, noisy
