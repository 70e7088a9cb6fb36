"""Batching, episode limits, resets and the guard against non-finite numbers, on a task without physics."""

import itertools
from collections.abc import Mapping
from functools import cache
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.envs import wrappers
from playground.envs.base import State
from playground.errors import ConfigError
from tests.dummy import PointTask

N, LENGTH = 3, 4


class Counting(PointTask):
  """Counts its steps in info, in a preserved part too, and terminates at `die_at` steps."""

  def __init__(self, die_at: int | None = None, **kwargs: Any):
    super().__init__(**kwargs)
    self.die_at = die_at

  def reset(self, rng: jax.Array, model: Any = None) -> State:
    state = super().reset(rng)
    return state.replace(info=state.info | {wrappers.PRESERVE_INFO: {"total": jnp.zeros(())}})

  def post_step(self, data: Any, info: Any, action: jax.Array) -> State:
    state = super().post_step(data, info, action)
    total = info[wrappers.PRESERVE_INFO]["total"] + 1
    done = state.done if self.die_at is None else jnp.where(state.info["age"] == self.die_at, 1.0, state.done)
    return state.replace(done=done, info=state.info | {wrappers.PRESERVE_INFO: {"total": total}})


@cache
def stack(full_reset: bool = False, repeat: int = 1, **events: int) -> Any:
  env = Counting(episode_length=LENGTH, action_repeat=repeat, **events)
  wrapped = wrappers.wrap_for_training(env, full_reset=full_reset)
  return jax.jit(wrapped.reset), jax.jit(wrapped.step)


def roll(steps: int, **kwargs: Any) -> list[State]:
  reset, step = stack(**kwargs)
  states = [reset(jax.random.split(jax.random.PRNGKey(0), N))]
  for _ in range(steps):
    states.append(step(states[-1], jnp.full((N, 2), 0.1)))
  return states


@pytest.mark.parametrize("full_reset", [False, True])
def test_time_outs_are_truncations_and_not_terminations(full_reset: bool) -> None:
  states = roll(2 * LENGTH, full_reset=full_reset)
  done = np.array([s.done for s in states])
  truncation = np.array([s.info["truncation"] for s in states])
  expected = np.zeros((2 * LENGTH + 1, N))
  expected[[LENGTH, 2 * LENGTH]] = 1
  np.testing.assert_array_equal(done, expected)
  np.testing.assert_array_equal(truncation, expected)
  assert [int(s.info["steps"][0]) for s in states] == [0, 1, 2, 3, 4, 1, 2, 3, 4]
  np.testing.assert_array_equal(states[-1].info["AutoResetWrapper_done_count"], [2] * N)


@pytest.mark.parametrize("full_reset", [False, True])
def test_a_task_that_ends_itself_is_not_truncated(full_reset: bool) -> None:
  states = roll(2, full_reset=full_reset, die_at=2)
  np.testing.assert_array_equal(states[2].done, 1)
  np.testing.assert_array_equal(states[2].info["truncation"], 0)


@pytest.mark.parametrize(
  ("repeat", "cut_at", "die_at", "truncation"),
  [(1, 1, None, [1]), (1, 2, None, [0, 1]), (2, 2, None, [1]), (2, 1, 2, [1]), (2, 2, 1, [0])],  # the first end counts
)
def test_a_term_with_time_out_truncates(repeat: int, cut_at: int, die_at: int | None, truncation: list[int]) -> None:
  class Cut(Counting):
    def reset(self, rng: jax.Array, model: Any = None) -> State:
      state = super().reset(rng)
      return state.replace(info=state.info | {"time_out": jnp.zeros(())})

    def post_step(self, data: Any, info: Any, action: jax.Array) -> State:
      state = super().post_step(data, info, action)
      cut = (state.info["age"] == cut_at).astype(float)
      return state.replace(done=jnp.maximum(state.done, cut), info=state.info | {"time_out": cut})

  env = wrappers.wrap_for_training(Cut(episode_length=9, action_repeat=repeat, die_at=die_at))
  state, step = env.reset(jax.random.split(jax.random.PRNGKey(0), N)), jax.jit(env.step)
  for expected in truncation:
    state = step(state, jnp.zeros((N, 2)))
    np.testing.assert_array_equal(state.info["truncation"], expected)
  np.testing.assert_array_equal(state.done, 1)


