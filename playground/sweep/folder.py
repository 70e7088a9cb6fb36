"""Reads and writes the files of a sweep and the states of its jobs."""

import contextlib
import dataclasses
import datetime
import os
import re
import socket
import types
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import NoneType
from typing import Literal

import yaml

from playground.config import RunConfig, format_value, is_of_command
from playground.config.overrides import SHORT_KEYS
from playground.errors import CheckpointError, ConfigError, nearest
from playground.files import (
  check_links,
  is_locked,
  lock_holder,
  locking,
  make_numbered,
  read_json,
  read_yaml,
  write_json,
  write_text,
)
from playground.runs.csv_tracker import RETURN
from playground.runs.run_dir import RunDirectory, now
from playground.settings import Plain, select
from playground.text import dump_yaml, first_line

Status = Literal["queued", "submitted", "running", "finished", "failed", "timeout", "preempted", "killed"]
ENDED = ("finished", "failed", "timeout", "preempted", "killed")
STOP_FILE = "stop"
_JOB_NAME = re.compile(r"\w[\w.=+-]*")
FAILED = ("failed", "timeout", "killed")


@dataclasses.dataclass(frozen=True)
class Job:
  """One process of a sweep or benchmark.

  Attributes:
    name: name of the job's folder.
    overrides: the job's arguments, to which the worker adds the folder.
    varies: the values in which the sweep's jobs differ, by key.
    needs: number of GPUs; None is one if there is any.
    steps: budget of environment steps.
    task: name of the task, of a chain's last; "" in the files of earlier versions.
  """

  name: str
  overrides: list[str]
  varies: dict[str, Plain]
  needs: int | None = None
  steps: int | None = None
  task: str = ""

  @classmethod
  def of_run(cls, number: int, overrides: Sequence[str], varying: Sequence[str], config: RunConfig) -> "Job":
    """Makes a job of a run.

    Args:
      number: position in the sweep.
      overrides: command line.
      varying: the keys in which jobs differ.
      config: the run's configuration.

    Raises:
      ConfigError: the run needs several machines.
    """
    varies = {key: _value(config, key) for key in varying}
    own = {text.partition("=")[0].lstrip("+~") for text in overrides}  # listed jobs may lack a key that others set
    named = {key: value for key, value in varies.items() if key in own}
    short = lambda v: f"{v:.4g}" if isinstance(v, float) else format_value(v)
    words = [short(v) if "." not in k and k != "seed" else f"{k.split('.')[-1]}={short(v)}" for k, v in named.items()]
    text = re.sub(r"[^A-Za-z0-9._=+-]+", "-", "_".join(words or [config.name]))[:80].strip("-.")
    if config.hardware.distributed.enable:
      raise ConfigError("hardware=multi_node cannot be given with -m: a job of a sweep runs on one machine.")
    needs = 0 if config.hardware.platform == "cpu" else config.hardware.devices
    stages = [stage.agent.num_timesteps for stage in config.stages]
    steps = sum(stages) if stages else config.agent.num_timesteps
    kept = [text for text in overrides if not is_of_command(text)]
    return cls(f"{number:03d}_{text}", kept, varies, needs, int(steps), _task(config))


def _task(config: RunConfig) -> str:
  """Returns the task of a run, of a chain that of its last stage, whose return is the chain's."""
  return str((config.stages or [config])[-1].choices["env"])


def _value(config: RunConfig, key: str) -> Plain:
  """Returns a job's value of a key or group."""
  if key == "env":
    return _task(config)
  if key in config.choices:
    return config.choices[key]
  value = select(config.resolved, SHORT_KEYS.get(key, key))
  return format_value(value) if isinstance(value, list | Mapping) else value


@dataclasses.dataclass(frozen=True)
class JobState:
  """The state of a job; `where`, `attempt` and the times (ISO 8601) are those of the job's last start."""

  status: Status = "queued"
  reason: str = ""
  attempt: int = 0
  started: str | None = None
  ended: str | None = None
  where: str = ""

  @property
  def seconds(self) -> float | None:
    """Returns the duration of the last start so far, s."""
    if self.started is None:
      return None
    try:
      end = datetime.datetime.fromisoformat(self.ended) if self.ended else datetime.datetime.now(datetime.UTC)
      return (end - datetime.datetime.fromisoformat(self.started)).total_seconds()
    except (ValueError, TypeError):  # no time, or one without a zone: the record is damaged
      return None


def _printable(value: Plain) -> Plain:
  """Returns a value of a job's record, text without the characters that steer a terminal."""
  return "".join(filter(str.isprintable, value)) if isinstance(value, str) else value


