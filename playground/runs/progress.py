"""Shows training progress: a bar on a terminal, an occasional plain line in a log file."""

import time
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, SpinnerColumn, TextColumn
from rich.progress import Progress as RichProgress

PLAIN_INTERVAL_S = 5.0


class Progress:
  """Shows the steps done, steps/s, time left and last evaluation return of one training run.

  Args:
    total_steps: the run's whole budget; a resumed run starts its bar where it continues.
    enabled: False shows no progress; `print` still prints.
    console: for the output; standard output by default.
    activity: label of the bar.
    name: prefix of lines, if several runs print.
  """

  def __init__(
    self,
    total_steps: int,
    enabled: bool = True,
    console: Console | None = None,
    activity: str = "training",
    name: str = "",
  ):
    self._name = name
    self._total = total_steps
    self._activity = activity
    self._enabled = enabled
    self._console = console or Console()
    self._live = enabled and self._console.is_terminal
    self._step: int | None = None
    self._step_at = 0.0
    self._steps_per_second: float | None = None
    self._last_return: float | None = None
    self._line_at = -PLAIN_INTERVAL_S
    self._line = ""  # the newest plain line that has not been printed yet
    self._bar = RichProgress(
      SpinnerColumn(),
      TextColumn("{task.description}"),
      BarColumn(bar_width=24),
      TextColumn("{task.fields[text]}"),
      console=self._console,
      refresh_per_second=4,
      disable=not self._live,
    )
    self._task = self._bar.add_task("starting", total=None, text="")

  def __enter__(self) -> Self:
    self._bar.start()
    return self

  def __exit__(self, *exc: object) -> None:
    self._bar.stop()
    if self._line:
      self._print_plain(self._line)

  def silent(self, name: str) -> "Progress":
    """Returns a Progress for another run, which only prints above the same bar."""
    return Progress(self._total, enabled=False, console=self._console, name=name)

  def phase(self, text: str) -> None:
    """Shows the current phase while no steps are made (building, compiling, rendering)."""
    if self._live:
      # At once: compilation may hold the lock that the refreshing thread needs.
      self._bar.update(self._task, description=text, total=None, text="", refresh=True)
    elif self._enabled:
      self._print_plain(text)
    self._step = None  # the clock of steps/s must not count this phase

  def update(self, step: int, steps_per_second: float | None = None, last_return: float | None = None) -> None:
    """Shows that `step` environment steps of the budget are done; missing values are measured or do not change."""
    now = time.monotonic()
    if steps_per_second is not None:
      self._steps_per_second = steps_per_second
    elif self._step is not None and now > self._step_at and step > self._step:
      self._steps_per_second = (step - self._step) / (now - self._step_at)
    self._step, self._step_at = step, now
    self._last_return = self._last_return if last_return is None else last_return
    text = self._text(step)
    if self._live:
      self._bar.update(self._task, description=self._activity, completed=step, total=self._total, text=text)
    elif self._enabled:
      self._line = f"{100 * step / max(self._total, 1):5.1f} %  {text}"
      if step >= self._total or now - self._line_at >= PLAIN_INTERVAL_S:
        self._print_plain(self._line)

  def print(self, text: str) -> None:
    """Prints a line above the bar."""
    text = f"{self._name}: {text}" if self._name else text
    self._console.print(text, markup=False, highlight=False, soft_wrap=True)

  def _text(self, step: int) -> str:
    parts = [f"{_short(step)}/{_short(self._total)} steps"]
    if self._steps_per_second:
      left = max(self._total - step, 0) / self._steps_per_second
      parts += [f"{_short(self._steps_per_second)} steps/s", f"ETA {_clock(left)}"]
    if self._last_return is not None:
      parts.append(f"return {self._last_return:.1f}")
    return "  ".join(parts)

  def _print_plain(self, line: str) -> None:
    self.print(line)
    self._line, self._line_at = "", time.monotonic()


def format_return(value: float | None) -> str:
  """Formats a return with four digits (998.8, 0.4512); None gives `none`."""
  return "none" if value is None else f"{value:.1f}" if abs(value) >= 1000 else f"{value:.4g}"


def _short(number: float) -> str:
  for unit, size in (("G", 1e9), ("M", 1e6), ("k", 1e3)):
    if number >= size:
      return f"{number / size:.2f}{unit}"
  return f"{number:.0f}"


def _clock(seconds: float) -> str:
  hours, rest = divmod(round(seconds), 3600)
  return f"{hours}:{rest // 60:02}:{rest % 60:02}"
