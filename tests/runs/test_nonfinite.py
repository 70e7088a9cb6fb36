"""Runs whose numbers go NaN or infinite: counted, dumped, kept out of what learns, and replayed."""

import dataclasses
import math
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas as pd
import pytest

from playground import registry
from playground.cli.replay import replay
from playground.config import compose
from playground.errors import CheckpointError
from playground.learning import algorithm
from playground.learning.checkpoints import find_checkpoints
from playground.learning.rollout import Step
from playground.runs.callbacks import NonfiniteError
from playground.runs.nonfinite import Dump, nonfinite_results, write_dump
from playground.runs.run_dir import RunDirectory
from playground.runs.train import train
from tests.runs.helpers import TASK, resume

pytestmark = pytest.mark.stored_programs
UNSTABLE = [*TASK, "agent.num_timesteps=800", "env.ctrl_dt=10", "env.sim_dt=10"]  # blows up within a few steps


def test_nan_is_counted_dumped_and_kept_out(
  tmp_path: Path, cache: Path, watched: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
  run = tmp_path / "run"
  assert train(compose([*UNSTABLE, "on_nonfinite.max_fraction=1", f"run_dir={run}"])) == 0
  assert RunDirectory(run).status["status"] == "finished"
  table = pd.read_csv(run / "metrics.csv")
  assert np.sum(table["training/nonfinite"].to_numpy() > 0) > 1, "more than one row has them"
  assert table["eval/nonfinite"].to_numpy()[-1] > 0
  numbers = table.filter(regex="^(eval|training)/").to_numpy()
  assert not np.isinf(numbers).any()
  trained = table[table["training/episodes"] > 0].filter(regex="^training/")
  assert len(trained)
  assert np.isfinite(trained.to_numpy()).all()
  (dump,) = (run / "nan_dump").iterdir()
  said = capsys.readouterr().out
  assert said.count("playground replay") == 1
  assert f"playground replay {dump}" in said

  ((_, _, policy),) = watched
  assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(policy))

  assert replay(str(dump)) == 0
  recorded, replayed = capsys.readouterr().out.split("replayed on cpu with impl=jax: NaN, infinite or too large in ")
  assert "physics as recorded: NaN, infinite or too large in" in recorded
  assert "['qvel']: " in recorded
  assert "['data'].qvel: " in replayed

  (newest,) = find_checkpoints(run)
  newest.rename(newest.with_name("kept"))  # as if killed before the checkpoint: the first bad step is found again
  RunDirectory(run).set_status("running")
  assert resume(run) == 0
  assert list((run / "nan_dump").iterdir()) == [dump], "one dump a run, however often it is resumed"


