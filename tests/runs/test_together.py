"""Agents of one program: each leaves behind what it leaves alone, and what ends one lets the others go on."""

import errno
import itertools
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from playground.config import RunConfig, compose
from playground.errors import ConfigError
from playground.learning.checkpoints import find_checkpoints
from playground.learning.population import Population
from playground.runs import together
from playground.runs.callbacks import RunCallbacks
from playground.runs.interrupts import Interrupts
from playground.runs.programs import program_of
from playground.runs.restore_plan import RestorePlan
from playground.runs.run_dir import RunDirectory
from playground.runs.together import Member, _groups, train_together  # pyright: ignore[reportPrivateUsage]
from playground.runs.train import train
from tests.runs.helpers import TASK, make_run, resume, truncate

STEPS = 2000
EFFORT = "env.rewards.action_l2.weight"
BUDGET = [*TASK, f"agent.num_timesteps={STEPS}", "agent.num_evals=3", f"{EFFORT}=-0.1"]
pytestmark = pytest.mark.stored_programs
AGENTS = {"a": ["seed=1"], "b": ["seed=2"], "c": ["seed=1", "agent.learning_rate=3e-3", f"{EFFORT}=-0.5"]}


def configs(folder: Path) -> list[RunConfig]:
  return [compose([*BUDGET, *own, f"run_dir={folder / name}"]) for name, own in AGENTS.items()]


def resumed(folder: Path, *names: str) -> list[RunConfig]:
  return [compose([f"resume={folder / name}"]) for name in names]


@pytest.fixture(scope="module")
def group(tmp_path_factory: pytest.TempPathFactory) -> Path:
  folder = tmp_path_factory.mktemp("group")
  assert train_together(configs(folder)) == 0
  return folder


def test_each_agent_is_a_run_of_its_own(group: Path, tmp_path: Path) -> None:
  runs = {name: RunDirectory(group / name) for name in AGENTS}
  for name, run in runs.items():
    assert run.status["status"] == run.summary["status"] == "finished"
    assert run.manifest["agents_in_program"] == 3 and run.manifest["timings"]["compile_s"] > 0
    table = pd.read_csv(run.metrics_csv)
    assert run.summary["steps"] == int(table["step"].to_numpy()[-1]) and run.summary["steps"] >= STEPS
    assert len(table["eval/episode_reward"].dropna()) == 3
    assert len(list(run.plots.iterdir())) == 2 and (run.checkpoints / "best").is_dir(), name
  assert len({run.summary["params_sha256"] for run in runs.values()}) == 3

  alone = tmp_path / "alone"
  assert train(compose([*BUDGET, *AGENTS["c"], f"run_dir={alone}"])) == 0
  ours, theirs = (pd.read_csv(path / "metrics.csv").filter(regex="^(?!time/)") for path in (group / "c", alone))
  pd.testing.assert_frame_equal(ours, theirs, check_like=True, rtol=1e-3, atol=1e-3)