def test_cached_reset_returns_to_the_first_state_and_keeps_info() -> None:
  states = roll(LENGTH + 1)
  np.testing.assert_array_equal(states[LENGTH].data.qpos, states[0].data.qpos)
  np.testing.assert_array_equal(states[LENGTH].obs["state"], states[0].obs["state"])
  np.testing.assert_array_equal(states[LENGTH].info["age"], LENGTH)
  assert (states[LENGTH].reward != 0).all(), "the last step's reward is kept"


def test_what_belongs_to_an_episode_starts_over_with_it() -> None:
  class Remembering(Counting):
    episode_info = ("age",)

  env = wrappers.wrap_for_training(Remembering(episode_length=LENGTH))
  state, step = env.reset(jax.random.split(jax.random.PRNGKey(0), N)), jax.jit(env.step)
  ages = []
  for _ in range(LENGTH + 1):
    state = step(state, jnp.zeros((N, 2)))
    ages.append(int(state.info["age"][0]))
  assert ages == [1, 2, 3, 0, 1]
  np.testing.assert_array_equal(state.info[wrappers.PRESERVE_INFO]["total"], LENGTH + 1)  # the rest goes on


def test_an_auto_reset_redraws_where_a_task_asks_for_it() -> None:
  class Redrawing(Counting):
    redraws = True

    def redraw(self, info: dict[str, Any], key: jax.Array, model: Any) -> dict[str, Any]:
      return info | {"time": jax.random.uniform(key)}

  env = wrappers.wrap_for_training(Redrawing(episode_length=LENGTH))
  state, step = env.reset(jax.random.split(jax.random.PRNGKey(0), N)), jax.jit(env.step)
  drawn = []
  for _ in range(2 * LENGTH):
    state = step(state, jnp.zeros((N, 2)))
    drawn.append(np.asarray(state.info["time"]))
  assert not np.any(drawn[: LENGTH - 1])
  first, second = drawn[LENGTH - 1], drawn[2 * LENGTH - 1]
  assert len(np.unique([*first, *second])) == 2 * N
  np.testing.assert_array_equal(drawn[2 * LENGTH - 2], first)


@pytest.mark.parametrize("full_reset", [False, True])
def test_the_last_observation_of_an_episode_may_be_kept(full_reset: bool) -> None:
  episodes = wrappers.wrap_for_evaluation(Counting(episode_length=LENGTH))
  env = wrappers.AutoReset(episodes, full_reset, keep_final_obs=True)
  state, step = env.reset(jax.random.split(jax.random.PRNGKey(0), N)), jax.jit(env.step)
  for count in range(1, LENGTH + 2):
    before, state = state, step(state, jnp.full((N, 2), 0.1))
    final = state.info[wrappers.FINAL_OBS]["state"]
    np.testing.assert_allclose(final, before.obs["state"] + 0.01, rtol=1e-5)  # pyright: ignore
    assert np.array_equal(final, state.obs["state"]) == (count != LENGTH)  # pyright: ignore


def test_full_reset_draws_anew_and_keeps_what_is_preserved() -> None:
  states = roll(2 * LENGTH, full_reset=True)
  first, second, third = (states[i].data.qpos for i in (0, LENGTH, 2 * LENGTH))
  assert not np.allclose(first, second) and not np.allclose(second, third)
  np.testing.assert_array_equal(states[LENGTH].info["age"], 0)
  np.testing.assert_array_equal(states[LENGTH].info[wrappers.PRESERVE_INFO]["total"], LENGTH)
  np.testing.assert_array_equal(states[LENGTH].info["episode_metrics"]["length"], LENGTH)


def test_episode_metrics_sum_one_episode() -> None:
  states = roll(LENGTH + 1)
  rewards = np.array([s.reward for s in states[1:]])
  np.testing.assert_allclose(states[LENGTH].info["episode_metrics"]["sum_reward"], rewards[:LENGTH].sum(0), rtol=1e-6)
  np.testing.assert_allclose(states[LENGTH + 1].info["episode_metrics"]["sum_reward"], rewards[LENGTH], rtol=1e-6)


