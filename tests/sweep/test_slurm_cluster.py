"""Sweeps on a real Slurm of one node (`slurm_cluster.py`); `make test-slurm`."""

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pytest

from playground.errors import HardwareError
from playground.sweep.folder import SweepDirectory
from tests.sweep.helpers import controller, make_sweep, output, run, starts, statuses, wait_for
from tests.sweep.slurm_cluster import CPUS, SlurmCluster, slurm_cluster
from tests.sweep.test_real import LINE, STEPS, rows

pytestmark = pytest.mark.slow

SLURM = ("launcher=slurm", "launcher.gpus_per_job=0", "launcher.memory_gb=1", "launcher.minutes=60")
NODE = (*SLURM, f"launcher.cores_per_job={CPUS}")  # a job at a time
SHARED = (*SLURM, "launcher.cores_per_job=1")


@pytest.fixture(scope="module")
def real() -> Iterator[SlurmCluster]:
  with slurm_cluster() as cluster:
    yield cluster


@pytest.fixture
def cluster(real: SlurmCluster, monkeypatch: pytest.MonkeyPatch) -> SlurmCluster:
  monkeypatch.setenv("SLURM_CONF", str(real.config))
  real.clear()
  return real


def ids(sweep: SweepDirectory) -> list[str]:
  """Slurm's number of each job; a second submission would show."""
  return [(sweep.folder(job).path / "slurm_id").read_text() for job in sweep.jobs]


def restarts(cluster: SlurmCluster, job_id: str) -> int:
  """How often Slurm queued a job again."""
  shown = cluster("scontrol", "show", "job", job_id)
  return int(shown.split("Restarts=")[1].split()[0])


@contextlib.contextmanager
def ended(process: "subprocess.Popen[bytes]") -> Iterator["subprocess.Popen[bytes]"]:
  """The process, which does not outlive the block."""
  try:
    yield process
  finally:
    process.kill()
    process.wait()


def playground(*args: str) -> str:
  """What the command prints, in a process that knows the sweep's folder only."""
  command = [sys.executable, "-m", "playground.cli.main", *args]
  return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, cwd=Path(__file__).parents[2]).stdout


def test_a_sweep(tmp_path: Path, cluster: SlurmCluster) -> None:
  sweep = make_sweep(tmp_path / "sweep", 0, 1, 10, 2)
  assert run(sweep, *SHARED) == 1
  assert statuses(sweep) == {0: "finished", 1: "finished", 10: "failed", 2: "finished"}
  table = pd.read_csv(sweep.path / "sweep.csv")
  assert list(table["status"]) == ["finished", "finished", "failed", "finished"]
  assert list(table["final_return"].dropna()) == [1.0, 2.0, 3.0]
  assert (sweep.path / "report.html").is_file()


def displaced(sweep: SweepDirectory, cluster: SlurmCluster) -> None:
  """Runs a sweep of job 13 only, whose place another takes meanwhile."""
  with ended(controller(sweep, *NODE)) as process:
    wait_for(lambda: bool(starts(sweep)[13]))
    cluster.preempt()
    assert process.wait(90) == 0, output(sweep)
  assert statuses(sweep) == {13: "finished"}
  assert [start["again"] for start in starts(sweep)[13]] == [False, True]
  assert "saved" in sweep.folder(sweep.jobs[0]).log.read_text()
  assert restarts(cluster, ids(sweep)[0]) == 1, "the same job, as Slurm sees it"


def test_what_another_job_displaces_saves_and_resumes(tmp_path: Path, cluster: SlurmCluster) -> None:
  displaced(make_sweep(tmp_path / "sweep", 13), cluster)


def test_displaced_where_slurm_gives_notice_by_sigterm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  with slurm_cluster(user_signal=False) as cluster:
    monkeypatch.setenv("SLURM_CONF", str(cluster.config))
    displaced(make_sweep(tmp_path / "sweep", 13), cluster)


