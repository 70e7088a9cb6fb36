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
HALF = ReplayBuffer(SLOTS * ENVS + 3, ENVS, EXAMPLE, dtype=jnp.bfloat16)
both = pytest.mark.parametrize("buffer", [BUFFER, HALF], ids=["float32", "bfloat16"])


def step(t: int) -> dict[str, Any]:
  """What all environments saw at time t: the number of the transition, 10 t + environment, everywhere."""
  return jax.tree.map(lambda x: jnp.stack([jnp.full(x.shape, 10.0 * t + i) for i in range(ENVS)]), EXAMPLE)


def filled(steps: int, buffer: ReplayBuffer = BUFFER) -> Replay:
  replay, insert = buffer.init(ENVS), jax.jit(buffer.insert)
  for t in range(steps):
    replay = insert(replay, step(t))
  return replay


@both
def test_its_size_is_what_it_says(buffer: ReplayBuffer) -> None:
  assert (buffer.size, buffer.width) == (SLOTS * ENVS, 8)
  assert buffer.nbytes == buffer.init(ENVS).data.nbytes
  assert buffer.nbytes == SLOTS * ENVS * (8 * 4 if buffer is BUFFER else 7 * 2 + 4)


def test_bfloat16_rounds_arrays_and_keeps_single_numbers() -> None:
  draw = lambda i, *shape: 100 * jax.random.normal(jax.random.PRNGKey(i), (ENVS, *shape))
  reward = draw(2).at[0].set(1 + 2.0**-20)
  given = {"obs": {"state": draw(0, 3), "more": draw(1, 2, 2)}, "reward": reward}
  replay = HALF.insert(HALF.init(ENVS), given)
  drawn = HALF.sample(replay, jax.random.PRNGKey(0), (100,))
  which = (drawn["reward"][:, None] == reward).argmax(axis=1)
  assert set(np.unique(which)) == set(range(ENVS)), "rewards come out as they were"
  for found, expected in zip(jax.tree.leaves(drawn), jax.tree.leaves(given), strict=True):
    assert found.dtype == jnp.float32
    rounded = expected.astype(jnp.bfloat16).astype(jnp.float32) if expected.ndim > 1 else expected
    np.testing.assert_array_equal(found, rounded[which])


@both
def test_only_what_was_put_in_is_drawn_and_all_of_it_alike(buffer: ReplayBuffer) -> None:
  drawn = buffer.sample(filled(2, buffer), jax.random.PRNGKey(0), (10, 400))
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


@both
@pytest.mark.parametrize(("steps", "starts"), [(3, [0]), (SLOTS, [0, 1, 2]), (SLOTS + 2, [2, 3, 4])])
def test_windows_are_successive_steps_of_one_environment(steps: int, starts: list[int], buffer: ReplayBuffer) -> None:
  drawn = buffer.sample_windows(filled(steps, buffer), jax.random.PRNGKey(0), (2, 300), 3)
  assert drawn["obs"]["more"].shape == (3, 2, 300, 2, 2)
  times = np.asarray(drawn["reward"]).reshape(3, -1)
  np.testing.assert_array_equal(np.diff(times, axis=0), 10)
  assert np.unique(times[0]).tolist() == [10 * start + env for start in starts for env in range(ENVS)]