class JobFolder:
  """Reads and writes a job's run directory and the worker's record in it."""

  def __init__(self, path: Path):
    self.path = path
    self.record_path = path / "job.json"
    self.log = path / "job.log"

  @property
  def begun(self) -> bool:
    """Whether the job has a run to resume."""
    return (self.path / "config.yaml").is_file()

  @property
  def record(self) -> dict[str, Plain]:
    """The content of job.json; empty without one."""
    optional = (str, NoneType)
    kinds = {"status": str, "reason": str, "attempt": int, "started": optional, "ended": optional, "where": str}
    return read_json(self.record_path, job_pid=int, **kinds)

  @property
  def run(self) -> RunDirectory:
    """The job's run directory."""
    return RunDirectory(self.path)

  def write(self, **fields: object) -> None:
    """Records the job's state."""
    self.path.mkdir(parents=True, exist_ok=True)
    write_json(self.record_path, fields)

  def write_waiting(self, status: Literal["queued", "submitted"]) -> None:
    """Records that the job waits for its next start."""
    self.write(status=status, attempt=self.record.get("attempt", 0))

  def state(self) -> JobState:
    """Returns the job's state, even if its worker was killed before it recorded the end."""
    record = self.record
    fields = {f.name: _printable(record[f.name]) for f in dataclasses.fields(JobState) if f.name in record}
    state = JobState(**fields)
    if state.status != "running" or self.locked():
      return state
    run = self.run.status
    if run.get("status") in ENDED and run.get("updated", "") >= (record.get("started") or ""):  # it outlived its worker
      return dataclasses.replace(state, status=run["status"], reason=_printable(run.get("reason", "")))
    return dataclasses.replace(state, status="killed", reason="its process is gone without a word")

  @contextlib.contextmanager
  def claim(self, patience_s: float = 2.0) -> Iterator[int | None]:
    """Holds the job's lock during the block; yields its file descriptor, or None if another process holds it.

    Processes that inherit the descriptor hold the lock, too: a run that outlives its worker still counts as running.
    """
    self.path.mkdir(parents=True, exist_ok=True)
    with locking(self.path / "job.lock", patience_s) as lock:  # `locked` holds the lock for a moment
      yield lock

  def locked(self) -> bool:
    """Returns whether a process runs the job, on this machine or on another that shares the folder."""
    return is_locked(self.path / "job.lock")

  def signal(self, signum: int, group: bool = False) -> None:
    """Signals the job's process, with `group` its children, too; does nothing for a process of another machine."""
    record = self.record
    pid = record.get("job_pid", 0)
    if record.get("host") == socket.gethostname() and pid > 1:  # else another process of this machine's
      with contextlib.suppress(ProcessLookupError, PermissionError):
        (os.killpg if group else os.kill)(pid, signum)

  def progress(self) -> tuple[int | None, float | None]:
    """Returns trained steps and the last evaluation's return, from metrics.csv."""
    if not (path := self.path / "metrics.csv").is_file():
      return None, None
    try:
      with path.open("rb") as file:
        columns = file.readline().decode().strip().split(",")
        file.seek(max(file.tell(), file.seek(0, os.SEEK_END) - 16384))
        rows = [line.split(",") for line in file.read().decode(errors="replace").split("\n")[:-1]]
      rows = [row for row in rows if len(row) == len(columns)]
      column = columns.index(RETURN) if RETURN in columns else None
      returns = [row[column] for row in rows if row[column]] if column is not None else []
      return int(rows[-1][0]) if rows else None, float(returns[-1]) if returns else None
    except (FileNotFoundError, ValueError):  # none yet, or damaged
      return None, None