def test_what_was_cut_short_goes_on_together_or_alone(
  group: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  with monkeypatch.context() as patch:
    asked = itertools.count()  # after every stretch
    patch.setattr(Member, "should_stop", lambda self: next(asked) > 14)
    train_together(configs(tmp_path / "cut"))
  whole = {name: RunDirectory(group / name).summary["params_sha256"] for name in AGENTS}
  cut = {name: RunDirectory(tmp_path / "cut" / name) for name in AGENTS}
  assert [run.status["status"] for run in cut.values()] == ["preempted"] * 3
  shutil.copytree(tmp_path / "cut" / "b", tmp_path / "alone")
  shutil.copytree(tmp_path / "cut", tmp_path / "damaged", symlinks=True)
  shutil.copytree(tmp_path / "cut", tmp_path / "lost", symlinks=True)
  assert train_together(resumed(tmp_path / "cut", *AGENTS)) == 0
  assert {name: run.summary["params_sha256"] for name, run in cut.items()} == whole, "bit for bit"

  assert resume(tmp_path / "alone") == 0
  newest = find_checkpoints(tmp_path / "damaged" / "b")[0]
  truncate(newest)
  assert train_together(resumed(tmp_path / "damaged", "a", "b")) == 0, "each from a step of its own"
  said = capsys.readouterr().out
  assert f"b: {newest} is damaged" in said and "Falling back to the checkpoint before it." in said
  assert newest.with_name(f"damaged_{newest.name}").is_dir()
  found = find_checkpoints(tmp_path / "lost" / "b")
  for checkpoint in found:
    truncate(checkpoint)
  assert train_together(resumed(tmp_path / "lost", *AGENTS)) == 2, "b alone fails"
  assert f"b failed: {found[-1]} is damaged" in capsys.readouterr().err
  lost = {name: RunDirectory(tmp_path / "lost" / name).status["status"] for name in AGENTS}
  assert lost == {"a": "finished", "b": "preempted", "c": "finished"}

  final = lambda path: RunDirectory(path).summary["final_return"]
  for path in (tmp_path / "alone", tmp_path / "damaged" / "a", tmp_path / "damaged" / "b"):
    assert final(path) == pytest.approx(final(group / ("b" if path.name == "alone" else path.name)), rel=1e-3)


def test_what_ends_one_lets_the_others_go_on(
  group: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  log: Callable[..., None] = RunCallbacks.on_metrics

  def full(self: RunCallbacks, step: int, *rest: Any) -> None:
    if step and self._run_dir.path.name == "b":
      raise OSError(errno.ENOSPC, "No space left on device", "metrics.csv")
    log(self, step, *rest)

  with monkeypatch.context() as patch:
    patch.setattr(RunCallbacks, "on_metrics", full)
    assert train_together(configs(tmp_path)) == 2
  runs = {name: RunDirectory(tmp_path / name) for name in AGENTS}
  assert [run.status["status"] for run in runs.values()] == ["finished", "failed", "finished"]
  assert "No space left on device" in runs["b"].status["reason"] and "b failed" in capsys.readouterr().err
  for name in ("a", "c"):
    assert runs[name].summary["params_sha256"] == RunDirectory(group / name).summary["params_sha256"]
  assert resume(runs["b"].path) == 0
  assert runs["b"].summary["steps"] == runs["a"].summary["steps"]
  assert train_together(resumed(tmp_path, *AGENTS)) == 0, "the finished ones have nothing left to do"


@pytest.mark.slow
def test_each_agent_has_its_own_videos(
  tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  """Each step once, those of the end side by side; no agent's time has the videos of another in it."""
  made: list[Path] = []
  ends = threading.Barrier(len(AGENTS), timeout=60)

  def render(*_: Any, out_path: Path, notify: Callable[[str], None], qpos: np.ndarray, **__: Any) -> None:
    made.append(out_path)
    if int(out_path.stem.removeprefix("step_")) >= STEPS:
      ends.wait()  # passes only if the videos of all agents are asked for before one is waited for
      time.sleep(1.0)
    notify(f"No video at {out_path.name}: {len(qpos)} states.") if out_path.parents[1].name == "b" else None

  monkeypatch.setattr("playground.runs.callbacks.render_video", render)
  filmed = [compose([*BUDGET, *own, "video.enable=true", "video.every_evals=2", f"run_dir={tmp_path / name}"])
            for name, own in AGENTS.items()]  # fmt: skip
  assert train_together(filmed) == 0
  runs = {name: RunDirectory(tmp_path / name) for name in AGENTS}
  last = runs["a"].summary["steps"]
  steps = [960, last]  # after the second of three evaluations, and at the end
  assert sorted(made) == sorted(run.videos / f"step_{step:012d}.mp4" for run in runs.values() for step in steps)
  out = capsys.readouterr().out
  assert out.count("b: No video at") == 2 and "a: No video" not in out and "c: No video" not in out
  assert [run.status["status"] for run in runs.values()] == ["finished"] * 3
  for run in runs.values():
    trained = pd.read_csv(run.metrics_csv)["time/wall_clock_s"].to_numpy()[-1]
    assert run.summary["wall_clock_s"] < trained + 1.0


@pytest.mark.slow
def test_what_is_filmed_already_is_not_filmed_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  made: list[Path] = []
  monkeypatch.setattr("playground.runs.callbacks.render_video", lambda *_, out_path, **__: made.append(out_path))
  videos = ["video.enable=true", "video.every_evals=1"]
  assert train(compose([*BUDGET, *videos, f"run_dir={tmp_path / 'run'}"])) == 0
  assert len(made) == len(set(made)) == 3


@pytest.mark.slow
def test_a_population_goes_on_from_the_step_that_all_have(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  rate = "agent.learning_rate"
  explore = 1, [rate]
  own = {"a": [f"{rate}=1e-3", "seed=1"], "b": [f"{rate}=3e-3", "seed=2"]}

  def start(folder: str) -> list[RunConfig]:
    of = lambda name: [*BUDGET, "agent.num_evals=4", *own[name], f"run_dir={tmp_path / folder / name}"]
    return [compose(of(name)) for name in own]

  assert train_together(start("whole"), *explore) == 0
  whole = {name: RunDirectory(tmp_path / "whole" / name) for name in own}
  tables = [pd.read_csv(run.metrics_csv) for run in whole.values()]
  numbers = [table[f"population/{rate}"].dropna().tolist() for table in tables]
  assert [len(column) for column in numbers] == [4, 4] and max(len(set(column)) for column in numbers) > 1
  with monkeypatch.context() as patch:
    asked = itertools.count()
    patch.setattr(Member, "should_stop", lambda self: next(asked) > 14)
    train_together(start("cut"), *explore)
  cut = {name: RunDirectory(tmp_path / "cut" / name) for name in own}
  assert [run.status["status"] for run in cut.values()] == ["preempted"] * 2
  newest = sorted(path for path in cut["b"].checkpoints.glob("0*") if path.is_dir())[-1]
  shutil.rmtree(newest)  # as a kill between two saves leaves it
  assert train_together(resumed(tmp_path / "cut", *own), *explore) == 0
  sums = [{name: run.summary["params_sha256"] for name, run in runs.items()} for runs in (whole, cut)]
  assert sums[0] == sums[1], "bit for bit"
  for run, table in zip(cut.values(), tables, strict=True):
    theirs = pd.read_csv(run.metrics_csv).filter(regex="^(?!time/)")
    pd.testing.assert_frame_equal(theirs, table.filter(regex="^(?!time/)"), check_like=True)


def test_a_stop_between_two_groups_is_no_success(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  groups = [saved(tmp_path / "a", [400], "preempted"), saved(tmp_path / "b", [500], "preempted")]

  def end_with_a_signal(*_: Any) -> int:
    os.kill(os.getpid(), signal.SIGTERM)
    return 0

  monkeypatch.setattr(together, "_train_group", end_with_a_signal)
  assert train_together(groups) == 128 + signal.SIGTERM


def test_a_run_that_another_process_trains_does_not_stop_the_others(
  tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  configs = [saved(tmp_path / name, [400], "preempted") for name in "abcd"]
  shutil.rmtree(tmp_path / "d")
  groups: list[list[str]] = []

  def end(configs: Sequence[RunConfig], *_: Any, **__: Any) -> None:
    groups.append([Path(str(config.resume)).name for config in configs])
    raise ConfigError("Enough.")

  monkeypatch.setattr(together, "prepare", end)
  with RunDirectory(tmp_path / "b").locked(), pytest.raises(ConfigError, match="Enough"):
    train_together(configs)
  assert groups == [["a", "c"]]
  said = capsys.readouterr().err.splitlines()
  assert said[0].startswith("d failed: No run directory at") and said[1].startswith("b failed: ")


def test_a_signal_ends_a_group_that_still_compiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  """As it ends the first group: nothing is there to save yet, and compiling may take longer than the grace."""
  groups = [saved(tmp_path / "a", [400], "preempted"), saved(tmp_path / "b", [500], "preempted")]
  saving: list[bool] = []

  def train_group(configs: Any, population: Any, interrupts: Interrupts, hardware: Any) -> int:
    saving.append(interrupts.saving)
    interrupts.start_saving()
    return 0

  monkeypatch.setattr(together, "_train_group", train_group)
  assert train_together(groups) == 0
  assert saving == [False, False]


POPULATION = Population(1, {}, 0)


def saved(folder: Path, steps: list[int], status: str) -> RunConfig:
  """A run with checkpoints of these steps, by their names alone."""
  run = make_run(folder, compose([*BUDGET, f"run_dir={folder}"]).resolved)
  run.set_status(status)  # pyright: ignore[reportArgumentType]
  for step in steps:
    (run.checkpoints / f"{step:012d}").mkdir(parents=True)
  return compose([f"resume={folder}"])


@pytest.mark.parametrize("lost", ["failed", "removed"])
def test_a_run_that_is_behind_leaves_its_population(tmp_path: Path, lost: str) -> None:
  """The others would lose all that they trained since."""
  ahead = [saved(tmp_path / name, [400, 500, 600], "running") for name in "ac"]
  behind = saved(tmp_path / "b", [100], "failed")
  if lost == "removed":
    shutil.rmtree(tmp_path / "b")
    behind = compose([*BUDGET, f"run_dir={tmp_path / 'b'}"])
  groups = _groups([ahead[0], behind, ahead[1]], POPULATION)
  assert groups == [(ahead, POPULATION), ([behind], None)]
  still_near = [*ahead, saved(tmp_path / "d", [400], "failed")]
  assert _groups(still_near, POPULATION) == [(still_near, POPULATION)]
  at_first_save = [ahead[0], saved(tmp_path / "e", [], "running")]
  assert _groups(at_first_save, POPULATION) == [(at_first_save, POPULATION)]


def test_a_population_that_starts_over_starts_from_the_same_weights(tmp_path: Path, group: Path) -> None:
  """One was killed before its first checkpoint, the other after it."""
  run = make_run(tmp_path / "run", compose([*BUDGET, f"init_from={group / 'a'}"]).resolved)
  (run.checkpoints / f"{400:012d}").mkdir(parents=True)
  config = compose([f"resume={run.path}"])
  plan = RestorePlan.find(config)
  assert plan.checkpoints and plan.weights is None
  plan.start_over(config)
  assert plan.weights is not None and not plan.checkpoints
  assert plan.weights.path == find_checkpoints(group / "a")[0]


def test_a_run_from_weights_is_not_joined_with_one_without(tmp_path: Path, group: Path) -> None:
  """Both were killed before their first checkpoint."""
  plain = saved(tmp_path / "plain", [], "running")
  with_weights = tmp_path / "weights"
  make_run(with_weights, compose([*BUDGET, f"init_from={group / 'a'}", f"run_dir={with_weights}"]).resolved)
  weights = compose([f"resume={with_weights}"])
  assert _groups([plain, weights], None) == [([plain], None), ([weights], None)]


@pytest.mark.parametrize(
  ("override", "same"),
  [
    ("seed=7", True),
    ("agent.learning_rate=1e-5", True),
    ("agent.discounting=0.9", True),
    (f"{EFFORT}=-0.3", True),
    (f"{EFFORT}=0", False),
    ("env.rewards.action_rate_l2.weight=-0.3", False),
    ("run_dir=elsewhere", True),
    ("agent.unroll_length=7", False),
    ("agent.num_timesteps=500", False),
    ("env=PendulumSwingup", False),
  ],
)
def test_what_a_program_depends_on(override: str, same: bool) -> None:
  assert (program_of(compose([*BUDGET, override])) == program_of(compose(BUDGET))) == same


@pytest.mark.parametrize(
  ("override", "same"),
  [
    ("env.rewards.lin_vel_z_l2.weight=-2", True),
    ("env.commands.velocity.params.max=[1.0,0.5,0.7]", True),
    ("env.events.push.params.interval_s=[2.0,4.0]", True),
    ("env.events.floor_friction.params.range=[0.5,0.6]", True),  # drawn outside the program
    ("env.observations.state.gyro.noise.uniform=0.1", True),
    ("env.observations.state.gyro.noise.uniform=0", False),
    ("env.observations.state.gyro.noise.uniform=[0.1,0.2,0.3]", False),  # another shape
    ("env.events.push.enabled=true", False),
    ("env.rewards.feet_air_time.params.threshold=0.2", False),
    ("env.noise_level=0.5", False),
  ],
)
def test_what_the_program_of_a_robot_depends_on(override: str, same: bool) -> None:
  task = ["env=Go1JoystickFlatTerrain", "tuned=null", "randomization=go1", "agent.num_timesteps=1000"]
  assert (program_of(compose([*task, override])) == program_of(compose(task))) == same


@pytest.mark.parametrize(
  "override", ["tracking=wandb", "profile.enable=true", "hardware=multi_node", "hardware.scale_envs=true"]
)
def test_what_trains_alone(override: str) -> None:
  assert program_of(compose([*BUDGET, override])) is None


def test_runs_of_different_programs_are_refused(refused: Callable[..., str], tmp_path: Path) -> None:
  said = refused(*BUDGET, f"run_dir={tmp_path}/a", "--", *BUDGET, "agent.unroll_length=7", f"run_dir={tmp_path}/b")
  assert "cannot train together" in said and not list(tmp_path.iterdir())
