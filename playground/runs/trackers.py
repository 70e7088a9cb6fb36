"""Logs metrics. A new tracker is a class with `log` and `close`, and a line in `make_trackers`."""

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from playground.runs.csv_tracker import CsvTracker
from playground.runs.run_dir import RunDirectory
from playground.runs.wandb_tracker import WandbTracker
from playground.settings import Section


class Tracker(Protocol):
  """Records metrics. Values are Python floats on the host: a tracker never waits for a device."""

  def log(self, step: int, metrics: dict[str, float]) -> None:
    """Records `metrics` after `step` environment steps."""
    ...

  def close(self, status: str) -> None:
    """Flushes and ends; `status` is the run's (finished, failed, preempted)."""
    ...


class TensorBoardTracker:
  """Writes scalars for `tensorboard --logdir <run>`; on resume, TensorBoard hides points after `resume_step`.

  The tracker writes synchronously: the thread of tensorboardX's `SummaryWriter` ends at the first error (a full disk),
  and the run would wait for the thread forever.
  """

  def __init__(self, folder: Path, resume_step: int | None = None):
    from tensorboardX.event_file_writer import EventsWriter
    from tensorboardX.proto.event_pb2 import Event, SessionLog
    from tensorboardX.proto.summary_pb2 import Summary

    self._event, self._summary = Event, Summary
    folder.mkdir(parents=True, exist_ok=True)
    self._writer = EventsWriter(str(folder.absolute() / "events"))  # it takes `s3:/...` for a network address
    self._flushed = time.monotonic()
    if resume_step is not None:
      session = SessionLog(status=SessionLog.START)  # pyright: ignore[reportAttributeAccessIssue]
      self._writer.write_event(Event(step=resume_step + 1, wall_time=time.time(), session_log=session))

  def log(self, step: int, metrics: dict[str, float]) -> None:
    finite = {name: value for name, value in metrics.items() if math.isfinite(value)}  # the CSV keeps the others
    summary = self._summary(value=[self._summary.Value(tag=name, simple_value=finite[name]) for name in finite])
    self._writer.write_event(self._event(step=step, wall_time=time.time(), summary=summary))
    if time.monotonic() - self._flushed > 10:
      self._writer.flush()
      self._flushed = time.monotonic()

  def close(self, status: str) -> None:
    self._writer.close()


class TrackerGroup:
  """Logs to several trackers."""

  def __init__(self, csv: CsvTracker, others: Sequence[Tracker] = ()):
    self._csv = csv
    self.trackers: tuple[Tracker, ...] = (csv, *others)

  @property
  def columns(self) -> list[str]:
    """Names of the columns of metrics.csv so far."""
    return self._csv.columns

  def log(self, step: int, metrics: dict[str, float]) -> None:
    for tracker in self.trackers:
      tracker.log(step, metrics)

  def close(self, status: str) -> None:
    for tracker in self.trackers:
      tracker.close(status)


def make_trackers(
  config: Section,
  run_dir: RunDirectory,
  resume_step: int | None = None,
  notify: Callable[[str], None] = print,
  columns: Sequence[str] = (),
) -> TrackerGroup:
  """Builds the trackers of `config["tracking"]`; metrics.csv is always written.

  Args:
    config: the whole resolved config, which W&B stores.
    run_dir: folder of the files.
    resume_step: environment steps of the checkpoint that the run continues from; later records are dropped, since
      the run will log them again. Metrics of step S must be logged before checkpoint S is saved.
    notify: takes one sentence when a tracker drops out, or a file is damaged.
    columns: of metrics.csv at that checkpoint, if known.
  """
  tracking = config["tracking"]
  csv = CsvTracker(run_dir.metrics_csv, columns, notify)
  if resume_step is not None and csv.truncate_after(resume_step) < resume_step:
    file = run_dir.metrics_csv
    notify(f"{file} has no row of step {resume_step:,}, where the run goes on: rows before it are lost.")
  trackers: list[Tracker] = []
  if tracking["tensorboard"]:
    trackers.append(TensorBoardTracker(run_dir.path / "tensorboard", resume_step))
  if tracking["wandb"]["enable"]:
    trackers.append(WandbTracker(tracking["wandb"], run_dir.path, config, notify))
  return TrackerGroup(csv, trackers)
