"""The replay buffer: what is put in comes out, the newest replace the oldest, all are drawn alike."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.learning.replay import Replay, ReplayBuffer

ENVS, SLOTS = 4, 5
EXAMPLE = {"obs": {"state": np.zeros(3), "more": np.zeros((2, 2))}, "reward": np.zeros(())}
BUFFER = ReplayBuffer(SLOTS * ENVS + 3, ENVS, EXAMPLE)


def step(t: int) -> dict[str, Any]:
  """What all environments saw at time t: the number of the transition, 10 t + environment, everywhere."""
  return jax.tree.map(lambda x: jnp.stack([jnp.full(x.shape, 10.0 * t + i) for i in range(ENVS)]), EXAMPLE)


def filled(steps: int) -> Replay:
  replay, insert = BUFFER.init(ENVS), jax.jit(BUFFER.insert)
  for t in range(steps):
    replay = insert(replay, step(t))
  return replay


def test_its_size_is_what_it_says() -> None:
  assert (BUFFER.size, BUFFER.width) == (SLOTS * ENVS, 8)
  assert BUFFER.nbytes == filled(0).data.nbytes


def test_only_what_was_put_in_is_drawn_and_all_of_it_alike() -> None:
  drawn = BUFFER.sample(filled(2), jax.random.PRNGKey(0), (10, 400))
  assert drawn["obs"]["state"].shape == (10, 400, 3)
  assert drawn["obs"]["more"].shape == (10, 400, 2, 2)
  values, counts = np.unique(drawn["reward"], return_counts=True)
  assert values.tolist() == [0, 1, 2, 3, 10, 11, 12, 13]
  assert np.all(np.abs(counts - 500) < 100), "4000 draws of 8"
  for leaf in jax.tree.leaves(drawn["obs"]):
    whose = drawn["reward"].reshape(10, 400, *(1,) * (leaf.ndim - 2))
    np.testing.assert_array_equal(leaf, np.broadcast_to(whose, leaf.shape))


def test_the_newest_replace_the_oldest() -> None:
  replay = filled(SLOTS + 2)
  drawn = BUFFER.sample(replay, jax.random.PRNGKey(0), (2000,))["reward"]
  assert np.unique(drawn // 10).tolist() == [2, 3, 4, 5, 6]
  assert (int(BUFFER.held(replay)), int(replay.inserted)) == (SLOTS, SLOTS + 2)


@pytest.mark.parametrize(("steps", "starts"), [(3, [0]), (SLOTS, [0, 1, 2]), (SLOTS + 2, [2, 3, 4])])
def test_windows_are_successive_steps_of_one_environment(steps: int, starts: list[int]) -> None:
  drawn = BUFFER.sample_windows(filled(steps), jax.random.PRNGKey(0), (2, 300), 3)
  assert drawn["obs"]["more"].shape == (3, 2, 300, 2, 2)
  times = np.asarray(drawn["reward"]).reshape(3, -1)
  np.testing.assert_array_equal(np.diff(times, axis=0), 10)
  assert np.unique(times[0]).tolist() == [10 * start + env for start in starts for env in range(ENVS)]
