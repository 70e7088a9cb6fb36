"""`playground eval`: a run, one of its checkpoints, and what is neither."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import yaml

from playground import registry
from playground.cli import eval as eval_command
from playground.cli.main import main
from playground.config import compose
from playground.learning.checkpoints import find_checkpoints
from playground.paper import paper_table
from playground.runs.train import train
from tests.command import Command, caller
from tests.dummy import Point


@pytest.fixture(autouse=True)
def point(monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setattr(registry, "load", lambda name, config=None: Point())


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
  """A finished run with two checkpoints."""
  run = tmp_path_factory.mktemp("trained") / "run"
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(registry, "load", lambda name, config=None: Point())
    args = ["env=CartpoleBalance", "tuned=null", "debug=fast", "hardware=cpu", "tracking=csv", f"run_dir={run}"]
    args += ["agent.num_evals=3", "agent.num_timesteps=4000", "agent.learning_rate=0.01"]
    assert train(compose(args)) == 0
  return run


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Command:
  call = caller(monkeypatch, "playground", main)
  return lambda *args: call("eval", *args)


def report(run: Path, step: int, seed: int = 0, mode: str = "", episodes: int = 4) -> dict[str, Any]:
  return json.loads((run / "eval" / f"step_{step:012d}_seed_{seed}_episodes_{episodes}{mode}.json").read_text())


def test_a_run_is_evaluated_at_its_newest_checkpoint(
  command: Command, trained: Path, capsys: pytest.CaptureFixture[str]
) -> None:
  assert command(str(trained)) == 0
  out = capsys.readouterr().out
  written = report(trained, 4000)
  assert written["checkpoint"] == str(find_checkpoints(trained)[0])
  assert (written["episodes"], written["seed"], written["platform"]) == (4, 0, "cpu")
  assert written["scores"]["episode_length"] == 20
  assert re.search(rf"reward\W+{written['scores']['episode_reward']:.4g}\b", out)
  assert "CartpoleBalance, 4 episodes, 4,000 steps trained" in " ".join(out.split())
  assert f"written to {trained}/eval/step_000000004000_seed_0_episodes_4.json" in out


def test_one_checkpoint_with_more_episodes_and_another_seed(command: Command, trained: Path) -> None:
  older = find_checkpoints(trained)[1]
  assert command(str(older), "--episodes", "6", "--seed", "3") == 0
  written = report(trained, 2000, seed=3, episodes=6)
  assert (written["checkpoint"], written["episodes"], written["seed"]) == (str(older), 6, 3)
  assert command(str(older), "--episodes", "2", "--seed", "3") == 0
  assert report(trained, 2000, seed=3, episodes=6) == written, "fewer episodes do not replace more"


def test_other_values_of_the_task(
  command: Command, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  run, seen = shutil.copytree(trained, tmp_path / "run", symlinks=True), []
  monkeypatch.setattr(registry, "load", lambda name, config=None: seen.append(config) or Point())
  assert command(str(run), "env.sim_dt=0.005", "--seed", "1") == 0
  assert [config.sim_dt for config in seen] == [0.005]
  (file,) = (run / "eval").glob("step_000000004000_seed_1_episodes_4_*.json")
  assert json.loads(file.read_text())["overrides"] == ["env.sim_dt=0.005"]


def test_brackets_in_a_title_are_no_markup(
  command: Command, trained: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
  monkeypatch.setattr(eval_command, "described", lambda overrides: ", [push] [/x]")
  assert command(str(trained)) == 0
  assert "[push] [/x]" in capsys.readouterr().out


def test_what_the_paper_measured_on_a_real_robot_stands_beside(
  command: Command, trained: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
  row = {"task": "CartpoleBalance", "metric": "length", "median": "3", "mean": "4", "ci95": "0.5", "trials": "9"}
  row |= {"what": "seconds upright", "simulation": "steps upright", "where": "Section X"}
  rows = [row, row | {"task": "Other"}]
  monkeypatch.setattr(eval_command, "paper_table", lambda name: rows)
  assert command(str(trained)) == 0
  out = capsys.readouterr().out
  assert "simulation, mean" in out and "hardware, mean (paper)" in out
  assert re.search(r"length\W+20\W+4 ± 0.5\b", out)
  assert "hardware, length: seconds upright; median 3, 9 trials (paper, Section X)" in out
  assert "simulation, length: by default steps upright" in out
  assert report(trained, 4000)["hardware_in_paper"] == rows[:1]


def test_the_papers_trials_on_hardware_are_of_metrics_that_our_tasks_have() -> None:
  rows = paper_table("hardware")
  means = {(row["task"], row["metric"]): float(row["mean"]) for row in rows}
  assert means[("LeapCubeReorient", "rotations")] == np.mean([3, 27, 8, 2, 15, 3, 4, 1, 3, 5])
  for task, metric in means:
    env = registry.build(registry.config(task)) if "Vision" not in task else None  # which needs Warp
    assert env is None or metric in [*env.summaries, "rotations"]
  assert ("PandaPickCubeCartesianVision", "success") in means, "the paper's policy sees"
  assert all(row["what"] and row["simulation"] and row["where"] for row in rows)


def test_the_mode_of_the_policy_is_another_score(command: Command, trained: Path) -> None:
  scores = []
  for flags in ([], ["--deterministic"], ["--deterministic"]):
    assert command(str(trained), "--seed", "5", *flags) == 0
    written = report(trained, 4000, 5, "_deterministic" if flags else "")
    assert written["deterministic"] == bool(flags), "the task's agent samples by default"
    scores.append(written["scores"]["episode_reward"])
  assert scores[0] != scores[1] == scores[2]
  assert report(trained, 4000, seed=5)["scores"]["episode_reward"] == scores[0], "the sampled one is kept"


def test_a_run_may_be_evaluated_by_the_mode_by_default(command: Command, trained: Path, tmp_path: Path) -> None:
  run = shutil.copytree(trained, tmp_path / "run", symlinks=True)
  config = run / "config.yaml"
  config.write_text(config.read_text().replace("deterministic_eval: false", "deterministic_eval: true"))
  assert command(str(run), "--seed", "5") == 0
  assert report(run, 4000, 5, "_deterministic")["deterministic"]


@pytest.mark.parametrize("missing", ["gone", "empty", "run/checkpoints/000000000001"])
def test_a_wrong_path_is_one_sentence(
  command: Command, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], missing: str
) -> None:
  (tmp_path / "empty").mkdir()
  path = trained.parent / missing if missing.startswith("run") else tmp_path / missing
  assert command(str(path)) == 2
  (line,) = capsys.readouterr().err.splitlines()
  assert line.startswith("error: ")
  assert str(path) in line


def test_a_run_of_a_larger_machine_is_evaluated_on_this_one(command: Command, trained: Path, tmp_path: Path) -> None:
  run = shutil.copytree(trained, tmp_path / "run")
  config = yaml.safe_load((run / "config.yaml").read_text())
  config["hardware"] |= {"platform": "gpu", "devices": 64}
  (run / "config.yaml").write_text(yaml.safe_dump(config))
  assert command(str(run)) == 0
  assert report(run, 4000)["num_devices"] == 1


def test_a_video_by_the_camera_that_is_named(
  command: Command, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  cameras = "".join(f'<camera name="{name}"/>' for name in ("side", "front"))
  model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{cameras}</worldbody></mujoco>")
  monkeypatch.setattr(Point, "mj_model", model)
  filmed: list[Any] = []
  monkeypatch.setattr(eval_command, "render_video", lambda model, **view: filmed.append(view["camera"]))
  video = ["--video", str(tmp_path / "a.mp4")]
  run = shutil.copytree(trained, tmp_path / "run")
  config = yaml.safe_load((run / "config.yaml").read_text())
  config["video"]["camera"] = "side"
  (run / "config.yaml").write_text(yaml.safe_dump(config))
  assert command(str(run), *video) == 0
  assert command(str(run), *video, "--camera", "front") == 0
  assert filmed == ["side", "front"]  # the run's own, unless another is named
  monkeypatch.setattr(eval_command, "make_evaluator", pytest.fail)
  capsys.readouterr()
  assert command(str(trained), *video, "--camera", "frnt") == 2
  sentence = "--camera=frnt is no camera of the model; it has side, front. Did you mean 'front'?"
  assert capsys.readouterr().err == f"error: {sentence}\n"


def test_a_run_that_cannot_be_written_to_is_evaluated_all_the_same(
  command: Command, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
  run = shutil.copytree(trained, tmp_path / "run", ignore=shutil.ignore_patterns("eval"))
  (run / "eval").touch()
  assert command(str(run), "--episodes", "1") == 0
  out = capsys.readouterr().out
  assert "reward" in out
  assert f"not written: {run / 'eval'} is not a folder that you may write to" in out


def test_no_episodes_are_refused(command: Command, trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
  assert command(str(trained), "--episodes", "0") == 2
  assert "--episodes=0 must be a whole number from 1 to" in capsys.readouterr().err
