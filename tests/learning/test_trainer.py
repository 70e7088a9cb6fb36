"""Training as a whole, with every algorithm, on a task that compiles in seconds."""

import dataclasses
import inspect
import os
import subprocess
import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.envs.base import State
from playground.envs.wrappers import PRESERVE_INFO
from playground.errors import ConfigError
from playground.hardware.mesh import make_mesh
from playground.learning import loop as loop_module
from playground.learning.algorithm import Algorithm, other_acts
from playground.learning.evaluation import make_evaluator
from playground.learning.hyperparameters import PPOConfig
from playground.learning.loop import CompiledFunctions, Loop, compile_program, schedule
from playground.learning.ppo import PPO
from playground.learning.stored_program import StoredProgram
from playground.learning.trainer import Trainer, trainer_settings
from playground.mdp.context import StepContext
from playground.mdp.managers import RewardManager
from playground.physics.backend import PhysicsData
from tests.dummy import (
  SMALL,
  Config,
  PointTask,
  Recorder,
  numbers,
  point_trainer,
)
from tests.processes import WITHOUT_WARP


def algorithms(*fast: str) -> pytest.MarkDecorator:
  """A parameter `config`, of every algorithm: those that are not named only by `make test-slow`."""
  marks = {name: [pytest.mark.slow] * (name not in fast) for name in SMALL}
  return pytest.mark.parametrize("config", [pytest.param(SMALL[name], id=name, marks=marks[name]) for name in SMALL])


every_algorithm = algorithms("ppo", "sac", "reppo", "fast_td3")  # FastSAC's training step is SAC's and FastTD3's
two_of_them = algorithms("ppo", "sac")  # where each compiles a trainer of its own: one on and one off policy


@cache
def built(config: Config, **events: Any) -> tuple[Trainer, CompiledFunctions]:
  trainer = point_trainer(config, **events)
  others = other_acts(trainer.algorithm)
  evaluate = make_evaluator(trainer.env.unwrapped, trainer.act, config.num_eval_envs, trainer.mesh, 1, others)
  return trainer, compile_program(trainer, evaluate, lambda: ({}, {}))


@pytest.mark.parametrize("is_stored", [True, False])
def test_programs_are_compiled_with_xlas_options(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, is_stored: bool):
  monkeypatch.setattr(loop_module, "compiler_options", lambda *_: {"no_such_option": "1"})
  trainer, stored = point_trainer(SMALL["ppo"]), StoredProgram(tmp_path / "one.program") if is_stored else None
  evaluate = jax.jit(lambda policy, key, model, settings: ())
  with pytest.raises(Exception, match="no_such_option"):
    compile_program(trainer, evaluate, lambda: ({}, {}), stored=stored)


