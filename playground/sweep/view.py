"""Shows a running sweep: a live table on a terminal, a line for each change in a log."""

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Self

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from playground.sweep.folder import ENDED, FAILED, Job, JobState, SweepDirectory

ROWS = 30  # rows of the table, running and failed jobs first
_COLORS = {"finished": "green", "running": "cyan", "failed": "red", "timeout": "red", "killed": "red"}


class View:
  """Shows the states of jobs. On a terminal it redraws a table at most twice a second."""

  def __init__(self, sweep: SweepDirectory, console: Console | None = None):
    self._sweep = sweep
    self._console = console or Console()
    self._live = Live(console=self._console, auto_refresh=False) if self._console.is_terminal else None
    self._seen: dict[str, tuple[str, int]] = {}
    self._drawn_at = 0.0
    self.again = f"the same command, or `playground sweep retry {sweep.path}`, continues the sweep"  # after a stop

  def __enter__(self) -> Self:
    if self._live:
      self._live.start()
    return self

  def __exit__(self, *exc: object) -> None:
    if self._live:
      self._live.stop()

  def print(self, text: str) -> None:
    """Prints a line above the table."""
    self._console.print(text, markup=False, highlight=False, soft_wrap=True)

  def begin(self, states: Mapping[str, JobState], at_work: int, trials: int | None = None) -> None:
    """Prints the size and path of the sweep; `update` prints only jobs whose states change later."""
    self._seen = {name: (state.status, state.attempt) for name, state in states.items()}
    finished = sum(state.status == "finished" for state in states.values())
    already = f", {finished} finished already" if finished else ""
    already += f", {at_work} at work" if at_work else ""
    what = f"Search of {trials} trials" if trials else f"Sweep of {len(self._sweep.jobs)} jobs"
    self.print(f"{what} in {self._sweep.path}{already}")

  def update(self, states: Mapping[str, JobState], now: bool = False) -> None:
    """Shows changes.

    Args:
      states: the state of every job, by name.
      now: whether to redraw the table at once.
    """
    if not self._live:
      self._lines(states)
    elif now or time.monotonic() - self._drawn_at > 0.5:
      self._drawn_at = time.monotonic()
      self._live.update(status_table(self._sweep, states), refresh=True)

  def _lines(self, states: Mapping[str, JobState]) -> None:
    for job in self._sweep.jobs:
      state = states[job.name]
      if (state.status, state.attempt) == self._seen.get(job.name) or state.status in ("queued", "submitted"):
        continue
      self._seen[job.name] = state.status, state.attempt
      ended = sum(s.status in ENDED for s in states.values())
      _, score = self._sweep.folder(job).progress()
      details = [f"on {state.where}" if state.status == "running" and state.where else ""]
      details += [f"return {score:.1f}" if state.status == "finished" and score is not None else ""]
      details += [_clock(state.seconds) if state.status in ENDED else "", state.reason]
      text = ", ".join(fact for fact in details if fact)
      self.print(f"[{ended}/{len(states)}] {job.name} {state.status}{f': {text}' if text else ''}")


def status_table(sweep: SweepDirectory, states: Mapping[str, JobState], rows: int | None = ROWS) -> Table:
  """Builds a table of jobs.

  Args:
    sweep: of the jobs.
    states: the states of its jobs, by name.
    rows: the largest number of rows; None is all.
  """
  counts = Counter(state.status for state in states.values())
  title = f"{sweep.path}: {', '.join(f'{n} {status}' for status, n in counts.items())}"
  table = Table(title=Text(title), title_justify="left")
  for name in ("job", "status", "on", "steps", "return", "time", "why"):
    right = name in ("steps", "return", "time")
    wraps = name in ("job", "why")
    table.add_column(name, justify="right" if right else "left", no_wrap=not wraps, overflow="fold")
  shown = _most_telling(sweep.jobs, states, rows)
  for job in shown:
    state = states[job.name]
    step, score = sweep.folder(job).progress() if state.status != "queued" else (None, None)
    done = "" if step is None else f"{min(1, step / job.steps):.0%}" if job.steps else f"{step:,}"
    color = _COLORS.get(state.status, "")
    where = state.where if state.status == "running" else ""
    cells = (where, done, "" if score is None else f"{score:.1f}", _clock(state.seconds), state.reason)
    table.add_row(Text(job.name), Text(state.status, color), *map(Text, cells))
  if len(shown) < len(sweep.jobs):
    table.caption = f"and {len(sweep.jobs) - len(shown)} more"
  return table


def _most_telling(jobs: Sequence[Job], states: Mapping[str, JobState], rows: int | None) -> list[Job]:
  """Returns at most `rows` jobs in the sweep's order: running before failed before others, short before long."""
  if rows is None or len(jobs) <= rows:
    return list(jobs)

  def rank(job: Job) -> tuple[int, float]:
    state = states[job.name]
    order = 0 if state.status in ("running", "submitted") else 1 if state.status in FAILED else 2
    return order, state.seconds or float("inf")

  chosen = {job.name for job in sorted(jobs, key=rank)[:rows]}
  return [job for job in jobs if job.name in chosen]


def _clock(seconds: float | None) -> str:
  if seconds is None:
    return ""
  hours, rest = divmod(max(0, round(seconds)), 3600)
  return f"{hours}:{rest // 60:02}:{rest % 60:02}" if hours else f"{rest // 60}:{rest % 60:02}"