def test_a_job_that_is_out_of_time_saves_and_goes_on(tmp_path: Path, cluster: SlurmCluster) -> None:
  sweep = make_sweep(tmp_path / "sweep", 13)
  assert run(sweep, *NODE, "launcher.minutes=1", "launcher.grace=5") == 0
  assert statuses(sweep) == {13: "finished"}
  assert [start["again"] for start in starts(sweep)[13]] == [False, True]
  assert restarts(cluster, ids(sweep)[0]) == 1


def test_stop_ends_what_runs_and_what_waits(tmp_path: Path, cluster: SlurmCluster) -> None:
  sweep = make_sweep(tmp_path / "sweep", 13, 0)
  with ended(controller(sweep, *NODE)) as process:
    wait_for(lambda: bool(starts(sweep)[13]))
    playground("sweep", "stop", str(sweep.path))
    assert process.wait(60) == 2, "neither finished"
  assert statuses(sweep) == {13: "preempted", 0: "preempted"}
  assert not starts(sweep)[0] and not cluster.queue()
  assert run(sweep, *NODE) == 0
  assert statuses(sweep) == {13: "finished", 0: "finished"}


def test_jobs_outlive_who_started_them(tmp_path: Path, cluster: SlurmCluster) -> None:
  sweep = make_sweep(tmp_path / "sweep", 13, 15)
  with ended(controller(sweep, *NODE)):
    wait_for(lambda: bool(starts(sweep)[13]))
  assert sorted(cluster.queue()) == ["PENDING", "RUNNING"]
  shown = playground("sweep", "status", str(sweep.path))
  assert "running" in shown and "submitted" in shown

  first = ids(sweep)
  cluster("scontrol", "requeue", first[0])  # so that it waits while nobody looks
  wait_for(lambda: statuses(sweep)[15] == "finished")
  assert "sweep.csv" in playground("sweep", "collect", str(sweep.path))
  assert list(pd.read_csv(sweep.path / "sweep.csv")["status"]) == ["preempted", "finished"]
  assert run(sweep, *NODE) == 0
  assert statuses(sweep) == {13: "finished", 15: "finished"}
  assert ids(sweep) == first, "nothing is submitted twice"


def test_a_cancelled_job_is_seen_to_have_ended(tmp_path: Path, cluster: SlurmCluster) -> None:
  sweep = make_sweep(tmp_path / "sweep", 11, 13)
  with ended(controller(sweep, *SHARED)) as process:
    wait_for(lambda: all(starts(sweep).values()))
    cluster("scancel", *ids(sweep))
    assert process.wait(60) == 1, output(sweep)
  assert statuses(sweep) == {11: "killed", 13: "preempted"}, "13 listens and has saved"
  assert run(sweep, *SHARED, "launcher.timeout=1", "launcher.grace=1") == 1
  assert statuses(sweep) == {11: "timeout", 13: "finished"}


def test_training_goes_on_where_it_was_displaced(tmp_path: Path, cluster: SlurmCluster) -> None:
  line = [word for word in LINE if not word.startswith(("seed=", "launcher."))]
  line += ["seed=1", f"sweep_dir={tmp_path / 'sweep'}", *NODE]
  command = [sys.executable, "-m", "playground.cli.run", "-m", *line]
  with ended(subprocess.Popen(command, cwd=Path(__file__).parents[2])) as process:
    wait_for(lambda: rows(tmp_path) >= 3, 300)
    cluster.preempt()
    assert process.wait(600) == 0
  sweep = SweepDirectory.open(tmp_path / "sweep")
  table = pd.read_csv(sweep.path / "sweep.csv")
  assert list(table[["status", "steps", "attempts"]].iloc[0]) == ["finished", STEPS, 2]
  assert restarts(cluster, ids(sweep)[0]) == 1
  assert "Resuming the whole training state" in sweep.folder(sweep.jobs[0]).log.read_text()


def test_what_slurm_refuses(tmp_path: Path, cluster: SlurmCluster) -> None:
  sweep = make_sweep(tmp_path / "sweep", 0)
  with pytest.raises(HardwareError, match=r"sbatch refused job 000_seed=0 \(.*Invalid partition name specified"):
    run(sweep, *SHARED, "launcher.partition=none")
  assert statuses(sweep) == {0: "queued"}
