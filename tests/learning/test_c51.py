"""Distributions over atoms against their formulas."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.errors import ConfigError
from playground.learning.algorithm import build_algorithm
from playground.learning.c51 import Atoms
from playground.learning.hyperparameters import config_class
from tests.dummy import PointTask


def projected(p: np.ndarray, reward: float, discount: float, low: float, high: float) -> np.ndarray:
  """By a loop, as Bellemare et al. have it."""
  count = len(p)
  step = (high - low) / (count - 1)
  out = np.zeros(count)
  for i, share in enumerate(p):
    place = (np.clip(reward + discount * (low + i * step), low, high) - low) / step
    lower, upper = int(np.floor(place)), int(np.ceil(place))
    if lower == upper:
      out[lower] += share
    else:
      out[lower] += share * (upper - place)
      out[upper] += share * (place - lower)
  return out


def test_projections_have_the_published_values() -> None:
  atoms, at_1 = Atoms(-10, 10, 101), jnp.zeros(101).at[55].set(1.0)
  project = lambda p, *x: np.asarray(atoms.project(p, *map(jnp.float32, x)))
  one = project(at_1, 0.05, 0.97)
  assert one[[55, 56]] == pytest.approx([0.9, 0.1], abs=1e-4)
  assert project(at_1, 0.4, 0.0)[52] == pytest.approx(1, abs=1e-4)
  assert project(at_1, -50.0, 1.0)[0] == pytest.approx(1, abs=1e-6)
  small = Atoms(-1, 1, 5).project(jnp.array([0.1, 0.2, 0.3, 0.25, 0.15]), jnp.float32(0.1), jnp.float32(0.9))
  np.testing.assert_allclose(small, [0.06, 0.18, 0.30, 0.285, 0.175], atol=1e-6)


def test_projections_equal_a_loop() -> None:
  rng = np.random.default_rng(0)
  p = rng.dirichlet(np.ones(21), size=60)
  reward = np.concatenate([rng.normal(size=40), np.zeros(10), rng.choice([-9.0, 9.0, 0.3], 10)])
  discount = np.concatenate([rng.random(40), np.ones(10), rng.choice([0.0, 1.0], 10)])
  found = Atoms(-3, 3, 21).project(jnp.asarray(p), jnp.asarray(reward), jnp.asarray(discount))
  expected = [projected(*row, -3, 3) for row in zip(p, reward, discount, strict=True)]
  np.testing.assert_allclose(found, expected, atol=2e-6)
  np.testing.assert_allclose(found.sum(axis=-1), 1, atol=1e-5)


class Seen(PointTask):
  @property
  def observation_size(self) -> dict[str, tuple[int, ...]]:
    return {"state": (2,), "pixels/eye": (6, 6, 2)}


@pytest.mark.parametrize("agent", ["reppo", "fast_td3", "fast_sac"])
def test_images_are_refused(agent: str) -> None:
  with pytest.raises(ConfigError, match=f"agent={agent} reads no images: choose agent=ppo"):
    build_algorithm(Seen(), config_class(agent)(), None)


@pytest.mark.parametrize("agent", ["fast_td3", "fast_sac"])
def test_hidden_activations_of_the_critics_have_the_type_of_value_dtype(agent: str) -> None:
  def logits(dtype: str) -> jax.Array:
    config = config_class(agent)()
    config = dataclasses.replace(config, network=dataclasses.replace(config.network, value_dtype=dtype))
    networks = build_algorithm(PointTask(), config, None).networks
    obs, action = {"state": jnp.full((4, 2), 0.3)}, jnp.full((4, 2), 0.2)
    return networks.q(networks.init(jax.random.PRNGKey(0)).q, obs, action)

  full, half = logits("float32"), logits("bfloat16")
  assert full.dtype == half.dtype == jnp.float32
  assert 0 < float(jnp.abs(full - half).max()) < 0.05
