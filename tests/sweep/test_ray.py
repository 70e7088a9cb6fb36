"""Jobs on a Ray cluster that the test starts on this machine."""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import ray

from playground.errors import HardwareError
from tests.sweep.helpers import make_sweep, run, starts, statuses

slow = pytest.mark.slow  # starting Ray takes most of a minute on two cores


@pytest.fixture(scope="module")
def cluster() -> Iterator[None]:
  ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
  yield
  ray.shutdown()


@pytest.mark.parametrize(
  ("address", "why"),
  [("127.0.0.1:1", "Connection refused"), ("ray://127.0.0.1:1", "Connection refused"), ("127.0.0.1:x", "Port")],
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
  with pytest.raises(HardwareError, match=r"Job 000_seed=0 takes 2 GPUs and 2 cores, but Ray's cluster has 0 and 2"):
    run(sweep, "launcher=ray")
  assert statuses(sweep) == {0: "queued"}


def test_by_default_a_job_fits_on_a_small_machine(tmp_path: Path, cluster: None) -> None:
  sweep = make_sweep(tmp_path / "sweep", 0, needs=0)
  assert run(sweep, "launcher=ray") == 0
  assert statuses(sweep) == {0: "finished"}
