"""The files of a sweep, and how its jobs stand by them."""

import contextlib
import dataclasses
import datetime
import fcntl
import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import yaml

from playground.errors import CheckpointError, nearest
from playground.runs.files import read_json, write_json, write_text

Status = Literal["queued", "submitted", "running", "finished", "failed", "timeout", "preempted", "killed"]
ENDED = ("finished", "failed", "timeout", "preempted", "killed")
STOP_FILE = "stop"
FAILED = ("failed", "timeout", "killed")


@dataclasses.dataclass(frozen=True)
class Job:
  """One run of a sweep.

  Attributes:
    name: of its folder.
    overrides: its command line.
    varies: the part of it in which the sweep's jobs differ, by key.
    needs: how many GPUs it takes on its machine; None is one if there is any.
    steps: its budget.
  """

  name: str
  overrides: list[str]
  varies: dict[str, Any]
  needs: int | None = None
  steps: int | None = None


@dataclasses.dataclass(frozen=True)
class JobState:
  """How a job stands; `where`, `attempt` and the times (ISO 8601) are of its last start."""

  status: Status = "queued"
  reason: str = ""
  attempt: int = 0
  started: str | None = None
  ended: str | None = None
  where: str = ""

  @property
  def seconds(self) -> float | None:
    """How long the last start took, or has taken so far."""
    if self.started is None:
      return None
    end = datetime.datetime.fromisoformat(self.ended) if self.ended else datetime.datetime.now(datetime.UTC)
    return (end - datetime.datetime.fromisoformat(self.started)).total_seconds()


class JobFolder:
  """Where a job's run lies, and what its worker says of it."""

  def __init__(self, path: Path):
    self.path = path
    self.record_path = path / "job.json"
    self.log = path / "job.log"

  @property
  def begun(self) -> bool:
    """Whether there is a run to resume."""
    return (self.path / "config.yaml").is_file()

  @property
  def record(self) -> dict[str, Any]:
    return read_json(self.record_path)

  def write(self, **fields: Any) -> None:
    """Records how the job stands."""
    self.path.mkdir(parents=True, exist_ok=True)
    write_json(self.record_path, fields)

  def state(self) -> JobState:
    """How the job stands, also if its worker had no time to say so."""
    record = self.record
    fields = {f.name: record[f.name] for f in dataclasses.fields(JobState) if f.name in record}
    state = JobState(**fields)
    if state.status != "running" or self.locked():
      return state
    if read_json(self.path / "status.json").get("status") == "finished":  # it outlived its worker
      return dataclasses.replace(state, status="finished")
    return dataclasses.replace(state, status="killed", reason="its process is gone without a word")

  @contextlib.contextmanager
  def claim(self, patience_s: float = 2.0) -> Iterator[int | None]:
    """Holds the job as long as the block runs; yields a file descriptor, or None if somebody else has it.

    Processes that inherit the descriptor hold the job, too: what outlives its worker is still at work.
    """
    self.path.mkdir(parents=True, exist_ok=True)
    handle = os.open(self.path / "job.lock", os.O_CREAT | os.O_RDWR, 0o666)
    try:
      until = time.monotonic() + patience_s  # `locked` holds it for a moment to see
      while not (got := _try_lock(handle, fcntl.LOCK_EX)) and time.monotonic() < until:
        time.sleep(0.05)
      yield handle if got else None
    finally:
      os.close(handle)

  def locked(self) -> bool:
    """Whether a process is at the job, on this machine or another that shares its folder."""
    try:
      handle = os.open(self.path / "job.lock", os.O_RDWR)
    except FileNotFoundError:
      return False
    try:
      return not _try_lock(handle, fcntl.LOCK_SH)
    finally:
      os.close(handle)

  def progress(self) -> tuple[int | None, float | None]:
    """Steps trained and the last evaluation's return, as its metrics.csv has them."""
    try:
      with (self.path / "metrics.csv").open("rb") as file:
        columns = file.readline().decode().strip().split(",")
        file.seek(max(file.tell(), file.seek(0, os.SEEK_END) - 16384))
        rows = [line.split(",") for line in file.read().decode(errors="replace").split("\n")[:-1]]
    except (FileNotFoundError, ValueError):
      return None, None
    rows = [row for row in rows if len(row) == len(columns)]
    if not rows:
      return None, None
    column = columns.index("eval/episode_reward") if "eval/episode_reward" in columns else None
    returns = [row[column] for row in rows if row[column]] if column is not None else []
    return int(rows[-1][0]), float(returns[-1]) if returns else None