@pytest.mark.parametrize(("kind", "expected"), [("mean", -2.0), ("max", -2.0)])
def test_a_summary_is_of_the_steps_taken_where_an_episode_begins_at_a_random_age(kind: str, expected: float) -> None:
  class Constant(Counting):
    summaries: ClassVar[Mapping[str, str]] = {"constant": kind}

    def reset(self, rng: jax.Array, model: Any = None) -> State:
      return super().reset(rng, model).replace(metrics={"constant": jnp.zeros(())})

    def post_step(self, data: Any, info: Any, action: jax.Array) -> State:
      return super().post_step(data, info, action).replace(metrics={"constant": jnp.float32(-2)})

  wrapped = wrappers.wrap_for_training(Constant(episode_length=LENGTH))
  state = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), N))
  state = state.replace(info=state.info | {"steps": state.info["steps"] + 2})
  for _ in range(2):
    state = jax.jit(wrapped.step)(state, jnp.full((N, 2), 0.1))
    np.testing.assert_allclose(state.info["episode_metrics"]["constant"], expected)


def test_a_class_adds_to_what_its_base_classes_name() -> None:
  class Above(Counting):
    summaries: ClassVar[Mapping[str, str]] = {"a": "last", "b": "last"}
    episode_info = ("a",)

  class Beside(Counting):
    episode_info = ("c",)

  class Below(Above, Beside):
    summaries: ClassVar[Mapping[str, str]] = {"b": "max"}
    episode_info = ("b", "a")

  class Apart(Below):
    adds = False
    episode_info = ()

  assert (Below.summaries, Below.episode_info) == ({"a": "last", "b": "max"}, ("a", "c", "b"))
  assert (Apart.summaries, Apart.episode_info) == (Below.summaries, ())


def test_a_name_that_a_task_adds_must_exist() -> None:
  class Summary(Counting):
    summaries: ClassVar[Mapping[str, str]] = {"distanse": "last"}

    def reset(self, rng: jax.Array, model: Any = None) -> State:
      return super().reset(rng, model).replace(metrics={"distance": jnp.zeros(())})

  class Entry(Counting):
    episode_info = ("agee",)

  for cls, message in ((Summary, "Summary.summaries: 'distanse'"), (Entry, "Entry.episode_info: 'agee'")):
    with pytest.raises(ConfigError, match=rf"^{message} is unknown.*Did you mean"):
      wrapped = wrappers.wrap_for_training(cls(episode_length=LENGTH))
      jax.eval_shape(wrapped.reset, jax.random.split(jax.random.PRNGKey(0), N))


def test_an_unknown_summary_is_one_sentence() -> None:
  class Wrong(Counting):
    summaries: ClassVar[Mapping[str, str]] = {"constant": "avg"}

  with pytest.raises(ConfigError, match=r"^Wrong\.summaries\['constant'\]: 'avg' is unknown; choose from sum, mean"):
    wrappers.wrap_for_training(Wrong(episode_length=LENGTH))


def test_action_repeat_sums_rewards_and_stops_at_a_termination() -> None:
  single = np.array([s.reward for s in roll(2, repeat=1)])
  np.testing.assert_allclose(roll(1, repeat=2)[1].reward, single[1] + single[2], rtol=1e-5)
  ended = roll(1, repeat=2, die_at=1)[1]
  np.testing.assert_array_equal(ended.done, 1)
  np.testing.assert_allclose(ended.reward, single[1], rtol=1e-5)


