"""A run may lie in a folder of any name: through run, resume, eval, export and sweep."""

import os
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from playground.cli.eval import evaluate_run
from playground.config import compose, compose_settings
from playground.deploy.export import export_run
from playground.learning.checkpoints import Checkpoint, CheckpointStore, find_checkpoints
from playground.runs.run_dir import RunDirectory
from playground.runs.trackers import make_trackers
from playground.runs.train import train
from playground.sweep.folder import SweepDirectory
from playground.text import quoted
from tests.runs.helpers import TASK, make_run
from tests.sweep.helpers import make_sweep
from tests.sweep.helpers import run as run_jobs

SHAPES = [
  *("a[1]", "[a]", "a[", "a]", "[!a]", "[a-z]*", "a*", "**", "a?b", "?", "a\\b", "a\\", "\\\\n", "a b", " a "),
  *(
    "a'b",
    'a"b',
    "a{b}",
    "${a}",
    "$HOME",
    "a=b,c",
    "a:b",
    "s3:",
    "a#b",
    "a%20b",
    "~a",
    "日本é",
    "a\nb",
    "-a;b&c|d",
    "(a)",
  ),
]
ALL = "-[a]*?\\ :=,;${b}{c}'\"#%20~é\n(1)|&"


@pytest.fixture(scope="module")
def resolved() -> dict[str, Any]:
  return compose([*TASK, "tracking=tensorboard"]).resolved


@pytest.mark.parametrize(
  "shape", [*SHAPES[::4], *(pytest.param(s, marks=pytest.mark.slow) for s in SHAPES if s not in SHAPES[::4])]
)
def test_what_is_saved_is_read_again(shape: str, tmp_path: Path, resolved: dict[str, Any]) -> None:
  path = tmp_path / shape / "run"
  run = make_run(path, resolved)
  policy, state = {"w": jnp.arange(12.0)}, {"b": np.arange(5)}
  meta: dict[str, Any] = {"update": 1, "wall_clock_s": 0.0, "env": "Point", "config": resolved}
  with run.locked():
    trackers = make_trackers(resolved, run)
    store = CheckpointStore(run.checkpoints, keep=1)
    for step in (10, 20, 30):
      trackers.log(step, {"eval/episode_reward": -step})
      store.save(step, policy, state, meta, episode_return=-step)
    store.close()
    trackers.close("finished")
  resumed = compose([f"resume={quoted(path)}"])
  assert (resumed.resume, resumed.run_dir) == (str(path), str(path))
  assert [int(found.name) for found in find_checkpoints(str(path))] == [30, 10]
  assert find_checkpoints(run.checkpoints / "best") == [run.checkpoints / f"{10:012d}"]
  for found in find_checkpoints(path):
    np.testing.assert_array_equal(Checkpoint(found).restore("policy", policy)["w"], policy["w"])
    np.testing.assert_array_equal(Checkpoint(found).restore("state", state)["b"], state["b"])
  assert sorted(os.listdir(tmp_path)) == [shape]
  assert sorted(os.listdir(path.parent)) == ["run"]


@pytest.mark.parametrize(
  ("key", "shape"),
  [
    *(("run_dir", shape) for shape in ("a[1]", "[a]", "{a}", "a'b", "~a")),
    ("init_from", "[a]"),
    ("resume", "[a]"),
  ],
)
def test_a_name_needs_no_quotes(
  key: str, shape: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, resolved: dict[str, Any]
) -> None:
  monkeypatch.chdir(tmp_path)
  make_run(shape, resolved)
  config = compose([f"{key}={shape}"] if key == "resume" else [*TASK, f"{key}={shape}"])
  assert getattr(config, key) == shape
  if key == "run_dir":
    assert compose(config.overrides).run_dir == shape, "as Hydra's app gets it"


@pytest.mark.parametrize("key", ["resume", "init_from"])
def test_a_path_may_begin_at_home(
  key: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, resolved: dict[str, Any]
) -> None:
  monkeypatch.setenv("HOME", str(tmp_path))
  make_run(tmp_path / "run", resolved)
  config = compose(["resume=~/run"] if key == "resume" else [*TASK, "init_from=~/run"])
  assert Path(str(getattr(config, key))).expanduser() == tmp_path / "run"


def test_a_sweep_dir_of_any_name() -> None:
  for shape in SHAPES:
    assert compose_settings([f"sweep_dir={quoted(shape)}"]).sweep_dir == shape


@pytest.mark.stored_programs
@pytest.mark.parametrize("shape", [ALL, *(pytest.param(shape, marks=pytest.mark.slow) for shape in SHAPES)])
def test_a_run_a_sweep_and_what_reads_them(
  shape: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  pytest.importorskip("onnxruntime")
  monkeypatch.chdir(tmp_path)
  for path in [tmp_path / "absolute" / shape / "run", *([Path(shape)] if shape != ALL else [])]:
    args = [*TASK, "tracking=tensorboard", "agent.num_timesteps=320", "agent.num_evals=3", f"run_dir={quoted(path)}"]
    assert train(compose(args)) == 0
    run = RunDirectory(path)
    result = run.summary
    newest = find_checkpoints(path)[0]
    newest.rename(newest.with_name("later"))
    run.set_status("running")
    assert train(compose([f"resume={quoted(path)}"])) == 0
    assert "Resuming the whole training state" in capsys.readouterr().out
    assert (run.summary["params_sha256"], run.summary["steps"]) == (result["params_sha256"], result["steps"])
    assert evaluate_run(str(run.checkpoints / "best"), episodes=2) == 0
    assert export_run(str(path)) == 0
    assert (run.path / "export/policy.onnx").is_file()
  sweep = make_sweep(tmp_path / "sweeps" / shape, 0, 1)
  assert run_jobs(sweep) == 0
  assert {state.status for state in SweepDirectory.open(sweep.path).states().values()} == {"finished"}
  assert (sweep.path / "sweep.csv").is_file()
