"""Jobs through submitit: its local executor in place of Slurm, its preemption, and what sbatch would be told."""

import os
import signal
import time
from pathlib import Path

import pytest
import submitit

from playground.config import compose_settings
from playground.config.sweep_options import SlurmConfig
from playground.errors import ConfigError, HardwareError
from playground.sweep import slurm
from playground.sweep.folder import Job
from playground.sweep.slurm import Queue, SlurmLauncher, slurm_parameters
from tests.sweep.helpers import STUB, make_sweep, run, starts, statuses


@pytest.fixture
def local(monkeypatch: pytest.MonkeyPatch) -> list[SlurmLauncher]:
  """Makes every Slurm launcher use submitit's local executor; returns those made."""
  made: list[SlurmLauncher] = []

  class Local(SlurmLauncher):
    check = staticmethod(lambda config, jobs: None)  # there need be no Slurm

    def __init__(self, sweep, config, command):  # pyright: ignore
      executor = submitit.LocalExecutor(sweep.path.absolute() / "slurm")
      executor.update_parameters(timeout_min=60, signal_delay_s=1)
      super().__init__(sweep, config, command, executor)
      made.append(self)

  monkeypatch.setattr(slurm, "SlurmLauncher", Local)
  return made


def test_jobs_go_through_submitit(tmp_path: Path, local: list[SlurmLauncher]) -> None:
  sweep = make_sweep(tmp_path / "sweep", 0, 10)
  assert run(sweep, "launcher=slurm", "launcher.max_parallel=2") == 1
  assert statuses(sweep) == {0: "finished", 10: "failed"}
  assert run(sweep, "launcher=slurm") == 1
  assert [len(found) for found in starts(sweep).values()] == [1, 2]


def test_a_preempted_job_saves_is_queued_again_and_resumes(tmp_path: Path, local: list[SlurmLauncher]) -> None:
  sweep = make_sweep(tmp_path / "sweep", 13)
  launcher = slurm.SlurmLauncher(sweep, SlurmConfig(), STUB)
  (job,) = sweep.jobs
  assert launcher.start(job)
  until = time.monotonic() + 120
  while not starts(sweep)[13]:
    assert time.monotonic() < until
    time.sleep(0.05)
  for process in ("job_pid", "pid"):  # as Slurm does, for submitit to handle; some tell every process of a job
    os.kill(sweep.folder(job).record[process], signal.SIGUSR2)
  while launcher.busy(job):
    assert time.monotonic() < until + 40, statuses(sweep)
    time.sleep(0.1)
  assert statuses(sweep) == {13: "finished"}
  assert [start["again"] for start in starts(sweep)[13]] == [False, True]
  assert "saved" in sweep.folder(job).log.read_text()


def test_submitting_without_waiting(tmp_path: Path, local: list[SlurmLauncher]) -> None:
  sweep = make_sweep(tmp_path / "sweep", 0)
  assert run(sweep, "launcher=slurm", "launcher.wait=false") == 0
  until = time.monotonic() + 120
  while statuses(sweep) != {0: "finished"}:
    assert time.monotonic() < until
    time.sleep(0.1)
  assert run(sweep, "launcher=slurm", "launcher.wait=false") == 0
  assert len(starts(sweep)[0]) == 1


def test_what_sbatch_is_told() -> None:
  config = SlurmConfig(partition="gpu", minutes=90)
  told = slurm_parameters(config, Job("a", [], {}, needs=2))
  assert (told["gpus_per_node"], told["time"], told["mem"], told["partition"]) == (2, 90, "32GB", "gpu")
  assert told["signal_delay_s"] > config.grace
  assert "account" not in told
  assert slurm_parameters(config, Job("a", [], {}))["gpus_per_node"] == 1
  assert "gpus_per_node" not in slurm_parameters(config, Job("a", [], {}, needs=0))
  executor = submitit.SlurmExecutor.__new__(submitit.SlurmExecutor)
  assert set(told) <= set(executor._valid_parameters()), "submitit knows them all"
  with pytest.raises(ConfigError, match=r"^launcher\.gpus_per_job=0\.5 must be a whole number"):  # sbatch shares none
    compose_settings(["launcher=slurm", "launcher.gpus_per_job=0.5"])


def test_without_slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setenv("PATH", str(tmp_path))  # some machines have one
  sweep = make_sweep(tmp_path / "sweep", 0)
  with pytest.raises(HardwareError, match="there is no sbatch here"):
    run(sweep, "launcher=slurm")
  program(tmp_path / "sbatch", "")
  with pytest.raises(HardwareError, match="there is no squeue here"):
    run(sweep, "launcher=slurm")
  with pytest.raises(ConfigError, match=r"^launcher\.parameters has parsable, .*: drop it\.$"):
    run(sweep, "launcher=slurm", "launcher.parameters={parsable: true}")
  with pytest.raises(ConfigError, match=r"leave launcher\.max_parallel out"):
    run(sweep, "launcher=slurm", "launcher.wait=false", "launcher.max_parallel=3")
  with pytest.raises(ConfigError, match=r"launcher\.minutes=1 leaves no time to train: .* save 90 s"):
    run(sweep, "launcher=slurm", "launcher.minutes=1")


def program(path: Path, script: str) -> None:
  path.write_text(f"#!/bin/sh\n{script}\n")
  path.chmod(0o755)


@pytest.mark.parametrize(
  ("script", "message"),
  [
    (
      "echo a word >&2; echo sbatch: error: No such partition >&2; exit 1",
      "refused job 000_seed=0 \\(error: No such partition\\)",
    ),
    ("exit 1", "refused job 000_seed=0 \\(without a reason\\)"),
    (
      "echo queued as foo",
      "names no number of job 000_seed=0 \\(Could not .*foo.*\\): if squeue shows the job, cancel it",
    ),
  ],
)
def test_what_sbatch_refuses_is_one_sentence(
  tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str, message: str
) -> None:
  for name in ("sbatch", "srun", "squeue"):
    program(tmp_path / name, script if name == "sbatch" else "")
  monkeypatch.setenv("PATH", str(tmp_path))
  sweep = make_sweep(tmp_path / "sweep", 0, needs=0)
  with pytest.raises(HardwareError, match=rf"^launcher=slurm: sbatch {message}"):
    run(sweep, "launcher=slurm")
  assert statuses(sweep) == {0: "queued"}


@pytest.mark.parametrize("script", ["exit 1", "sleep 60", None])
def test_a_queue_without_an_answer_is_unknown(
  tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str | None
) -> None:
  monkeypatch.setattr(slurm, "ANSWER_S", 0.2)
  if script is not None:
    program(tmp_path / "squeue", f"PATH=/bin:/usr/bin {script}")
  monkeypatch.setenv("PATH", str(tmp_path))
  assert Queue().state("7") == "UNKNOWN"


def test_a_search_waits_for_its_jobs() -> None:
  with pytest.raises(ConfigError, match=r"launcher\.wait=false submits all jobs at once, but a search draws them one"):
    compose_settings(["launcher=slurm", "launcher.wait=false", "search=optuna"])
