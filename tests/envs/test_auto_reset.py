"""The true last observation of an episode, beside the next one's first."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.envs.base import State
from playground.envs.wrappers import FINAL_OBS, AutoReset, wrap_for_evaluation
from tests.dummy import PointTask

N, LENGTH = 3, 4
ACTION = jnp.full((N, 2), 0.5)


def roll(steps: int, keep: bool = True, full_reset: bool = False, **kwargs: Any) -> list[State]:
  env = AutoReset(wrap_for_evaluation(PointTask(LENGTH, **kwargs)), full_reset, keep)
  states = [jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), N))]
  step = jax.jit(env.step)
  for _ in range(steps):
    states.append(step(states[-1], ACTION))
  return states


@pytest.mark.parametrize("full_reset", [False, True])
@pytest.mark.parametrize("repeat", [1, 2])
def test_an_episode_that_time_ends_shows_where_it_came_to(full_reset: bool, repeat: int) -> None:
  decisions = LENGTH // repeat
  states = roll(2 * decisions + 1, full_reset=full_reset, action_repeat=repeat)
  start = np.asarray(states[0].obs["state"])
  for i, state in enumerate(states[1:], 1):
    ends = i % decisions == 0
    np.testing.assert_array_equal(state.done, ends)
    if i % decisions == 1 or decisions == 1:
      start = np.asarray(states[i - 1].obs["state"])  # of the present episode
    moved = start + 0.1 * 0.5 * repeat * ((i - 1) % decisions + 1)
    np.testing.assert_allclose(state.info[FINAL_OBS]["state"], moved, atol=1e-6)
    same = np.array_equal(state.info[FINAL_OBS]["state"], state.obs["state"])
    assert same != ends
  if not full_reset:
    np.testing.assert_array_equal(states[decisions].obs["state"], states[0].obs["state"])


@pytest.mark.parametrize("repeat", [1, 2])
@pytest.mark.parametrize("broken", [{"nan_at": 3}, {"fast_at": 3}, {"nan_reset": True}])
def test_it_is_finite_where_the_numbers_were_not(broken: dict[str, Any], repeat: int) -> None:
  states = roll(5, action_repeat=repeat, **broken)
  for before, after in itertools.pairwise(states):
    bad = np.asarray(after.info["nonfinite"]) > 0
    for name, final in after.info[FINAL_OBS].items():
      assert np.isfinite(final).all()
      if repeat == 1:
        np.testing.assert_array_equal(final[bad], before.obs[name][bad], "the last that was finite")
  assert any((state.info["nonfinite"] > 0).any() for state in states)


@pytest.mark.parametrize("full_reset", [False, True])
def test_to_keep_it_changes_nothing_else(full_reset: bool) -> None:
  for with_it, without in zip(roll(LENGTH + 1, True, full_reset), roll(LENGTH + 1, False, full_reset), strict=True):
    info = {name: value for name, value in with_it.info.items() if name != FINAL_OBS}
    assert len(info) == len(with_it.info) - 1
    assert jax.tree.structure(with_it.replace(info=info)) == jax.tree.structure(without)
    jax.tree.map(np.testing.assert_array_equal, with_it.replace(info=info), without)
