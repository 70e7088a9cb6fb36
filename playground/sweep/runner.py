"""The loop of a sweep: hands jobs to a launcher, waits for them, and writes the result.

All it knows it reads from the sweep's folder. Killed and started again it goes on with what is missing, jobs that are
still at work included.
"""

import contextlib
import time
from collections import deque
from collections.abc import Sequence
from types import FrameType
from typing import TYPE_CHECKING

from rich.console import Console

from playground.config import Section, check_saved_job
from playground.runs.interrupts import on_signals
from playground.sweep.folder import ENDED, FAILED, Job, JobState, SweepDirectory
from playground.sweep.launchers import Launcher, launcher_class
from playground.sweep.results import write_result
from playground.sweep.view import View
from playground.sweep.worker import COMMAND

if TYPE_CHECKING:
  from playground.sweep.search import Search

POLL_S = 0.3
MAX_CODE = 100  # exit codes above are signals'


def run_sweep(
  sweep: SweepDirectory, settings: Section, command: Sequence[str] = COMMAND, console: Console | None = None
) -> int:
  """Does what is missing of a sweep, and writes its result.

  Args:
    sweep: on disk.
    settings: how it is run (`configs/sweep.yaml`).
    command: what jobs are run with.
    console: for what is shown.

  Returns:
    How many jobs failed, 100 at most, or 130 or 143 when interrupted.

  Raises:
    PlaygroundError: it cannot be run like this, or another process runs it.
  """
  for job in sweep.jobs:
    check_saved_job(job.name, job.overrides)
  with sweep.controlled():
    view, search = View(sweep, console), None
    if settings.search.name != "grid":
      from playground.sweep.search import Search

      search = Search(sweep, settings.search, view.print)
    make_launcher = launcher_class(settings.launcher.name)
    with contextlib.closing(make_launcher(sweep, settings.launcher, command)) as launcher:
      runner = Runner(sweep, launcher, view, settings, search)
      code = runner.run()
    if runner.waited:
      write_result(sweep, view.print)
    if search:
      view.print(search.best())
    return code


class Runner:
  """See `run_sweep`."""

  def __init__(
    self, sweep: SweepDirectory, launcher: Launcher, view: View, settings: Section, search: "Search | None" = None
  ):
    self._sweep = sweep
    self._launcher = launcher
    self._view = view
    self._stop_on_error = settings.on_error == "stop"
    self._search = search
    self._signum: int | None = None
    self._kill = False
    self._stopping = False
    self.waited = settings.launcher.get("wait", True)

  def run(self) -> int:
    """The whole of it; see `run_sweep`."""
    sweep, launcher = self._sweep, self._launcher
    sweep.stop_file.unlink(missing_ok=True)
    self._states = sweep.states()
    self._open = [job for job in sweep.jobs if self._at_work(job)]
    left = [job for job in sweep.jobs if job not in self._open and self._states[job.name].status != "finished"]
    self._queue = deque(left)
    self._states |= {job.name: JobState() for job in left}
    self._view.know(self._states)
    finished = sum(state.status == "finished" for state in self._states.values())
    already = f", {finished} finished already" if finished else ""
    already += f", {len(self._open)} at work" if self._open else ""
    what = f"Search of {self._search.trials} trials" if self._search else f"Sweep of {len(sweep.jobs)} jobs"
    self._view.print(f"{what} in {sweep.path}{already}")
    with on_signals(self._interrupt), self._view as view:
      while self._queue or self._open or self._may_search():
        self._start_some()
        if not self.waited or (self._signum is not None and launcher.outlives):
          break
        self._look()
        view.update(self._states)
        if self._queue or self._open:
          time.sleep(POLL_S)
      view.update(self._states, now=True)
    if self._signum is not None:
      self._view.print(self._last_words())
      return 128 + self._signum
    if not self.waited:
      self._view.print(f"Submitted; `playground sweep status|collect {sweep.path}` shows what becomes of it.")
      return 0
    return min(self._failed(), MAX_CODE)

  def _start_some(self) -> None:
    """Starts what there is room for."""
    while self._queue and not self._stopping and self._launcher.start(self._queue[0]):
      self._open.append(self._queue.popleft())
    while self._may_search() and not self._queue and (job := self._search.ask(len(self._open))):  # pyright: ignore
      self._states[job.name] = JobState()
      if not self._launcher.start(job):
        self._queue.append(job)
      else:
        self._open.append(job)

  def _look(self) -> None:
    """Reads how the open jobs stand, and acts on those that ended and on signals."""
    for job in list(self._open):
      busy = self._launcher.busy(job)  # before its state is read, since the last thing a worker does is to write it
      state = self._sweep.folder(job).state()
      if not busy and state.status not in ENDED and not self._sweep.folder(job).locked():
        state = JobState("killed", "it never came to start", state.attempt)
        self._sweep.folder(job).write(status=state.status, reason=state.reason, attempt=state.attempt)
      self._states[job.name] = state
      if not busy and state.status in ENDED:
        self._open.remove(job)
        if self._search:
          self._search.tell(job, self._sweep.folder(job))
    if self._stop_on_error and not self._stopping and any(s.status in FAILED for s in self._ended_now()):
      self._view.print("on_error=stop: a job failed, the others are asked to stop.")
      self._stop()
    if self._signum is not None and not self._stopping:
      self._view.print("Interrupted: jobs are asked to stop, which saves them (once more kills them).")
      self._stop()
    if self._kill:
      self._launcher.kill()

  def _stop(self) -> None:
    self._stopping = True
    self._queue.clear()
    self._sweep.stop_file.touch()

  def _at_work(self, job: Job) -> bool:
    return self._states[job.name].status != "finished" and (
      self._launcher.busy(job) or self._sweep.folder(job).locked()
    )

  def _ended_now(self) -> list[JobState]:
    """Jobs of this start that have ended: neither open nor queued any more."""
    waiting = {job.name for job in (*self._open, *self._queue)}
    return [state for name, state in self._states.items() if name not in waiting]

  def _may_search(self) -> bool:
    return self._search is not None and not self._stopping and not self._search.done

  def _failed(self) -> int:
    """How many jobs failed; if none did, how many did not finish."""
    states = self._states.values()
    return sum(s.status in FAILED for s in states) or sum(s.status != "finished" for s in states)

  def _last_words(self) -> str:
    again = f"the same command, or `playground sweep retry {self._sweep.path}`, goes on"
    return f"Its jobs go on by themselves; {again}." if self._launcher.outlives else f"Interrupted: {again}."

  def _interrupt(self, signum: int, frame: FrameType | None) -> None:
    """SIGINT and SIGTERM ask for an end, a second one asks again."""
    self._kill = self._signum is not None
    self._signum = signum
