"""Returns of several steps against a loop, and mirror images of transitions."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.envs.symmetry import Mirror, Reflection
from playground.errors import ConfigError
from playground.learning.off_policy import Transition, mirror_half, n_step
from tests.dummy import SMALL_FAST_SAC, point_trainer


def test_returns_of_several_steps_equal_a_loop() -> None:
  rng, discounting = np.random.default_rng(0), 0.9
  first, ends = (rng.random((4, 200)) < 0.3).astype(np.float32), (rng.random((4, 200)) < 0.5).astype(np.float32)
  reward, broken = rng.normal(size=(4, 200)).astype(np.float32), (rng.random((4, 200)) < 0.1).astype(np.float32)
  obs = {"state": np.arange(4 * 200, dtype=np.float32).reshape(4, 200, 1)}
  discount = 1 - ends
  found = n_step(Transition(obs, {"state": obs["state"] + 0.5}, obs["state"], reward, discount, broken, first), 0.9)  # pyright: ignore[reportArgumentType]
  for i in range(200):
    length = next((k for k in range(1, 4) if first[k, i]), 4)
    expected = sum(discounting**k * reward[k, i] for k in range(length))
    assert float(found.reward[i]) == pytest.approx(expected, rel=1e-5, abs=1e-6)
    assert float(found.discount[i]) == pytest.approx(discount[length - 1, i] * discounting ** (length - 1), rel=1e-5)
    assert float(found.nonfinite[i]) == broken[:length, i].max()
    assert float(found.next_obs["state"][i, 0]) == obs["state"][length - 1, i, 0] + 0.5
  np.testing.assert_array_equal(found.obs["state"], obs["state"][0])
  np.testing.assert_array_equal(found.action, obs["state"][0])


def test_half_of_the_transitions_are_their_mirror_images() -> None:
  swap = Reflection(np.array([1, 0]), np.array([1.0, -1.0], np.float32))
  x = jnp.arange(2 * 500 * 2.0).reshape(2, 500, 2)  # gradient steps, transitions, elements
  one = jnp.ones((2, 500))
  batch = Transition({"state": x}, {"state": x + 0.5}, -x, one, one, 0 * one)
  found = mirror_half(batch, Mirror({"state": swap}, swap), jax.random.PRNGKey(0))
  mirrored = (found.action != batch.action).any(axis=-1)
  assert 0.4 < mirrored.mean() < 0.6
  for before, after in ((x, found.obs["state"]), (x + 0.5, found.next_obs["state"]), (-x, found.action)):
    image = jnp.stack([before[..., 1], -before[..., 0]], axis=-1)
    np.testing.assert_array_equal(after, jnp.where(mirrored[..., None], image, before))


def test_a_task_without_a_mirror_is_refused() -> None:
  with pytest.raises(ConfigError, match=r"agent\.mirror_augmentation=true: only tasks of robots on legs"):
    point_trainer(dataclasses.replace(SMALL_FAST_SAC, mirror_augmentation=True))