@pytest.mark.parametrize("kind", ["sum", "max", "mean", "last"])
@pytest.mark.parametrize("die_at", [None, 2])
def test_a_metric_is_of_all_repeats_of_an_action(kind: str, die_at: int | None) -> None:
  class Timed(Counting):
    """Its metric in control step n is 1/n."""

    summaries: ClassVar[Mapping[str, str]] = {"metric": kind} if kind != "sum" else {}

    def reset(self, rng: jax.Array, model: Any = None) -> State:
      return super().reset(rng, model).replace(metrics={"metric": jnp.zeros(())})

    def post_step(self, data: Any, info: Any, action: jax.Array) -> State:
      state = super().post_step(data, info, action)
      return state.replace(metrics={"metric": 1 / state.info["age"]})

  wrapped = wrappers.wrap_for_training(Timed(die_at, episode_length=LENGTH, action_repeat=4))
  state = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), N))
  after = jax.jit(wrapped.step)(state, jnp.full((N, 2), 0.1))
  values = [1 / n for n in range(1, (die_at or 4) + 1)]  # what comes after an episode's end is not part of it
  expected = {"sum": sum(values), "max": 1, "mean": np.mean(values), "last": values[-1]}[kind]
  np.testing.assert_allclose(after.metrics["metric"], expected, rtol=1e-6)
  np.testing.assert_allclose(after.info["episode_metrics"]["metric"], expected, rtol=1e-6)


@pytest.mark.parametrize("full_reset", [False, True])
def test_a_nan_ends_the_episode_and_goes_no_further(full_reset: bool) -> None:
  states = roll(4, full_reset=full_reset, nan_at=2)
  assert [int(s.info["nonfinite"].sum()) for s in states] == [0, 0, N, *([N, N] if not full_reset else [0, N])][:5]
  bad = states[2]
  np.testing.assert_array_equal(bad.done, 1)
  np.testing.assert_array_equal(bad.reward, 0)
  assert np.isnan(bad.info["nonfinite_state"]["qpos"]).any()
  for leaf in jax.tree.leaves((bad.obs, bad.reward, bad.metrics, bad.data.qpos, bad.info["episode_metrics"])):
    assert np.isfinite(leaf).all()


@pytest.mark.parametrize("full_reset", [False, True])
def test_an_episode_with_nan_in_its_first_observation_sees_zeros_and_ends(full_reset: bool) -> None:
  states = roll(3, full_reset=full_reset, nan_reset=True)
  for state in states:
    for leaf in jax.tree.leaves((state.obs, state.reward, state.metrics, state.info["episode_metrics"])):
      assert np.isfinite(leaf).all()
  for before, after in itertools.pairwise(states):
    broken = np.asarray(before.info["nonfinite_reset"])
    np.testing.assert_array_equal(after.info["nonfinite"], broken)
    np.testing.assert_array_equal(np.asarray(after.done)[broken], 1)
    np.testing.assert_array_equal(np.asarray(before.obs["state"])[broken], 0)
  assert 0 < np.sum([state.info["nonfinite"] for state in states]) < 3 * N


def test_an_absurd_velocity_counts_as_not_finite() -> None:
  states = roll(3, fast_at=2)
  assert [int(s.info["nonfinite"].sum()) for s in states[:3]] == [0, 0, N]
  np.testing.assert_array_equal(states[2].done, 1)
  np.testing.assert_array_equal(states[2].reward, 0)
  np.testing.assert_array_equal(jnp.abs(states[2].data.qvel) < wrappers.MAX_VELOCITY, True)


def test_a_repeat_that_slows_down_again_does_not_hide_an_absurd_velocity() -> None:
  class Spike(Counting):
    def step(self, state: State, action: jax.Array, model: Any = None) -> State:
      after = super().step(state, action, model)
      speed = jnp.where(state.data.qvel == 0, 2 * wrappers.MAX_VELOCITY, 1.0)  # in the step from rest
      return after.replace(data=after.data.replace(qvel=speed))

  env = wrappers.wrap_for_training(Spike(episode_length=LENGTH, action_repeat=2))
  state = jax.jit(env.step)(env.reset(jax.random.split(jax.random.PRNGKey(0), N)), jnp.full((N, 2), 0.1))
  np.testing.assert_array_equal(state.info["nonfinite"], 1)
  np.testing.assert_array_equal(state.reward, 0)


def test_a_property_that_fails_is_not_answered_by_the_task() -> None:
  class Broken(wrappers.Wrapper):
    @property
    def observation_size(self) -> int:
      raise AttributeError("no renderer")

  with pytest.raises(AttributeError, match="no renderer"):
    _ = Broken(PointTask()).observation_size
  assert Broken(PointTask()).action_size == PointTask().action_size
