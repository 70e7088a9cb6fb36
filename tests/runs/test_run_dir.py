import errno
import fcntl
import json
import math
import os
import shutil
import socket
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from playground.errors import CheckpointError, one_sentence
from playground.files import is_locked, lock_holder, replacing
from playground.runs.provenance import git_state
from playground.runs.run_dir import RunDirectory
from tests.runs.helpers import make_run

CONFIG = {"seed": 1, "agent": {"learning_rate": 1e-5, "layers": (32, 32), "decay": None}}


def test_config_and_overrides_survive_the_round_trip(tmp_path: Path):
  make_run(tmp_path / "a" / "run", CONFIG, ["seed=1", "env=X"])
  run = RunDirectory.open(tmp_path / "a" / "run")
  assert run.config == {"seed": 1, "agent": {"learning_rate": 1e-5, "layers": [32, 32], "decay": None}}
  assert isinstance(run.config["agent"]["learning_rate"], float)
  assert run.overrides == ["seed=1", "env=X"]


@pytest.mark.parametrize("trace", ["config.yaml", "checkpoints"])
def test_create_refuses_an_existing_run_and_names_both_verbs(tmp_path: Path, trace: str):
  (tmp_path / trace).mkdir() if trace == "checkpoints" else (tmp_path / trace).write_text("seed: 1\n")
  with pytest.raises(CheckpointError) as error:
    make_run(tmp_path, CONFIG)
  message = str(error.value)
  assert f"resume={tmp_path}" in message and f"init_from={tmp_path}" in message and "run_dir=" in message
  assert "\n" not in message


def test_runs_named_alike_in_the_same_moment_get_folders_of_their_own(tmp_path: Path):
  path = tmp_path / "results" / "2026-01-01_00-00-00"
  with ThreadPoolExecutor(8) as pool:
    runs = list(pool.map(lambda seed: make_run(path, {"seed": seed}, numbered=True), range(8)))
  names = {path.name, *(f"{path.name}_{number}" for number in range(2, 9))}
  assert {run.path.name for run in runs} == names
  assert [run.config["seed"] for run in runs] == list(range(8))


def test_of_runs_that_start_in_one_folder_in_the_same_moment_one_is_made(tmp_path: Path):
  together = threading.Barrier(8)

  def create(seed: int) -> bool:
    together.wait()
    try:
      return bool(make_run(tmp_path / "run", {"seed": seed}, [f"seed={seed}"]))
    except CheckpointError:
      return False

  with ThreadPoolExecutor(8) as pool:
    (winner,) = (seed for seed, made in enumerate(pool.map(create, range(8))) if made)
  run = RunDirectory.open(tmp_path / "run")
  assert (run.config, run.overrides) == ({"seed": winner}, [f"seed={winner}"])


def test_create_takes_an_empty_or_unrelated_folder(tmp_path: Path):
  (tmp_path / "notes.txt").write_text("mine")
  assert make_run(tmp_path, CONFIG).config["seed"] == 1


def test_create_where_a_file_lies_is_one_sentence(tmp_path: Path):
  (tmp_path / "file").write_text("")
  with pytest.raises(CheckpointError, match="cannot be written"):
    make_run(tmp_path / "file" / "run", CONFIG)


def test_open_names_what_is_missing(tmp_path: Path):
  make_run(tmp_path / "cartpole", CONFIG)
  (tmp_path / "empty").mkdir()
  with pytest.raises(CheckpointError, match=r"no such folder\. Did you mean 'cartpole'"):
    RunDirectory.open(tmp_path / "cartpoel")
  with pytest.raises(CheckpointError, match=r"no config\.yaml"):
    RunDirectory.open(tmp_path / "empty")
  (tmp_path / "empty" / "config.yaml").write_text("seed: [1")
  with pytest.raises(CheckpointError, match="damaged"):
    RunDirectory.open(tmp_path / "empty")


def test_manifest_has_versions_merges_timings_and_keeps_earlier_starts(tmp_path: Path):
  run = make_run(tmp_path / "run", CONFIG)
  run.write_manifest(seed=1, device={"kind": "cpu", "count": 1}, timings={"trace_s": 0.5})
  run.update_manifest(timings={"compile_s": np.float32(2.0)})
  manifest = run.manifest
  assert manifest["timings"] == {"trace_s": 0.5, "compile_s": 2.0}
  assert manifest["versions"]["jax"] and manifest["versions"]["python"]
  assert manifest["earlier_starts"] == []
  for seed in (2, 3):
    run.write_manifest(seed=seed)
  assert [start["seed"] for start in run.manifest["earlier_starts"]] == [1, 2]


def test_a_run_has_one_writer(tmp_path: Path):
  run = make_run(tmp_path / "run", CONFIG)
  code = f"""
import time
from playground.runs.run_dir import RunDirectory
with RunDirectory({str(run.path)!r}).recorded():
  print("locked", flush=True)
  time.sleep(60)
"""
  other = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
  assert other.stdout and other.stdout.readline() == "locked\n"
  before = (run.path / "status.json").read_bytes()
  with pytest.raises(CheckpointError) as error, run.recorded():
    pytest.fail("two writers")
  assert f"{run.path} is being written by process {other.pid} on {socket.gethostname()}:" in str(error.value)
  assert (run.path / "status.json").read_bytes() == before
  other.kill()
  other.wait()
  with run.locked():  # what a killed process leaves is no lock
    assert lock_holder(run.path / "run.lock") == f"process {os.getpid()} on {socket.gethostname()}"
    with run.locked():
      assert is_locked(run.path / "run.lock")
    assert is_locked(run.path / "run.lock"), "the inner block has not given it back"
  assert not is_locked(run.path / "run.lock")


