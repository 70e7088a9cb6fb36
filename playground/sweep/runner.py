"""Runs jobs: starts them through a launcher, waits for them, and shows their states.

Sweeps and benchmarks (`benchmark/jobs.py`) use this runner. All states are in the jobs' folders, so a restarted runner
starts the missing jobs and waits for running ones.
"""

import contextlib
import importlib
import time
from collections import deque
from collections.abc import Sequence
from types import FrameType
from typing import TYPE_CHECKING, Protocol, TypeVar

from rich.console import Console

from playground.config import check_saved_job
from playground.config.sweep_options import LAUNCHERS, LauncherConfig, OptunaConfig, SlurmConfig, SweepSettings
from playground.runs.interrupts import on_signals
from playground.sweep.folder import ENDED, FAILED, Job, JobState, SweepDirectory
from playground.sweep.report import write_result
from playground.sweep.view import View
from playground.sweep.worker import COMMAND

if TYPE_CHECKING:
  from playground.sweep.search import Search

ConfigT = TypeVar("ConfigT", bound=LauncherConfig, contravariant=True)

POLL_S = 0.3
MAX_CODE = 100  # exit codes above are signals'


class Launcher(Protocol):
  """Starts workers. A job's result is in the job's folder; the launcher only knows whether the job may still run.

  Attributes:
    outlives: whether jobs continue when the process that started them ends.
  """

  outlives: bool

  def start(self, job: Job) -> bool:
    """Starts a job and returns True; returns False if no slot is free now."""
    ...

  def busy(self, job: Job) -> bool:
    """Returns whether the job is queued or running, as far as this launcher knows."""
    ...

  def kill(self) -> None:
    """Kills all jobs at once; they may lose unsaved steps."""

  def close(self) -> None:
    """Waits for the jobs that do not outlive this process, and frees resources."""


class LauncherClass(Protocol[ConfigT]):
  """The constructor of a launcher."""

  def __call__(self, sweep: SweepDirectory, config: ConfigT, command: Sequence[str] = COMMAND) -> Launcher:
    """Takes a sweep, settings, and the command that runs a job's overrides; raises the errors of `check`."""
    ...

  def check(self, config: ConfigT, jobs: Sequence[Job]) -> None:
    """Raises PlaygroundError for missing software, invalid settings and jobs that can never start; writes nothing."""


def launcher_class(config: ConfigT) -> LauncherClass[ConfigT]:
  """Returns the launcher class of the settings; raises ConfigError if its package is not installed."""
  name = next(name for name, settings in LAUNCHERS.items() if settings is type(config))
  return getattr(importlib.import_module(f"playground.sweep.{name}"), f"{name.title()}Launcher")


def run_sweep(
  sweep: SweepDirectory, settings: SweepSettings, command: Sequence[str] = COMMAND, console: Console | None = None
) -> int:
  """Runs the unfinished jobs of a sweep and writes its result.

  Args:
    sweep: the sweep on disk.
    settings: of the sweep (`configs/sweep.yaml`).
    command: program that gets the jobs' overrides.
    console: for the output.

  Returns:
    The number of failed jobs, 100 at most, or 128 plus the signal's number when interrupted.

  Raises:
    PlaygroundError: the settings are invalid here, or another process runs the sweep.
  """
  for job in sweep.jobs:
    check_saved_job(job.name, job.overrides)
  if isinstance(settings.search, OptunaConfig):
    check_saved_job("of the search", sweep.lines)
  with sweep.controlled():
    view, search = View(sweep, console), None
    if isinstance(settings.search, OptunaConfig):
      from playground.sweep.search import Search

      search = Search(sweep, settings.search, view.print)
    wait = not isinstance(settings.launcher, SlurmConfig) or settings.launcher.wait
    with contextlib.closing(launcher_class(settings.launcher)(sweep, settings.launcher, command)) as launcher:
      sweep.save()  # the command may have changed its settings
      code = Runner(sweep, launcher, view, search, settings.on_error == "stop", wait).run()
    if wait:
      write_result(sweep, view.print)
    if search:
      view.print(search.best())
    return code