@pytest.mark.parametrize(("repeats", "steps"), [(1, 1), (4, 3)])
def test_all_repeats_of_an_action_are_replayed(repeats: int, steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
  """Up to the first that is not finite."""
  state = lambda number: types.SimpleNamespace(
    data=np.array([0.0, 0.0, 0.0, np.nan, 0.0])[number], obs=0.0, reward=number, metrics={}
  )
  step = lambda before, *_: state(before.reward + 1)
  dump = object.__new__(Dump)
  dump.action, dump.model = np.zeros(1), {}
  monkeypatch.setattr(Dump, "state", lambda self, env: state(0))
  env: Any = types.SimpleNamespace(action_repeat=repeats, jitted=(None, step))
  assert dump.replay(env).reward == steps


def test_a_reward_that_is_nan_is_named() -> None:
  metrics = {"reward/mine": np.float32(np.nan), "reward/other": np.float32(1), "tracking_error": np.float32(np.nan)}
  state: Any = types.SimpleNamespace(data=np.zeros(3), obs=np.zeros(2), reward=np.float32(np.nan), metrics=metrics)
  assert nonfinite_results(state) == ["['metrics']['reward/mine']: 1 of 1", "['reward']: 1 of 1"]


def test_no_dump_at_all_is_one_sentence() -> None:
  with pytest.raises(CheckpointError, match=r"^\. is not a dump"):
    replay("")


def test_a_dump_of_another_task_is_one_sentence(tmp_path: Path) -> None:
  config = compose(TASK)
  env = registry.load("CartpoleBalance", config=config.env)
  state = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), jax.eval_shape(env.reset, jax.random.PRNGKey(0)))
  arrays: dict[str, Any] = {"action": np.zeros(1, np.float32), "model": {"body_mass": np.ones(3, np.float32)}}

  def refusal(**changed: Any) -> str:
    step = Step(**{"state": state, "after": {}, **arrays, **changed})
    dump = Dump(str(write_dump(tmp_path, 0, jax.tree.map(lambda leaf: leaf[None], step), config.resolved)))
    with pytest.raises(CheckpointError, match=r"^The dump does not fit this task: ") as raised:
      dump.state(env)
    return str(raised.value).partition(": ")[2]

  assert refusal(action=np.zeros(7, np.float32)) == "its action is float32[7], the task's is float32[1]."
  assert refusal(action=np.array(["a"])) == "its action is <U1[1], the task's is float32[1]."
  assert refusal(model={"body_mass": np.ones(99)}).startswith("its model/body_mass is float64[99], the task's is")
  assert refusal(model={"nosuch": np.ones(1)}) == "the task has no model/nosuch."
  assert refusal(state=state.replace(done=np.zeros(3))) == "its state.done is float64[3], the task's is float32[]."
  assert refusal(state=state.replace(metrics={})).startswith("it has no state.metrics")


@pytest.mark.parametrize("agent", ["ppo", pytest.param("sac", marks=pytest.mark.slow)])
def test_too_many_rejected_gradient_steps_stop_the_run(
  tmp_path: Path, cache: Path, agent: str, monkeypatch: pytest.MonkeyPatch
) -> None:
  monkeypatch.setattr(algorithm, "check", lambda config, key: None)  # which refuses an infinite factor
  run = tmp_path / "run"
  config = compose([*TASK, f"agent={agent}", f"run_dir={run}"])
  config = dataclasses.replace(config, agent=dataclasses.replace(config.agent, reward_scaling=math.inf))  # pyright: ignore[reportCallIssue]
  said = r"(\d+) of \1 gradient steps before step .* on_nonfinite.max_fraction=0.01 .* A lower agent.learning_rate"
  with pytest.raises(NonfiniteError, match=said):
    train(config)
  assert RunDirectory(run).status["status"] == "failed"


def test_a_run_says_how_many_gradient_steps_it_left_out(
  tmp_path: Path, cache: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
  monkeypatch.setattr(algorithm, "check", lambda config, key: None)  # which refuses an infinite factor
  config = compose([*TASK, "on_nonfinite.max_fraction=1", f"run_dir={tmp_path / 'run'}"])
  config = dataclasses.replace(config, agent=dataclasses.replace(config.agent, reward_scaling=math.inf))  # pyright: ignore[reportCallIssue]
  assert train(config) == 0
  left_out = np.nansum(pd.read_csv(tmp_path / "run/metrics.csv")["training/nonfinite_updates"].to_numpy())
  assert left_out > 0
  assert f"{left_out:.0f} gradient steps were NaN or infinite and left out" in " ".join(capsys.readouterr().out.split())


def test_too_many_nan_stop_the_run(tmp_path: Path, cache: Path, refused: Callable[..., str]) -> None:
  run = tmp_path / "run"
  sentence = refused(*UNSTABLE, "on_nonfinite.max_fraction=0.001", f"run_dir={run}")
  assert "went NaN, infinite or too large, more than on_nonfinite.max_fraction=0.001" in sentence
  (dump,) = (run / "nan_dump").iterdir()
  assert f"playground replay {dump}" in sentence
  status = RunDirectory(run).status
  assert (status["status"], f"error: {status['reason']}") == ("failed", sentence)