def test_a_file_system_without_locks_locks_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
  def flock(*_: object) -> None:
    raise OSError(errno.ENOSYS, "Function not implemented")

  monkeypatch.setattr(fcntl, "flock", flock)
  with make_run(tmp_path / "run", CONFIG).locked():
    pass


def test_status_keeps_the_first_start_and_refuses_other_words(tmp_path: Path):
  run = make_run(tmp_path / "run", CONFIG)
  run.set_status("running")
  started = run.status["started"]
  run.set_status("preempted", reason="SIGTERM")
  assert run.status["status"] == "preempted" and run.status["reason"] == "SIGTERM"
  assert run.status["started"] == started and run.status["pid"] == os.getpid()
  with pytest.raises(ValueError, match="status must be"):
    run.set_status("done")  # pyright: ignore[reportArgumentType]


def test_what_the_system_denies_is_one_sentence(tmp_path: Path):
  run = make_run(tmp_path / "run", CONFIG)
  with pytest.raises(CheckpointError) as error, run.recorded():
    raise OSError(errno.ENOSPC, "No space left on device", str(run.metrics_csv))
  sentence = f"{run.path} cannot be written: No space left on device ({run.metrics_csv}). resume={run.path} goes on"
  assert str(error.value).startswith(sentence)
  assert (run.status["status"], run.status["reason"]) == ("failed", str(error.value))


def test_a_status_that_cannot_be_written_hides_no_error(tmp_path: Path):
  run = make_run(tmp_path / "run", CONFIG)
  with pytest.raises(CheckpointError, match="the cause"), run.recorded():
    shutil.rmtree(run.path)
    raise CheckpointError("the cause")
  assert not run.path.exists()


@pytest.mark.parametrize(
  "content", ["", "{", "[]", "5", "null", '"text"', '{"status": 5}', "\0", "\ufeff{}", "[" * 10_000, '{"status": []}']
)
def test_a_damaged_record_is_one_sentence(tmp_path: Path, content: str):
  run = make_run(tmp_path / "run", CONFIG)
  (run.path / "status.json").write_text(content)
  with pytest.raises(CheckpointError, match=r"status\.json is damaged \(.*\): move it away to go on without it\.$"):
    run.status  # noqa: B018


def test_summary_is_strict_json(tmp_path: Path):
  run = make_run(tmp_path / "run", CONFIG)
  run.write_summary({"final_return": math.nan, "steps": np.int64(7), "curve": np.ones(2)})
  text = (run.path / "summary.json").read_text()
  assert json.loads(text, parse_constant=pytest.fail) == {"final_return": None, "steps": 7, "curve": [1.0, 1.0]}


def test_a_failed_write_leaves_the_old_file_and_no_litter(tmp_path: Path):
  path = tmp_path / "a.json"
  path.write_text("old")
  with pytest.raises(RuntimeError), replacing(path) as temporary:
    temporary.write_text("half")
    raise RuntimeError
  assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_a_write_gives_the_users_own_mode_and_leaves_that_of_other_threads(
  tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
  (tmp_path / "own").touch()
  with monkeypatch.context() as patch, replacing(tmp_path / "a.json"):
    patch.setattr(os, "umask", lambda mask: pytest.fail("it is the whole process's"))
  assert (tmp_path / "a.json").stat().st_mode == (tmp_path / "own").stat().st_mode


def test_an_error_of_a_full_disk_names_the_file(tmp_path: Path):
  path = tmp_path / "status.json"
  with pytest.raises(OSError) as error, replacing(path):
    raise OSError(errno.ENOSPC, "No space left on device")
  assert one_sentence(error.value) == f"error: {path}: No space left on device."


def test_git_state_is_of_this_checkout_only(tmp_path: Path):
  def git(*args: str) -> None:
    identity = ["-c", "user.name=t", "-c", "user.email=t@example.org"]
    subprocess.run(["git", "-C", str(tmp_path), *identity, *args], check=True, capture_output=True)

  assert git_state(tmp_path) is None
  git("init")
  git("commit", "--allow-empty", "-m", "first")
  state = git_state(tmp_path)
  assert state and len(state["commit"]) == 40 and state["dirty"] is False
  (tmp_path / "site-packages").mkdir()
  assert git_state(tmp_path / "site-packages") is None  # somebody else's repository
  (tmp_path / "new.txt").write_text("x")
  state = git_state(tmp_path)
  assert state and state["dirty"] is True


@pytest.mark.parametrize("name", ["checkpoints", "metrics.csv", "run.lock", "2_far/videos"])
def test_a_link_out_of_a_run_is_not_followed(tmp_path: Path, name: str) -> None:
  run = make_run(tmp_path / "run", CONFIG)
  (run.path / name).unlink(missing_ok=True)
  (run.path / name).parent.mkdir(exist_ok=True)
  (run.path / name).symlink_to(tmp_path / "outside")
  with pytest.raises(CheckpointError, match=f"{name} is a link that leads out of {run.path}"), run.locked():
    pass
  assert not (tmp_path / "outside").exists()


def test_links_of_a_user_are_followed(tmp_path: Path) -> None:
  run = make_run(tmp_path / "run", CONFIG)
  (run.path / "newest").symlink_to("config.yaml")
  (run.path / "wandb").mkdir()
  (run.path / "wandb" / "debug-core.log").symlink_to(tmp_path / "cache")  # as W&B makes them
  (tmp_path / "link").symlink_to(run.path)
  with RunDirectory(tmp_path / "link").locked():
    pass


def test_a_link_to_itself_leads_nowhere(tmp_path: Path) -> None:
  run = make_run(tmp_path / "run", CONFIG)
  (run.path / "loop").symlink_to("loop")
  with run.locked():
    pass
