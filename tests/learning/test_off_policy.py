"""Returns of several steps against a loop."""

import numpy as np
import pytest

from playground.learning.off_policy import Transition, n_step


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