class SweepDirectory:
  """A sweep on disk. Get one from `create` or `open`."""

  def __init__(self, path: str | Path, content: dict[str, Any]):
    self.path = Path(path)
    self._content = content
    self.jobs = [Job(**job) for job in content["jobs"]]

  @classmethod
  def create(
    cls, path: str | Path, name: str, command: Sequence[str], settings: Sequence[str], lines: Sequence[str],
    jobs: Sequence[Job],
  ) -> "SweepDirectory":  # fmt: skip
    """Makes the folder and writes sweep.yaml.

    Args:
      path: the folder.
      name: the sweep's.
      command: the command line, to be read by people.
      settings: the overrides that say how it is run.
      lines: the overrides that its jobs are made of.
      jobs: those.
    """
    content = {
      "name": name,
      "created": now(),
      "cwd": str(Path.cwd()),
      "command": list(command),
      "settings": list(settings),
      "lines": list(lines),
      "jobs": [dataclasses.asdict(job) for job in jobs],
    }
    sweep = cls(path, content)
    try:
      sweep.path.mkdir(parents=True, exist_ok=True)
      sweep._write()
    except OSError as error:
      raise CheckpointError(f"sweep_dir={path} cannot be written: {error.strerror}.") from error
    return sweep

  @classmethod
  def open(cls, path: str | Path) -> "SweepDirectory":
    """Reads the sweep at `path`; raises CheckpointError if there is none."""
    path = Path(path).expanduser()
    file = path / "sweep.yaml"
    if not file.is_file():
      siblings = [p.name for p in path.parent.glob("*/")] if path.parent.is_dir() else []
      near = "" if path.is_dir() else nearest(path.name, siblings)
      raise CheckpointError(f"{path} is not the folder of a sweep: it has no sweep.yaml.{near}")
    try:
      return cls(path, yaml.safe_load(file.read_text(encoding="utf-8")))
    except (yaml.YAMLError, KeyError, TypeError, UnicodeDecodeError):
      raise CheckpointError(f"{file} is damaged.") from None

  @property
  def name(self) -> str:
    return self._content["name"]

  @property
  def cwd(self) -> Path:
    """Where it was started: relative paths in overrides are from there."""
    return Path(self._content["cwd"])

  @property
  def command(self) -> list[str]:
    return self._content["command"]

  @property
  def settings(self) -> list[str]:
    return self._content["settings"]

  @property
  def lines(self) -> list[str]:
    return self._content["lines"]

  @property
  def group(self) -> str:
    """What its runs have in common in W&B."""
    return f"{self.name}/{self.path.resolve().name}"

  @property
  def stop_file(self) -> Path:
    """While it is there, workers stop their jobs, wherever they run."""
    return self.path / STOP_FILE

  def folder(self, job: Job) -> JobFolder:
    return JobFolder(self.path / "jobs" / job.name)

  def states(self) -> dict[str, JobState]:
    """How every job stands, by name."""
    return {job.name: self.folder(job).state() for job in self.jobs}

  def add(self, job: Job) -> None:
    """Another job, of a search."""
    self.jobs.append(job)
    self._content["jobs"].append(dataclasses.asdict(job))
    self._write()

  @contextlib.contextmanager
  def controlled(self) -> Iterator[bool]:
    """Holds the sweep as long as the block runs; yields False if another process does."""
    handle = os.open(self.path / "sweep.lock", os.O_CREAT | os.O_RDWR, 0o666)
    try:
      yield _try_lock(handle, fcntl.LOCK_EX)
    finally:
      os.close(handle)

  def _write(self) -> None:
    write_text(self.path / "sweep.yaml", yaml.safe_dump(self._content, sort_keys=False, allow_unicode=True))


def now() -> str:
  return datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")


def _try_lock(handle: int, kind: int) -> bool:
  try:
    fcntl.flock(handle, kind | fcntl.LOCK_NB)
  except OSError:
    return False
  return True
