"""The life of a sweep: jobs that crash, hang or are killed, interrupts, and what a second start does."""

import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from playground.cli import sweep as command
from playground.config import compose_settings
from playground.console import lasting_stdout
from playground.errors import CheckpointError, ConfigError
from playground.runs.run_dir import now
from playground.sweep.folder import SweepDirectory
from playground.sweep.runner import run_sweep
from playground.sweep.worker import Worker
from tests.sweep.helpers import STUB, controller, make_sweep, output, run, starts, statuses, wait_for


def alive(pid: int) -> bool:
  try:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
  except FileNotFoundError:
    return False


def test_whatever_ends_a_job_the_others_go_on(tmp_path: Path) -> None:
  sweep = make_sweep(tmp_path / "sweep", 10, 11, 12, 0, 1)
  assert run(sweep, "launcher.timeout=5", "launcher.grace=0.5") == 3
  assert statuses(sweep) == {10: "failed", 11: "timeout", 12: "killed", 0: "finished", 1: "finished"}
  reasons = [state.reason for state in sweep.states().values()]
  assert reasons[:3] == [
    "exit code 1: ValueError: out of luck",
    "took longer than launcher.timeout=5 s",
    "killed by SIGKILL, perhaps for want of memory",
  ]
  assert not alive(starts(sweep)[11][0]["pid"])
  table = pd.read_csv(sweep.path / "sweep.csv")
  assert list(table["status"]) == ["failed", "timeout", "killed", "finished", "finished"]
  assert list(table["final_return"].dropna()) == [1.0, 2.0]
  assert "[5/5]" in output(sweep) and "000_seed=10 failed" in output(sweep)


def test_jobs_share_the_machine(tmp_path: Path) -> None:
  sweep = make_sweep(tmp_path / "sweep", 15, 15, 0)
  assert run(sweep) == 0
  places = [json.loads(line) for job in sweep.jobs for line in (sweep.folder(job).path / "starts.jsonl").open()]
  first, second, third = sorted(places, key=lambda place: place["began"])
  assert first["gpus"] == "" and first["WANDB_RUN_GROUP"] == "stub/sweep"
  if len(os.sched_getaffinity(0)) == 2:  # as many slots
    assert not set(first["cores"]) & set(second["cores"])
    assert third["began"] - first["began"] > 1.4, "there was no room for it before"


def test_a_second_start_does_only_what_is_missing(tmp_path: Path) -> None:
  sweep = make_sweep(tmp_path / "sweep", 0, 14, 10)
  assert run(sweep) == 2
  assert run(SweepDirectory.open(sweep.path)) == 1
  assert statuses(sweep) == {0: "finished", 14: "finished", 10: "failed"}
  assert {seed: [start["again"] for start in found] for seed, found in starts(sweep).items()} == {
    0: [False],
    14: [False, True],
    10: [False, True],
  }
  assert "1 finished already" in output(sweep)


def test_a_start_that_fails_early_is_not_called_by_the_status_of_the_one_before(tmp_path: Path) -> None:
  sweep = make_sweep(tmp_path / "sweep", 16)
  assert run(sweep) != 0 and statuses(sweep) == {16: "preempted"}
  assert run(sweep) != 0 and statuses(sweep) == {16: "failed"}
  (state,) = sweep.states().values()
  assert state.reason == "exit code 2: error: it is damaged."


def test_on_error_stop(tmp_path: Path) -> None:
  sweep = make_sweep(tmp_path / "sweep", 10, 13, 0, 1, 2)
  assert run(sweep, "on_error=stop", *["launcher.cores_per_job=1"]) == 1
  found = statuses(sweep)
  assert found[10] == "failed"
  assert {found[1], found[2]} == {"queued"}
  assert run(sweep) == 1, "again, and now the rest is done"
  assert set(statuses(sweep).values()) == {"failed", "finished"}