@dataclasses.dataclass
class SweepDirectory:
  """A sweep on disk; `create` or `open` returns one.

  Attributes:
    path: folder of the sweep.
    name: name of the sweep.
    command: the command line, to show to users.
    settings: the overrides of the sweep itself.
    lines: the overrides of the jobs, with several values each.
    jobs: the jobs.
    cwd: the working directory of the command, where relative paths in overrides start.
    created: time of creation (ISO 8601).
  """

  path: Path
  name: str
  command: list[str]
  settings: list[str]
  lines: list[str]
  jobs: list[Job]
  cwd: Path
  created: str = ""

  @classmethod
  def create(
    cls, path: str | Path, name: str, command: Sequence[str], settings: Sequence[str], lines: Sequence[str],
    jobs: Sequence[Job], numbered: bool = False,
  ) -> "SweepDirectory":  # fmt: skip
    """Makes the folder and writes sweep.yaml; see the attributes. Raises CheckpointError if it fails or there is one.

    With `numbered` it is a new folder, `<path>_2`, ... where the name is taken, as by a sweep of the same second.
    """
    path = Path(os.path.expanduser(path))
    try:
      path = make_numbered(path) if numbered else path
      sweep = cls(path, name, list(command), list(settings), list(lines), list(jobs), Path.cwd(), now())
      sweep.path.mkdir(parents=True, exist_ok=True)
      with sweep.controlled():
        if (sweep.path / "sweep.yaml").exists():
          raise CheckpointError(f"sweep_dir={path} became another sweep's while this one started: repeat the command.")
        sweep.save()
    except OSError as error:
      raise CheckpointError(f"sweep_dir={path} cannot be written: {error.strerror}.") from error
    return sweep

  @classmethod
  def open(cls, path: str | Path) -> "SweepDirectory":
    """Reads the sweep at `path`; raises CheckpointError if there is none."""
    path = Path(os.path.expanduser(path))
    file = path / "sweep.yaml"
    if not file.is_file():
      siblings = [p.name for p in path.parent.glob("*/")] if path.parent.is_dir() else []
      near = "" if path.is_dir() else nearest(path.name, siblings)
      raise CheckpointError(f"{path} is not the folder of a sweep: it has no sweep.yaml.{near}")
    try:
      content = read_yaml(file)
      _check(content)
      return cls(path, **content | {"jobs": [Job(**job) for job in content["jobs"]], "cwd": Path(content["cwd"])})
    except (yaml.YAMLError, TypeError, ValueError, RecursionError) as error:
      raise CheckpointError(f"{file} is damaged: {first_line(error)}.") from None

  @property
  def group(self) -> str:
    """The group of the sweep's runs in W&B."""
    return f"{self.name}/{self.path.resolve().name}"

  def in_cwd(self) -> contextlib.AbstractContextManager[None]:
    """Changes to `cwd` for a while: relative paths in overrides mean what they mean to the jobs."""
    return contextlib.chdir(self.cwd) if self.cwd.is_dir() else contextlib.nullcontext()

  @property
  def stop_file(self) -> Path:
    """Returns the stop file: while it exists, workers stop their jobs, on any machine."""
    return self.path / STOP_FILE

  def folder(self, job: Job) -> JobFolder:
    """Returns the folder of a job, `<sweep>/jobs/<job>`."""
    return JobFolder(self.path / "jobs" / job.name)

  def states(self) -> dict[str, JobState]:
    """Returns the state of every job, by name."""
    return {job.name: self.folder(job).state() for job in self.jobs}

  def add(self, job: Job) -> None:
    """Adds a job that a search has drawn."""
    self.jobs.append(job)
    self.save()

  def check_links(self) -> None:
    """Raises CheckpointError if a link leads out of the sweep's folder; a run looks at its own links."""
    check_links(self.path, depth=3)  # <sweep>/jobs/<job>/<file>

  @contextlib.contextmanager
  def controlled(self) -> Iterator[None]:
    """Locks the sweep while the block runs.

    Raises:
      CheckpointError: another process holds the lock, or as `check_links`.
    """
    self.check_links()
    with locking(self.path / "sweep.lock") as lock:
      if lock is None:
        raise CheckpointError(
          f"{self.path} is being run by {lock_holder(self.path / 'sweep.lock')}: `playground sweep status {self.path}` "
          "shows how it stands, sweep_dir=<path> starts the same jobs again."
        )
      yield

  def save(self) -> None:
    """Writes sweep.yaml."""
    content = dataclasses.asdict(self) | {"cwd": str(self.cwd)}
    del content["path"]
    write_text(self.path / "sweep.yaml", dump_yaml(content))


def _check(content: Plain) -> None:
  """Raises TypeError or ValueError if a sweep.yaml does not have the form that `create` writes."""
  texts = lambda key, value: _need(key, value, list) and [_need(key, text, str) for text in value]
  _need("it", content, dict)
  for key, kind in {"name": str, "cwd": str, "jobs": list}.items():
    _need(key, content.get(key), kind)
  for key in ("command", "settings", "lines"):
    texts(key, content.get(key))
  for entry in content["jobs"]:
    job = Job(**_need("a job", entry, dict))
    if not _JOB_NAME.fullmatch(_need("a job's name", job.name, str)):  # a path would lead out of the sweep's folder
      raise ValueError(f"{job.name!r} is not the name of a job")
    texts("overrides", job.overrides)
    _need("varies", job.varies, dict)
    _need("needs", job.needs, int | None)
    _need("steps", job.steps, int | None)
    _need("task", job.task, str)


def _need(what: str, value: Plain, kind: type | types.UnionType) -> Plain:
  if not isinstance(value, kind):
    raise TypeError(f"{what} is {format_value(value)}")
  return value
