"""Sweeps of jobs that train nothing (`stub.py`)."""

import json
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from playground.config import compose_settings
from playground.sweep.folder import Job, SweepDirectory
from playground.sweep.runner import run_sweep

STUB = (sys.executable, str(Path(__file__).with_name("stub.py")))
CONTROLLER = """
import sys
from playground.sweep.folder import SweepDirectory
from tests.sweep.helpers import run
sys.exit(run(SweepDirectory.open(sys.argv[1]), *sys.argv[2:]))
"""


def make_sweep(path: Path, *seeds: int, needs: int | None = None, **varies: Any) -> SweepDirectory:
  """A sweep on disk with a job for each seed."""
  jobs = [Job(f"{i:03d}_seed={s}", [f"seed={s}"], {**varies, "seed": s}, needs, 100) for i, s in enumerate(seeds)]
  return SweepDirectory.create(path, "stub", ["playground-run", "-m"], [], ["seed=…"], jobs)


def run(sweep: SweepDirectory, *settings: str, command: Sequence[str] = STUB) -> int:
  """What is missing of a sweep, on two slots; its exit code."""
  settings = ("launcher.cores_per_job=1", *settings) if not any("launcher=" in s for s in settings) else settings
  with (sweep.path / "output.txt").open("a") as out:
    return run_sweep(sweep, compose_settings(settings), command, Console(file=out, width=200))


def controller(sweep: SweepDirectory, *settings: str) -> "subprocess.Popen[bytes]":
  """A process that runs the sweep."""
  return subprocess.Popen([sys.executable, "-c", CONTROLLER, str(sweep.path), *settings], cwd=Path(__file__).parents[2])


def wait_for(what: Callable[[], bool], seconds: float = 120) -> None:
  until = time.monotonic() + seconds
  while not what():
    assert time.monotonic() < until, "what the test waits for does not come"
    time.sleep(0.05)


def output(sweep: SweepDirectory) -> str:
  return (sweep.path / "output.txt").read_text()


def statuses(sweep: SweepDirectory) -> dict[int, str]:
  """How each job stands, by seed."""
  states = sweep.states()
  return {job.varies["seed"]: states[job.name].status for job in sweep.jobs}


def starts(sweep: SweepDirectory) -> dict[int, list[dict[str, Any]]]:
  """What each job found at each of its starts, by seed."""
  found = {}
  for job in sweep.jobs:
    file = sweep.folder(job).path / "starts.jsonl"
    found[job.varies["seed"]] = [json.loads(line) for line in file.read_text().splitlines()] if file.is_file() else []
  return found