class Runner:
  """Runs the unfinished jobs of a sweep."""

  def __init__(
    self, sweep: SweepDirectory, launcher: Launcher, view: View, search: "Search | None" = None,
    stop_on_error: bool = False, wait: bool = True, seconds: float | None = None,
  ):  # fmt: skip
    """Args:
    sweep: the jobs, on disk.
    launcher: starts them.
    view: shows them.
    search: adds jobs while others run.
    stop_on_error: one failed job stops the others.
    wait: whether to wait for the jobs after starting them.
    seconds: time after which jobs are asked to stop; None is never.
    """
    self._sweep = sweep
    self._launcher = launcher
    self._view = view
    self._search = search
    self._stop_on_error = stop_on_error
    self._wait = wait
    self._deadline = None if seconds is None else time.monotonic() + seconds
    self._signum: int | None = None
    self._kill = False
    self._stopping = False

  def run(self) -> int:
    """Runs the jobs and returns the exit code; see `run_sweep`."""
    sweep, launcher, view = self._sweep, self._launcher, self._view
    sweep.stop_file.unlink(missing_ok=True)
    self._states = sweep.states()
    self._open = [job for job in sweep.jobs if self._at_work(job)]
    left = [job for job in sweep.jobs if job not in self._open and self._states[job.name].status != "finished"]
    self._queue = deque(left)
    self._states |= {job.name: JobState() for job in left}
    view.begin(self._states, len(self._open), self._search and self._search.trials)
    with on_signals(self._interrupt), view:
      try:
        while (self._queue or self._open or self._may_search()) and not (self._signum and launcher.outlives):
          self._react()
          self._start_some()
          if not self._wait:
            break
          self._look()
          view.update(self._states)
          if self._queue or self._open:
            time.sleep(POLL_S)
        view.update(self._states, now=True)
      except BaseException:
        if not launcher.outlives:  # `close` waits for the jobs
          sweep.stop_file.touch()
        raise
    if self._signum is not None:
      view.print(f"{'Its jobs keep running; ' if launcher.outlives else 'Interrupted: '}{view.again}.")
      return 128 + self._signum
    if not self._wait:
      view.print(f"Submitted; `playground sweep status|collect {sweep.path}` shows what becomes of it.")
      return 0
    return min(self._failed(), MAX_CODE)

  def _react(self) -> None:
    """Stops jobs after a failure, a signal, `playground sweep stop`, or when the time is up."""
    if self._stopping:
      pass
    elif self._stop_on_error and any(s.status in FAILED for s in self._ended_now()):
      self._stop("on_error=stop: a job failed, the others are asked to stop.")
    elif self._signum is not None:
      self._stop("Interrupted: jobs are asked to stop, which saves them (once more kills them).")
    elif self._sweep.stop_file.exists():
      self._stop("Stopped by `playground sweep stop`: jobs are asked to save and end.")
    elif self._deadline is not None and time.monotonic() >= self._deadline:
      self._stop()
    if self._kill:
      self._launcher.kill()

  def _start_some(self) -> None:
    """Starts as many jobs as there are free slots."""
    while self._queue and not self._stopping and self._launcher.start(self._queue[0]):
      self._open.append(self._queue.popleft())
    while self._search and self._may_search() and not self._queue and (job := self._search.ask(len(self._open))):
      self._states[job.name] = JobState()
      (self._open if self._launcher.start(job) else self._queue).append(job)

  def _look(self) -> None:
    """Reads the states of the open jobs."""
    for job in list(self._open):
      folder = self._sweep.folder(job)
      busy = self._launcher.busy(job)  # before the state is read: a worker writes it last
      state = folder.state()
      if not busy and state.status not in ENDED and not folder.locked():
        never = ("preempted", "stopped before it began") if self._stopping else ("killed", "it never came to start")
        state = JobState(*never, state.attempt)
        folder.write(status=state.status, reason=state.reason, attempt=state.attempt)
      self._states[job.name] = state
      if not busy and state.status in ENDED:
        self._open.remove(job)
        if self._search:
          self._search.tell(job, folder)

  def _stop(self, text: str = "") -> None:
    if text:
      self._view.print(text)
    self._stopping = True
    self._queue.clear()
    self._sweep.stop_file.touch()

  def _at_work(self, job: Job) -> bool:
    unfinished = self._states[job.name].status != "finished"
    return unfinished and (self._launcher.busy(job) or self._sweep.folder(job).locked())

  def _ended_now(self) -> list[JobState]:
    """Returns the jobs of this start that have ended: neither open nor queued."""
    waiting = {job.name for job in (*self._open, *self._queue)}
    return [state for name, state in self._states.items() if name not in waiting]

  def _may_search(self) -> bool:
    return self._search is not None and not self._stopping and not self._search.done

  def _failed(self) -> int:
    """Returns the number of failed jobs; if none failed, of unfinished ones."""
    states = self._states.values()
    return sum(s.status in FAILED for s in states) or sum(s.status != "finished" for s in states)

  def _interrupt(self, signum: int, frame: FrameType | None) -> None:
    """Handles SIGINT and SIGTERM: asks jobs to stop; a second signal asks again."""
    self._kill = self._signum is not None
    self._signum = signum