@pytest.mark.parametrize(("signum", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupt_saves_and_starts_nothing_more(tmp_path: Path, signum: int, code: int) -> None:
  sweep = make_sweep(tmp_path / "sweep", 13, 13, 0, 1)
  process = controller(sweep)
  folders = [sweep.folder(job).path for job in sweep.jobs]
  slots = min(2, len(os.sched_getaffinity(0)))
  wait_for(lambda: sum((folder / "starts.jsonl").is_file() for folder in folders) == slots)
  process.send_signal(signum)
  assert process.wait(60) == code
  states = [state.status for state in sweep.states().values()]
  assert states == ["preempted"] * slots + ["queued"] * (4 - slots)
  assert "continues the sweep" in output(sweep)
  assert run(sweep) == 0
  assert set(statuses(sweep).values()) == {"finished"}


def test_a_stop_starts_nothing_more(tmp_path: Path) -> None:
  sweep = make_sweep(tmp_path / "sweep", 13, 13, 0, 1)
  process = controller(sweep)
  folders = [sweep.folder(job).path for job in sweep.jobs]
  slots = min(2, len(os.sched_getaffinity(0)))
  wait_for(lambda: sum((folder / "starts.jsonl").is_file() for folder in folders) == slots)
  assert command.stop(str(sweep.path)) == 0
  assert process.wait(60) == 4, "none has finished"
  states = sweep.states().values()
  assert [state.status for state in states] == ["preempted"] * slots + ["queued"] * (4 - slots)
  assert [state.attempt for state in states] == [1] * slots + [0] * (4 - slots)
  assert "Stopped by `playground sweep stop`" in output(sweep)


def test_a_second_interrupt_kills(tmp_path: Path) -> None:
  sweep = make_sweep(tmp_path / "sweep", 11)
  process = controller(sweep, "launcher.grace=60")
  wait_for(lambda: bool(starts(sweep)[11]))
  process.send_signal(signal.SIGINT)
  wait_for(lambda: "asked to stop" in output(sweep))
  process.send_signal(signal.SIGINT)
  assert process.wait(60) == 130
  assert statuses(sweep) == {11: "preempted"}
  assert not alive(starts(sweep)[11][0]["pid"])


def test_jobs_outlive_a_controller_that_is_killed(tmp_path: Path) -> None:
  sweep = make_sweep(tmp_path / "sweep", 15, 0, 1)
  process = controller(sweep)
  wait_for(lambda: bool(starts(sweep)[15]))
  process.kill()
  process.wait()
  assert run(sweep) == 0
  assert set(statuses(sweep).values()) == {"finished"}
  assert [len(found) for found in starts(sweep).values()] == [1, 1, 1], "nothing is done twice"


def test_a_worker_does_nothing_again(tmp_path: Path) -> None:
  """A killed controller may leave a worker that has yet to take its job's lock; the next controller starts another."""
  sweep = make_sweep(tmp_path / "sweep", 0)
  folder = sweep.folder(sweep.jobs[0])
  assert [Worker([folder.path], STUB).run() for _ in range(2)] == [0, 0]
  assert len(starts(sweep)[0]) == 1 and folder.state().status == "finished"


def test_a_killed_worker_loses_nothing(tmp_path: Path) -> None:
  sweep = make_sweep(tmp_path / "sweep", 15)
  process = controller(sweep)
  folder = sweep.folder(sweep.jobs[0])
  wait_for(lambda: bool(starts(sweep)[15]) and folder.record.get("status") == "running")
  os.kill(folder.record["pid"], signal.SIGKILL)
  assert folder.locked() and folder.state().status == "running", "the job itself is still at work"
  assert process.wait(60) == 0
  assert folder.state().status == "finished"


@pytest.mark.parametrize("status", ["finished", "preempted", "failed"])
def test_of_a_run_that_outlived_its_worker_its_own_status_counts(status: Any, tmp_path: Path) -> None:
  sweep = make_sweep(tmp_path / "sweep", 0)
  folder = sweep.folder(sweep.jobs[0])
  folder.write(status="running", started=now())
  folder.run.set_status(status, "its reason")
  state = folder.state()
  assert (state.status, state.reason) == (status, "its reason")
  folder.write(status="running", started="9999")
  assert folder.state().status == "killed", "that was an earlier start"


def test_a_job_whose_status_is_damaged_says_so(tmp_path: Path) -> None:
  sweep = make_sweep(tmp_path / "sweep", 0)
  folder = sweep.folder(sweep.jobs[0])
  folder.path.mkdir(parents=True)
  (folder.path / "status.json").write_text('{"status": ')
  assert run(sweep) == 1
  state = folder.state()
  assert state.status == "failed" and "status.json is damaged" in state.reason


def test_a_sweep_goes_on_where_nobody_reads_its_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  sweep = make_sweep(tmp_path / "sweep", 0, 1)
  reader, writer = os.pipe()
  os.close(reader)
  with os.fdopen(writer, "w") as stream:
    monkeypatch.setattr(sys, "stdout", stream)
    with lasting_stdout():
      assert run_sweep(sweep, compose_settings(["launcher.cores_per_job=1"]), STUB) == 0
  assert set(statuses(sweep).values()) == {"finished"}
  assert (sweep.path / "sweep.csv").is_file() and not sweep.stop_file.exists()


def test_one_process_at_a_time(tmp_path: Path) -> None:
  sweep = make_sweep(tmp_path / "sweep", 0)
  with sweep.controlled(), pytest.raises(CheckpointError, match=rf"is being run by process {os.getpid()} on "):
    run(sweep)


def test_the_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setattr(command, "run_sweep", lambda sweep, settings, _: run(sweep, f"on_error={settings.on_error}"))
  sweep = make_sweep(tmp_path / "sweep", 0, 14)
  path = str(sweep.path)
  assert command.status(path) == 0
  assert "2 queued" in " ".join(capsys.readouterr().out.split())
  assert command.retry(path) == 1
  assert command.retry(path, "on_error=stop") == 0
  (sweep.path / "sweep.csv").unlink()
  assert command.collect(path) == 0
  assert len(pd.read_csv(sweep.path / "sweep.csv")) == 2
  assert command.stop(path) == 0
  assert (sweep.path / "stop").exists()
  with pytest.raises(ConfigError, match="seed=3 cannot be changed in a sweep that has begun"):
    command.retry(path, "seed=3")
  with pytest.raises(CheckpointError, match=r"sweeep is not the folder of a sweep.*Did you mean 'sweep'"):
    command.status(str(tmp_path / "sweeep"))
