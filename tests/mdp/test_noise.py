"""Noise: bounds, independence of the amplitude, and channels of their own."""

import jax
import jax.numpy as jnp
import numpy as np

from playground.mdp.noise import add_noise, uniform_noise

CLEAN = {"a": jnp.zeros(5000), "b": jnp.ones(3)}


def test_uniform_within_the_amplitude() -> None:
  _, noisy = add_noise(jax.random.PRNGKey(0), CLEAN, {"a": 0.2, "b": 0.0})
  np.testing.assert_allclose([noisy["a"].min(), noisy["a"].max()], [-0.2, 0.2], atol=1e-3)
  np.testing.assert_allclose([noisy["a"].mean(), noisy["a"].std()], [0, 0.2 / 3**0.5], atol=5e-3)
  np.testing.assert_array_equal(noisy["b"], CLEAN["b"])


def test_keys_do_not_depend_on_the_amplitudes() -> None:
  quiet, _ = add_noise(jax.random.PRNGKey(0), CLEAN, {"a": 0.0, "b": 0.0})
  loud, one = add_noise(jax.random.PRNGKey(0), CLEAN, {"a": 1.0, "b": 1.0})
  _, two = add_noise(jax.random.PRNGKey(0), CLEAN, {"a": 0.0, "b": 2.0})
  np.testing.assert_array_equal(quiet, loud)
  np.testing.assert_allclose(2 * (one["b"] - 1), two["b"] - 1, rtol=1e-5)


def test_an_amplitude_for_each_element() -> None:
  amplitudes = {"b": np.array([0.0, 1.0, 2.0])}
  _, noisy = add_noise(jax.random.PRNGKey(0), {"b": CLEAN["b"]}, amplitudes)
  _, one = add_noise(jax.random.PRNGKey(0), {"b": CLEAN["b"]}, {"b": 1.0})
  np.testing.assert_allclose(noisy["b"] - 1, amplitudes["b"] * (one["b"] - 1), rtol=1e-5, atol=1e-6)


def test_amplitudes_repeat_and_their_runs_may_share_draws() -> None:
  clean, amplitude = jnp.zeros(6000), np.array([0.1, 0.2, 0.0])
  free, shared = (np.asarray(uniform_noise(jax.random.PRNGKey(0), clean, amplitude, s)) for s in (False, True))
  for noise in (free, shared):
    x, y, z = noise.reshape(-1, 3).T
    np.testing.assert_allclose([x.max(), y.min()], [0.1, -0.2], rtol=1e-2)
    assert not z.any()
    assert np.allclose(y, 2 * x, atol=1e-6) == (noise is shared)
