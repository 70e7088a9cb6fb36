"""Whole runs with every algorithm, on a task that compiles in seconds: resume, start from weights, evaluate."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import pandas as pd
import pytest

from playground import registry
from playground.cli.eval import evaluate_run
from playground.config import compose
from playground.errors import CheckpointError, ConfigError
from playground.learning.checkpoints import Checkpoint, checksum, find_checkpoints
from playground.learning.loop import Loop
from playground.runs.callbacks import RunCallbacks
from playground.runs.run_dir import RunDirectory
from playground.runs.train import train
from tests.dummy import Point

FAST = ["env=CartpoleBalance", "tuned=null", "debug=fast", "hardware=cpu", "tracking=csv"]
STEPS = 1600
pytestmark = pytest.mark.stored_programs
LONG = [*FAST, f"agent.num_timesteps={STEPS}", "agent.num_evals=5"]


@pytest.fixture(scope="module", autouse=True)
def point() -> Iterator[None]:
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(registry, "load", lambda name, config=None: Point())
    yield


# That the others resume bit for bit, tests/learning/test_trainer.py shows without the files of a run.
AGENTS = ["ppo", "sac", *(pytest.param(name, marks=pytest.mark.slow) for name in ("reppo", "fast_td3", "fast_sac"))]


@pytest.fixture(scope="module", params=AGENTS)
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
  """A run that nothing happens to."""
  run = tmp_path_factory.mktemp(request.param) / "run"
  assert train(compose([*LONG, f"agent={request.param}", f"run_dir={run}"])) == 0
  return run


def agent(run: Path) -> str:
  return RunDirectory(run).config["agent"]["name"]


def interrupted(run: Path, *overrides: str) -> list[Path]:
  """A run that is stopped halfway; returns its checkpoints, newest first."""
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(RunCallbacks, "should_stop", lambda job: job._step >= STEPS / 2)
    train(compose([*LONG, f"run_dir={run}", *overrides]))
  assert RunDirectory(run).status["status"] == "preempted"
  return find_checkpoints(run)


def test_a_resumed_run_ends_as_if_it_had_never_stopped(
  whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
  run = tmp_path / "run"
  newest, *older = interrupted(run, f"agent={agent(whole)}")
  has_replay = agent(whole) in ("sac", "fast_td3", "fast_sac")
  assert Checkpoint(newest).has("replay") == has_replay
  assert not any(Checkpoint(path).has("replay") for path in older)
  capsys.readouterr()
  assert train(compose([f"resume={run}"])) == 0
  said = " ".join(capsys.readouterr().out.split())
  assert f"Resuming the whole training state of {newest}" in said
  assert ("Replay buffer: 256 transitions of 9 numbers" in said) == has_replay
  ours, theirs = RunDirectory(run), RunDirectory(whole)
  for key in ("params_sha256", "final_return", "best_return", "best_step", "steps", "status"):
    assert ours.summary[key] == theirs.summary[key], key
  ours, theirs = (pd.read_csv(path / "metrics.csv").filter(regex="^(?!time/)") for path in (run, whole))
  pd.testing.assert_frame_equal(ours, theirs, check_like=True, check_exact=True)
  assert not any(Checkpoint(path).has("replay") for path in find_checkpoints(run)), "nothing is left to train"


def test_a_run_without_its_replay_buffer_collects_it_anew(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
  run = tmp_path / "run"
  newest, *_ = interrupted(run, "agent=sac", "agent.checkpoint_replay=false")
  assert not Checkpoint(newest).has("replay")
  capsys.readouterr()
  assert train(compose([f"resume={run}"])) == 0
  said = " ".join(capsys.readouterr().out.split())
  assert f"without its replay buffer (64 transitions are collected before it learns on) of {newest}" in said
  assert RunDirectory(run).summary["steps"] == STEPS


def test_the_return_of_a_policy_that_has_only_a_mode_is_the_modes(tmp_path: Path) -> None:
  run = tmp_path / "run"
  assert train(compose([*FAST, "agent=fast_td3", "agent.deterministic_eval=false", f"run_dir={run}"])) == 0
  summary = RunDirectory(run).summary
  assert summary["final_mode_return"] == summary["final_return"] and summary["final_sampled_return"] is None


def test_a_new_run_starts_from_weights(
  whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  policies, run_loop = [], Loop.run

  def watched(loop: Loop, state: Any, update: int | None = None) -> tuple[Any, bool]:
    policies.append(jax.device_get(loop.trainer.policy(state)))
    return run_loop(loop, state, update)

  monkeypatch.setattr(Loop, "run", watched)
  overrides = [f"agent={agent(whole)}", f"init_from={whole}", f"run_dir={tmp_path / 'run'}"]
  assert train(compose([*FAST, *overrides])) == 0
  said = " ".join(capsys.readouterr().out.split())
  checkpoint = Checkpoint(find_checkpoints(whole)[0])
  assert f"observation statistics of {checkpoint.path} (CartpoleBalance, 1,600 steps)" in said
  assert checksum(jax.tree.leaves(policies)) == checkpoint.meta["sha256"]["policy"]
  assert RunDirectory(tmp_path / "run").summary["params_sha256"] != checkpoint.meta["sha256"]["policy"]


def test_weights_of_another_algorithm_are_refused(whole: Path, tmp_path: Path) -> None:
  other = "ppo" if agent(whole) == "sac" else "sac"
  sentence = f"{find_checkpoints(whole)[0]} was trained by {agent(whole)}: agent={other} cannot start from it."
  with pytest.raises(CheckpointError, match=re.escape(sentence)):
    train(compose([*FAST, f"agent={other}", f"init_from={whole}", f"run_dir={tmp_path / 'run'}"]))
  assert not (tmp_path / "run").exists()


def test_evaluation(whole: Path) -> None:
  assert evaluate_run(str(whole), deterministic=True) == 0
  (report,) = (whole / "eval").iterdir()
  assert json.loads(report.read_text())["scores"]["episode_length"] == 20


def test_an_algorithm_is_chosen_by_its_group() -> None:
  with pytest.raises(ConfigError, match=r"agent\.name=sax cannot be set: agent=<name> chooses it"):
    compose([*FAST, "agent.name=sax"])
