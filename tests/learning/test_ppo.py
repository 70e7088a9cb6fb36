"""Training as a whole on a task that compiles in seconds."""

import dataclasses
from functools import cache
from typing import Any

import jax
import numpy as np
import pytest
from jax.sharding import PartitionSpec as P

from playground.errors import ConfigError
from playground.hardware.mesh import jit_on_mesh, make_mesh
from playground.learning.evaluation import make_evaluator
from playground.learning.loop import Loop, Metrics, Program, compile_program, schedule
from playground.learning.losses import Batch
from playground.learning.networks import NetworkConfig
from playground.learning.ppo import PPO, PPOConfig
from tests.dummy import SMALL, PointTask, numbers

CONFIG = PPOConfig(**SMALL, network=NetworkConfig((16, 16), (16, 16), value_obs_key="privileged_state"))


class Recorder:
  """Hooks that remember, and stop after a number of rows."""

  def __init__(self, stop_after: int | None = None):
    self.rows: list[tuple[int, Metrics]] = []
    self.saved: list[tuple[int, Any]] = []
    self.stop_after = stop_after

  def on_metrics(self, step: int, metrics: Metrics, capture: Any, recording: Any) -> None:
    self.rows.append((step, {k: v for k, v in metrics.items() if not k.startswith("time/")}))

  def on_save(self, update: int, step: int, state: Any) -> None:
    self.saved.append((update, jax.device_get(state)))

  def should_stop(self) -> bool:
    return self.stop_after is not None and len(self.rows) >= self.stop_after


@cache
def built(config: PPOConfig = CONFIG, nan_at: int | None = None) -> tuple[PPO, Program]:
  mesh = make_mesh(1)
  env = PointTask(nan_at=nan_at)
  learner = PPO(env, config, mesh, {})
  return learner, compile_program(learner, make_evaluator(env, learner.act, config.num_eval_envs, mesh, 1), {}, {})


def run(hooks: Recorder, state: Any = None, update: int | None = None, updates: int = 12, **kwargs: Any) -> Any:
  learner, program = built(**kwargs)
  loop = Loop(learner, program, schedule(updates, 3, 1, 5), seed=3, hooks=hooks, model={}, eval_model={})
  return loop.run(loop.init() if state is None else state, update)


def test_it_learns_and_reports() -> None:
  hooks = Recorder()
  config = dataclasses.replace(CONFIG, learning_rate=3e-3)
  _, completed = run(hooks, updates=150, config=config)
  assert completed
  scores = [row["eval/episode_reward"] for _, row in hooks.rows if "eval/episode_reward" in row]
  assert len(scores) == 3
  assert scores[-1] > 0.5 * scores[0], "the return is negative: half the distance is a clear gain"
  steps, last = hooks.rows[-1]
  assert steps == 150 * 160
  for name in ("training/total_loss", "training/approx_kl", "training/episode_reward", "eval/episode_distance"):
    assert np.isfinite(last[name]), name
  assert last["eval/episode_length"] == 20


def test_an_interrupted_run_goes_on_bit_for_bit() -> None:
  whole, first, second = Recorder(), Recorder(stop_after=2), Recorder()
  expected, _ = run(whole)
  expected = numbers(expected)
  _, completed = run(first)
  assert not completed
  update, saved = first.saved[-1]
  learner, _ = built()
  got, completed = run(second, learner.place(saved), update)
  assert completed
  for a, b in zip(expected, numbers(got), strict=True):
    np.testing.assert_array_equal(a, b)
  kept = [row for row in first.rows if row[0] <= update * learner.steps_per_update]
  np.testing.assert_equal([*kept, *second.rows], whole.rows)


def test_a_training_call_of_any_length_is_one_program() -> None:
  learner, _ = built()
  model: dict[str, Any] = {}
  state = learner.init(jax.random.PRNGKey(0), model)
  for updates in (1, 3, 2):
    state, _ = learner.train(state, model, np.int32(updates))
  assert learner.train._cache_size() == 1


def test_nan_is_counted_captured_and_kept_from_the_parameters() -> None:
  hooks = Recorder()
  state, _ = run(hooks, updates=4, nan_at=3)
  assert sum(row.get("training/nonfinite", 0) for _, row in hooks.rows) > 0
  for leaf in numbers((state.params, state.opt_state, state.normalizer)):
    assert np.isfinite(leaf).all()
  capture = jax.device_get(state.capture)
  assert capture.found.all()
  assert np.isfinite(capture.state.data.qpos).all()
  assert np.isnan(capture.after["qpos"]).any()


def test_a_bad_gradient_is_left_out() -> None:
  learner, _ = built()
  params: Any = learner.networks.init(jax.random.PRNGKey(0))
  opt_state = learner.optimizer.init(params)
  rng = np.random.default_rng(0)
  obs = {"state": rng.normal(size=(5, 8, 2)), "privileged_state": rng.normal(size=(5, 8, 4))}
  zeros = np.zeros((5, 8), np.float32)
  last_obs = jax.tree.map(lambda x: x[0], obs)
  batch: Any = Batch(obs, last_obs, rng.normal(size=(5, 8, 2)), zeros, zeros * np.nan, zeros, zeros)  # pyright: ignore
  step = lambda batch, carry, x: learner._sgd_step(batch, carry, x)
  mapped = jit_on_mesh(step, learner.mesh, (P(), P(), P()), P())
  columns = np.arange(8)
  (new_params, new_opt), metrics = mapped(batch, (params, opt_state), (columns, jax.random.PRNGKey(0)))
  assert metrics["nonfinite_updates"] == 1
  for a, b in zip(numbers((params, opt_state)), numbers((new_params, new_opt)), strict=True):
    np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
  ("change", "words"),
  [
    ({"num_envs": 24}, ["agent.num_envs=24", "multiple", "32"]),
    ({"num_eval_envs": 15}, ["agent.num_eval_envs=15", "devices, 2"]),
  ],
)
def test_sizes_that_do_not_divide_are_refused(change: dict[str, Any], words: list[str]) -> None:
  with pytest.raises(ConfigError) as error:
    dataclasses.replace(CONFIG, **change).check(num_devices=2)
  assert all(word in str(error.value) for word in words)


def test_an_observation_entry_that_is_not_there_is_named() -> None:
  config = dataclasses.replace(CONFIG, network=NetworkConfig(value_obs_key="priviledged_state"))
  with pytest.raises(ConfigError, match=r"agent.network.value_obs_key='priviledged_state'.*Did you mean 'privileged"):
    PPO(PointTask(), config, make_mesh(1), {})
