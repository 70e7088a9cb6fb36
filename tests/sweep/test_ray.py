"""Jobs on a Ray cluster that the test starts on this machine."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import ray

from playground.config.sweep_options import RayConfig
from playground.errors import HardwareError
from playground.sweep.ray import RayLauncher
from tests.sweep.helpers import make_sweep, run, starts, statuses, wait_for

slow = pytest.mark.slow  # starting Ray takes most of a minute on two cores


@pytest.fixture(scope="module")
def cluster() -> Iterator[None]:
  ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
  yield
  ray.shutdown()


@pytest.mark.parametrize(
  ("address", "why"),
  [
    ("127.0.0.1:1", "Connection refused"),
    ("ray://127.0.0.1:1", "Connection refused"),
    ("127.0.0.1:x", "Port"),
    ("http://127.0.0.1:1", "write auto, local, host:port or ray://host:port"),
  ],
)
def test_nobody_at_the_address(tmp_path: Path, address: str, why: str) -> None:
  sweep = make_sweep(tmp_path / "sweep", 0, needs=0)
  begun = time.monotonic()
  with pytest.raises(HardwareError, match=rf"launcher=ray: no cluster at {address}: .*{why}"):
    run(sweep, "launcher=ray", f"launcher.address='{address}'")
  assert time.monotonic() - begun < 10, "Ray would go on trying for a minute"


@slow
def test_whatever_ends_a_job_the_others_go_on(tmp_path: Path, cluster: None) -> None:
  sweep = make_sweep(tmp_path / "sweep", 10, 11, 0, 1, needs=0)
  line = ["launcher=ray", "launcher.cores_per_job=1", "launcher.timeout=2", "launcher.grace=0.5"]
  assert run(sweep, *line) == 2
  assert statuses(sweep) == {10: "failed", 11: "timeout", 0: "finished", 1: "finished"}
  assert run(sweep, *line) == 2
  assert [len(found) for found in starts(sweep).values()] == [2, 2, 1, 1], "only what is missing"


@slow
def test_on_error_stop(tmp_path: Path, cluster: None) -> None:
  sweep = make_sweep(tmp_path / "sweep", 13, 10, needs=0)
  assert run(sweep, "launcher=ray", "launcher.cores_per_job=1", "on_error=stop") == 1
  assert statuses(sweep) == {13: "preempted", 10: "failed"}


@slow
def test_more_than_the_cluster_has(tmp_path: Path, cluster: None) -> None:
  sweep = make_sweep(tmp_path / "sweep", 0, needs=2)
  with pytest.raises(
    HardwareError, match=r"Job 000_seed=0 takes 2 GPUs and 2 cores, but the largest node .* has 0 and 2"
  ):
    run(sweep, "launcher=ray")
  assert statuses(sweep) == {0: "queued"}


def test_by_default_a_job_fits_on_a_small_machine(tmp_path: Path, cluster: None) -> None:
  sweep = make_sweep(tmp_path / "sweep", 0, needs=0)
  assert run(sweep, "launcher=ray") == 0
  assert statuses(sweep) == {0: "finished"}


def test_a_job_fits_on_one_node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  nodes = [{"Alive": alive, "Resources": {"CPU": cores}} for alive, cores in ((True, 2), (True, 3), (False, 8))]
  monkeypatch.setattr(ray, "is_initialized", lambda: True)
  monkeypatch.setattr(ray, "nodes", lambda: nodes)
  jobs = make_sweep(tmp_path / "sweep", 0, needs=0).jobs
  RayLauncher.check(RayConfig(cores_per_job=3), jobs)
  with pytest.raises(
    HardwareError, match="takes 0 GPUs and 4 cores, but the largest node of Ray's cluster has 0 and 3"
  ):
    RayLauncher.check(RayConfig(cores_per_job=4), jobs)


def meanwhile(what: Callable[[], object]) -> None:
  ThreadPoolExecutor(1).submit(what)


@slow
def test_a_job_whose_worker_is_killed_is_resumed(tmp_path: Path, cluster: None) -> None:
  """By Ray's retry: it asks the process that goes on to save."""
  sweep = make_sweep(tmp_path / "sweep", 13, needs=0)
  (job,) = sweep.jobs

  def kill() -> None:
    wait_for(lambda: starts(sweep)[13] != [] and sweep.folder(job).record.get("status") == "running")
    os.kill(int(str(sweep.folder(job).record["pid"])), signal.SIGKILL)

  meanwhile(kill)
  assert run(sweep, "launcher=ray", "launcher.cores_per_job=1") == 0
  assert [start["again"] for start in starts(sweep)[13]] == [False, True]


@slow
def test_a_stopped_sweep_does_not_wait_for_its_turn(tmp_path: Path, cluster: None) -> None:
  others = ray.remote(num_cpus=2)(lambda: time.sleep(120)).remote()
  sweep = make_sweep(tmp_path / "sweep", 0, needs=0)

  def stop() -> None:
    wait_for(lambda: statuses(sweep) == {0: "submitted"})
    sweep.stop_file.touch()

  meanwhile(stop)
  begun = time.monotonic()
  assert run(sweep, "launcher=ray", "launcher.cores_per_job=1") == 1
  assert statuses(sweep) == {0: "preempted"} and time.monotonic() - begun < 60
  ray.cancel(others, force=True)


def test_a_cluster_that_goes_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cluster: None) -> None:
  def gone(*_: object, **__: object) -> None:
    raise ConnectionError("Client is shutting down.")

  monkeypatch.setattr(ray, "wait", gone)
  with pytest.raises(
    HardwareError, match=r"the cluster is gone \(Client is shutting down\.?\); the same command runs what"
  ):
    run(make_sweep(tmp_path / "sweep", 0, needs=0), "launcher=ray")
