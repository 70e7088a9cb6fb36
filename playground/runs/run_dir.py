"""Reads and writes the folder of one run: its configuration, machine, status and result."""

import contextlib
import datetime
import os
import socket
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import NoneType
from typing import Literal, get_args

import yaml

from playground.errors import CheckpointError, PlaygroundError, nearest
from playground.files import (
  check_links,
  lock_holder,
  locking,
  make_numbered,
  read_json,
  read_yaml,
  write_json,
  write_text,
)
from playground.runs.interrupts import Interrupted
from playground.runs.provenance import git_state, package_versions
from playground.settings import Plain, Section, plain
from playground.text import dump_yaml

RETURNS = ("final_return", "final_sampled_return", "final_mode_return", "best_return")
_NUMBERS_OF_SUMMARY = (*RETURNS, "best_step", "steps", "steps_per_second", "wall_clock_s")
RunStatus = Literal["running", "finished", "failed", "preempted"]


class RunDirectory:
  """Holds the paths and records of one run; `claimed` makes a new run, `open` finds an existing one."""

  def __init__(self, path: str | Path):
    self.path = Path(os.path.expanduser(path))
    self.config_path = self.path / "config.yaml"
    self.overrides_path = self.path / "overrides.yaml"
    self.metrics_csv = self.path / "metrics.csv"
    self.checkpoints = self.path / "checkpoints"
    self.videos = self.path / "videos"
    self.plots = self.path / "plots"
    self.nan_dump = self.path / "nan_dump"
    self._locked = False

  @classmethod
  @contextlib.contextmanager
  def claimed(cls, path: str | Path, numbered: bool = False) -> Iterator["RunDirectory"]:
    """Makes the folder and locks it for the block, in which `write_config` makes it a run.

    Args:
      path: the folder.
      numbered: whether to take a new folder `<path>_2`, `_3`, ... if the name is taken: for generated names, which
        several processes may choose in the same second.

    Raises:
      CheckpointError: the folder already holds a run (unless numbered), making it failed, or another process makes a
        run of it in this moment.
    """
    run = cls(path)
    if not numbered:
      run.must_be_new()
    with _writing(run.path):
      if numbered:
        run = cls(make_numbered(run.path))
      run.path.mkdir(parents=True, exist_ok=True)
    with run.locked():
      run.must_be_new()  # still, now that nobody else can make one
      yield run

  def write_config(self, config: Section, overrides: Sequence[str] = ()) -> None:
    """Writes the resolved `config` and the command line's `overrides`; raises CheckpointError if that fails."""
    with _writing(self.path):
      self.path.mkdir(parents=True, exist_ok=True)
      write_text(self.overrides_path, dump_yaml(list(overrides)))
      # Last, because this file makes the folder a run: an interrupted creation can be repeated.
      write_text(self.config_path, dump_yaml(plain(config)))

  def note_budget(self, num_timesteps: int, num_evals: int) -> None:
    """Changes the run's budget, and evaluations, in its configuration and overrides."""
    budget = {"num_timesteps": num_timesteps, "num_evals": num_evals}
    config, keys = self.config, [f"agent.{key}" for key in budget]
    overrides = [text for text in self.overrides if text.partition("=")[0] not in keys]
    overrides += [f"{key}={value}" for key, value in zip(keys, budget.values(), strict=True)]
    self.write_config({**config, "agent": {**config["agent"], **budget}}, overrides)

  @classmethod
  def open(cls, path: str | Path) -> "RunDirectory":
    """Returns the run at `path`.

    Raises:
      CheckpointError: there is no such folder, or it is not a readable run.
    """
    run = cls(path)
    if not run.path.is_dir():
      hint = nearest(run.path.name, (p.name for p in run.path.parent.glob("*/")))
      raise CheckpointError(f"No run directory at {run.path}: there is no such folder.{hint}")
    if not run.config_path.is_file():
      raise CheckpointError(f"{run.path} is not a run directory: it has no config.yaml.")
    try:
      valid = isinstance(run.config, dict)
    except (yaml.YAMLError, ValueError, RecursionError):
      valid = False
    if not valid:
      raise CheckpointError(f"{run.path} is not a readable run directory: its config.yaml is damaged.")
    return run

  def must_be_new(self) -> None:
    """Raises CheckpointError if the folder holds a run already."""
    if self.config_path.exists() or self.checkpoints.exists():
      raise CheckpointError(
        f"run_dir={self.path} already holds a run: give resume={self.path} to continue it, or another run_dir= "
        f"(with init_from={self.path} to start a new run from its weights)."
      )

  @property
  def config(self) -> dict[str, Plain]:
    """The resolved config that the run was started with."""
    return read_yaml(self.config_path)

  @property
  def overrides(self) -> list[str]:
    """The command line's overrides that the run was started with; none without the file.

    Raises:
      CheckpointError: the file is unreadable, or is no list of texts.
    """
    if not self.overrides_path.is_file():
      return []
    try:
      found = read_yaml(self.overrides_path)
    except OSError as error:
      raise CheckpointError(f"{self.overrides_path} cannot be read: {error.strerror}.") from error
    except (yaml.YAMLError, ValueError, RecursionError):
      found = None
    if not isinstance(found, list) or not all(isinstance(text, str) for text in found):
      why = "it is no list of overrides"
      raise CheckpointError(f"{self.overrides_path} is damaged ({why}): move it away to go on without it.")
    return found

  @property
  def manifest(self) -> dict[str, Plain]:
    """The content of manifest.json, see `write_manifest`; empty without one."""
    kinds = {"earlier_starts": list, "git": (dict, NoneType), "timings": dict, "versions": dict, "num_devices": int}
    return read_json(self.path / "manifest.json", **kinds)

  @property
  def status(self) -> dict[str, Plain]:
    """The content of status.json, see `set_status`; empty without one."""
    return read_json(self.path / "status.json", status=str, reason=str, started=str, updated=str)

  @property
  def summary(self) -> dict[str, Plain]:
    """The run's result from summary.json; empty without one."""
    numbers = dict.fromkeys(_NUMBERS_OF_SUMMARY, (int, float, NoneType))
    return read_json(self.path / "summary.json", status=str, **numbers)

  def write_manifest(self, **fields: object) -> None:
    """Records this process: git state, package versions, host, and `fields` (device, precision, seed, timings, …).

    A resumed run may use another machine or commit, so `earlier_starts` keeps the manifests of earlier starts, oldest
    first.
    """
    earlier = self.manifest
    starts = [*earlier.pop("earlier_starts", []), *([earlier] if earlier else [])]
    process = {"created": now(), "host": socket.gethostname(), "git": git_state(), "versions": package_versions()}
    write_json(self.path / "manifest.json", _merged(process, fields) | {"earlier_starts": starts})

  def update_manifest(self, **fields: object) -> None:
    """Merges `fields` into the manifest; nested mappings (`timings={"compile_s": 9.1}`) are merged key by key."""
    write_json(self.path / "manifest.json", _merged(self.manifest, fields))

  def set_status(self, status: RunStatus, reason: str = "") -> None:
    """Records the run's status, its first start, and the process."""
    if status not in get_args(RunStatus):
      raise ValueError(f"status must be one of {get_args(RunStatus)}, not {status!r}")
    started = self.status.get("started", now())
    content = {"status": status, "reason": reason, "pid": os.getpid(), "started": started, "updated": now()}
    write_json(self.path / "status.json", content)

  def note_loss(self, reason: str) -> None:
    """Records that a run failed because one of its processes, possibly the main one, was lost."""
    if self.status.get("status") == "running":  # this machine may not have the folder
      self.set_status("failed", f"{reason} resume={self.path} continues")

  @contextlib.contextmanager
  def locked(self) -> Iterator[None]:
    """Locks the run: only this process writes it while the block runs.

    Raises:
      CheckpointError: another process writes the run, or a link in it leads out of it.
    """
    if self._locked:  # by a block around this one
      yield
      return
    check_links(self.path, depth=2)  # as deep as a run writes: below are checkpoints, or stages, which are runs
    file = self.path / "run.lock"
    with contextlib.ExitStack() as stack:
      with _writing(self.path):
        lock = stack.enter_context(locking(file))
      if lock is None:
        raise CheckpointError(
          f"{self.path} is being written by {lock_holder(file)}: a run has one writer, wait for that one or stop it."
        )
      self._locked = True
      stack.callback(setattr, self, "_locked", False)
      yield

  @contextlib.contextmanager
  def recorded(self) -> Iterator[None]:
    """Locks the run, and records in `status.json` how the block ends.

    A block that completes must have written the summary.
    """
    with self.locked():
      try:
        self.set_status("running")
        yield
        if self.summary.get("status") == "finished":
          self.set_status("finished")
        else:
          self.set_status("preempted", f"interrupted and saved; resume={self.path} continues")
      except Interrupted as interrupt:
        self._note_end("preempted", f"{interrupt}, without a last checkpoint; resume={self.path} continues")
        raise
      except PlaygroundError as error:
        self._note_end("failed", str(error))
        raise
      except OSError as error:  # a full disk or a removed folder: a traceback would not help
        reason = error.strerror or str(error)
        where = f" ({error.filename})" if error.filename else ""
        sentence = f"{self.path} cannot be written: {reason}{where}. resume={self.path} goes on from what is saved."
        self._note_end("failed", sentence)
        raise CheckpointError(sentence) from error
      except BaseException as error:
        self._note_end("failed", f"{type(error).__name__}: {error}")
        raise

  def _note_end(self, status: RunStatus, reason: str) -> None:
    """Records how the run ended; a failed write does not hide the error that ended the run."""
    with contextlib.suppress(OSError, CheckpointError):
      self.set_status(status, reason)

  def write_summary(self, summary: Mapping[str, object]) -> None:
    """Writes the run's result, which sweeps and tables read."""
    write_json(self.path / "summary.json", summary)


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[None]:
  """Turns an error of the operating system into a CheckpointError."""
  try:
    yield
  except OSError as error:
    raise CheckpointError(f"run_dir={path} cannot be written: {error.strerror}.") from error


def now() -> str:
  """Returns the time (ISO 8601)."""
  return datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")


def _merged(base: Section, new: Section) -> dict[str, Plain]:
  shared = [k for k in new if isinstance(new[k], Mapping) and isinstance(base.get(k), Mapping)]
  return {**base, **new, **{k: _merged(base[k], new[k]) for k in shared}}