def run(
  config: Config,
  callbacks: Recorder,
  updates: int = 12,
  resumed: tuple[Any, int] | None = None,
  seed: int = 3,
  **events: Any,
) -> tuple[Any, bool]:
  trainer, program = built(config, **events)
  marks = schedule(updates, 3, 1, max(5, updates // 20))
  loop = Loop(trainer, program, marks, seeds=[seed], callbacks=[callbacks])
  return loop.run(*(resumed or (loop.init(), None)))


def test_the_interface_of_an_algorithm_is_small() -> None:
  methods = [name for name, _ in inspect.getmembers(Algorithm, inspect.isfunction) if not name.startswith("_")]
  assert len(methods) <= 5
  assert Algorithm.__abstractmethods__ == {"init", "train_step"}


@pytest.mark.parametrize(
  ("name", "updates", "names"),
  [
    ("ppo", 150, ("training/total_loss", "training/approx_kl", "training/grad_norm", "eval/mode/episode_reward")),
    ("sac", 1500, ("training/critic_loss", "training/entropy", "training/grad_norm", "eval/mode/episode_reward")),
    ("reppo", 150, ("training/critic_loss", "training/kl", "training/grad_norm", "eval/sampled/episode_reward")),
    ("fast_td3", 1500, ("training/critic_loss", "training/q_mean", "training/grad_norm")),
    pytest.param(
      *("fast_sac", 1500, ("training/critic_loss", "training/entropy", "eval/sampled/episode_reward")),
      marks=pytest.mark.slow,
    ),
  ],
)
def test_it_learns_and_reports(name: str, updates: int, names: tuple[str, ...]) -> None:
  callbacks, config = Recorder(), SMALL[name]
  _, completed = run(config, callbacks, updates=updates)
  assert completed
  scores = [row["eval/episode_reward"] for _, row in callbacks.rows if "eval/episode_reward" in row]
  assert len(scores) == 3
  assert scores[-1] > 0.5 * scores[0], "the return is negative: half the distance is a clear gain"
  steps, last = callbacks.rows[-1]
  assert steps == updates * built(config)[0].steps_per_update
  for name in (*names, "training/episode_reward", "eval/episode_distance"):
    assert np.isfinite(last[name]), name
  assert last["eval/episode_length"] == 20


@every_algorithm
def test_an_interrupted_run_goes_on_bit_for_bit(config: Config) -> None:
  whole, first, second = Recorder(), Recorder(stop_after=2), Recorder()
  expected, _ = run(config, whole)
  expected = numbers(expected)
  _, completed = run(config, first)
  assert not completed
  update, saved = first.saved[-1]
  trainer, _ = built(config)
  got, completed = run(config, second, resumed=(trainer.place(saved), update))
  assert completed
  for a, b in zip(expected, numbers(got), strict=True):
    np.testing.assert_array_equal(a, b)
  kept = [row for row in first.rows if row[0] <= update * trainer.steps_per_update]
  np.testing.assert_equal([*kept, *second.rows], whole.rows)


@two_of_them
def test_long_training_calls_are_divided_and_end_when_the_run_is_to_stop(
  config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
  whole, divided, first, second = Recorder(), Recorder(), Recorder(stop_after=0), Recorder()
  expected = numbers(run(config, whole)[0])
  monkeypatch.setattr(loop_module, "CALL_S", 0.0)
  for a, b in zip(expected, numbers(run(config, divided)[0]), strict=True):
    np.testing.assert_array_equal(a, b)
  np.testing.assert_equal(divided.rows, whole.rows, "the rows do not depend on the calls")
  _, completed = run(config, first)
  (update, saved), trainer = first.saved[-1], built(config)[0]
  assert not completed and update == 1, "the first event is after five training steps"
  assert [step for step, _ in first.rows] == [0, trainer.steps_per_update]
  got, completed = run(config, second, resumed=(trainer.place(saved), update))
  assert completed and [step for step, _ in second.rows] == [step for step, _ in whole.rows[1:]]
  for a, b in zip(expected, numbers(got), strict=True):
    np.testing.assert_array_equal(a, b)


@every_algorithm
def test_a_training_call_of_any_length_is_one_program(config: Config) -> None:
  trainer, _ = built(config)
  model: dict[str, Any] = {}
  state = trainer.init(jax.random.PRNGKey(0), model, None, trainer.settings)
  for updates in (1, 3, 2):
    state, _ = trainer.train(state, model, np.int32(updates))
  assert trainer.train._cache_size() == 1


@two_of_them
def test_nan_in_first_observations_is_counted_and_kept_from_what_is_learned(config: Config) -> None:
  trainer, program = built(config, nan_reset=True)
  state = program.init(jax.random.PRNGKey(0), {}, None, trainer.settings)
  broken = np.asarray(state.env_state.info["nonfinite_reset"])
  assert 0 < broken.sum() < len(broken)
  state, metrics = program.train(state, {}, np.int32(8))
  assert metrics["nonfinite"] == broken.mean() * 8 * trainer.steps_per_update, "every step of these counts"
  for leaf in numbers(state.replace(capture=None, env_state=None)):
    assert np.isfinite(leaf).all()


@two_of_them
def test_nan_is_counted_captured_and_kept_from_the_parameters(config: Config) -> None:
  callbacks = Recorder()
  state, _ = run(config, callbacks, updates=8, nan_at=3)
  assert sum(row.get("training/nonfinite", 0) for _, row in callbacks.rows) > 0
  for leaf in numbers(state.replace(capture=None, env_state=None)):
    assert np.isfinite(leaf).all()
  captured = [captured for captured in callbacks.captured if captured]
  assert np.isfinite(captured[0].state.data.qpos).all()
  assert np.isnan(captured[0].after["qpos"]).any()


class Rising(PointTask):
  """Its level rises with every step and outlasts full resets."""

  def reset(self, rng: jax.Array, model: Any = None) -> State:
    state = super().reset(rng)
    return state.replace(info=state.info | {PRESERVE_INFO: {"level": jnp.zeros(())}})

  def post_step(self, data: Any, info: Any, action: jax.Array) -> State:
    state = super().post_step(data, info, action)
    return state.replace(info=state.info | {PRESERVE_INFO: {"level": info[PRESERVE_INFO]["level"] + 1}})


@algorithms("ppo")
def test_a_fresh_start_of_all_environments_keeps_what_outlasts_a_reset(config: Config) -> None:
  trainer = Trainer(Rising(), config, make_mesh(1))
  model: dict[str, Any] = {}
  state, _ = trainer.train(trainer.init(jax.random.PRNGKey(0), model, None, trainer.settings), model, np.int32(1))
  before = jax.device_get(state.env_state)
  after = jax.device_get(trainer.reset(state, jax.random.PRNGKey(1), model).env_state)
  assert (before.info[PRESERVE_INFO]["level"] > 0).all()
  np.testing.assert_array_equal(after.info[PRESERVE_INFO]["level"], before.info[PRESERVE_INFO]["level"])
  assert not after.info["age"].any() and not np.array_equal(after.data.qpos, before.data.qpos)


@every_algorithm
def test_a_mean_over_nothing_is_left_out(config: Config) -> None:
  callbacks = Recorder()
  run(config, callbacks, updates=1)
  _, row = callbacks.rows[-1]
  assert row["training/episodes"] == 0
  assert not [name for name in row if name.startswith("training/episode_")]
  assert not any(np.isnan(value) for value in row.values())


def test_no_torch_is_imported() -> None:
  code = "import sys, playground.runs.train, playground.cli.main; assert not {'torch', 'rsl_rl'} & set(sys.modules)"
  subprocess.run([sys.executable, "-c", code], env=os.environ | WITHOUT_WARP, check=True)


class Weighted(PointTask):
  """A point whose reward has a term with a weight."""

  managers = ("rewards",)
  robot: Any = None

  def __init__(self, weight: float):
    super().__init__()
    self.config = {"rewards": {"action_l2": {"weight": weight}}}
    self.rewards = RewardManager(self.config["rewards"])

  def post_step(self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array) -> State:
    state, c = super().post_step(data, info, action), StepContext(cast(Any, self), data, info, action)
    return state.replace(reward=sum(self.rewards.compute(c).values(), state.reward))


class Constant(PPO):
  """Reads an argument of the program where it would be a constant."""

  def __init__(self, env: Any, config: PPOConfig, network_precision: str | None = None):
    super().__init__(env, config, network_precision)
    self.rate = 2 * config.learning_rate


class ConstantConfig(PPOConfig):
  algorithm = "tests.learning.test_trainer:Constant"


def test_a_constructor_cannot_read_an_argument_of_the_program() -> None:
  with pytest.raises(TypeError, match="TracedSetting"):
    point_trainer(ConstantConfig())


class Halves(PPO):
  """Returns too little."""

  def train_step(self, *args: Any) -> Any:
    return super().train_step(*args)[:2]


class Unfinished(Algorithm):
  """Lacks what an algorithm must have."""


@pytest.mark.parametrize(
  ("algorithm", "traced", "message"),
  [
    (
      "tests.learning.test_trainr:Halves",
      (),
      r"algorithm=.*: there is no module tests\.learning\.test_trainr \(installed, or on PYTHONPATH\)\.$",
    ),
    ("tests.learning.test_trainer:Halve", (), r"Did you mean 'Halves'"),
    ("tests.learning.test_trainer:Unfinished", (), r"Unfinished lacks the method init and train_step\."),
    ("tests.learning.test_trainer:Halves", ("learning_rat",), r"\.traced.*Did you mean 'learning_rate'"),
    ("tests.learning.test_trainer:Halves", (), r"^Halves\.train_step must return state, environments and metrics"),
  ],
)
def test_a_mistake_in_an_algorithm_is_one_sentence(algorithm: str, traced: tuple[str, ...], message: str) -> None:
  config = type("MistakenConfig", (PPOConfig,), {"algorithm": algorithm, "traced": traced})()
  with pytest.raises(ConfigError, match=message):
    trainer = point_trainer(config)
    jax.eval_shape(trainer.train, trainer.template({}), {}, 1)


@algorithms("ppo")
def test_agents_of_one_program_end_as_they_do_alone(config: Config) -> None:
  faster = dataclasses.replace(config, learning_rate=2 * config.learning_rate)
  agents = [(config, 0.1, 3), (faster, 0.1, 3), (config, 0.1, 4), (config, -0.5, 3)]
  alone, callbacks = [Recorder() for _ in agents], [Recorder() for _ in agents]
  env, marks = Weighted(0.1), schedule(12, 3, 1, 5)
  settings = [trainer_settings(each, env.settings_of(Weighted(weight).config)) for each, weight, _ in agents]

  def compiled(trainer: Trainer) -> CompiledFunctions:
    evaluate = make_evaluator(env, trainer.act, config.num_eval_envs, trainer.mesh, 1, other_acts(trainer.algorithm))
    return compile_program(trainer, evaluate, lambda: ({}, {}))

  expected, single = [], Trainer(env, config, make_mesh(1))
  program = compiled(single)  # of the first agent: the settings of the others are other arguments
  assert single.settings == settings[0]
  for (_, _, seed), single.settings, recorder in zip(agents, settings, alone, strict=True):
    loop = Loop(single, program, marks, [seed], [recorder])
    expected.append(loop.run(loop.init())[0])

  trainer = Trainer(env, config, make_mesh(1), agents=settings)
  loop = Loop(trainer, compiled(trainer), marks, [seed for _, _, seed in agents], callbacks)
  state, completed = loop.run(loop.init())
  assert completed
  for i, (theirs, recorder) in enumerate(zip(expected, alone, strict=True)):
    got = trainer.policy(trainer.agent(jax.device_get(state), i))
    for a, b in zip(numbers(got), numbers(trainer.policy(theirs)), strict=True):
      np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3)
    assert [step for step, _ in callbacks[i].rows] == [step for step, _ in recorder.rows]
    assert callbacks[i].rows[-1][1].keys() == recorder.rows[-1][1].keys()
    assert [update for update, _ in callbacks[i].saved] == [update for update, _ in recorder.saved]
    if i:
      first, other = (numbers(trainer.policy(trainer.agent(state, j)))[0] for j in (0, i))
      assert not np.array_equal(first, other)
