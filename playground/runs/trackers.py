"""Where metrics go. A new tracker is one class with `log` and `close`, and one line in `make_trackers`."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from ml_collections import ConfigDict

from playground.runs.csv_tracker import CsvTracker
from playground.runs.files import plain
from playground.runs.run_dir import RunDirectory
from playground.runs.wandb_tracker import WandbTracker


class Tracker(Protocol):
  """A sink of metrics. Values are Python floats on the host: a tracker never waits for a device."""

  def log(self, step: int, metrics: dict[str, float]) -> None:
    """Records `metrics` after `step` environment steps."""
    ...

  def close(self, status: str) -> None:
    """Flushes and ends; `status` is the run's (finished, failed, preempted)."""
    ...


class TensorBoardTracker:
  """Scalars for `tensorboard --logdir <run>`; on resume, points after `resume_step` are hidden by TensorBoard."""

  def __init__(self, folder: Path, resume_step: int | None = None):
    from tensorboardX import SummaryWriter

    purge = None if resume_step is None else resume_step + 1
    self._writer = SummaryWriter(str(folder), purge_step=purge, flush_secs=10)

  def log(self, step: int, metrics: dict[str, float]) -> None:
    for name, value in metrics.items():
      if math.isfinite(value):  # tensorboardX warns about every NaN; the CSV keeps them
        self._writer.add_scalar(name, value, step)

  def close(self, status: str) -> None:
    self._writer.close()


class TrackerGroup:
  """Several trackers behind one `log`."""

  def __init__(self, trackers: Sequence[Tracker]):
    self.trackers = tuple(trackers)

  def log(self, step: int, metrics: dict[str, float]) -> None:
    for tracker in self.trackers:
      tracker.log(step, metrics)

  def close(self, status: str) -> None:
    for tracker in self.trackers:
      tracker.close(status)


def make_trackers(
  config: Mapping[str, Any] | ConfigDict,
  run_dir: RunDirectory,
  resume_step: int | None = None,
  notify: Callable[[str], None] = print,
) -> TrackerGroup:
  """Builds the trackers that `config["tracking"]` asks for; metrics.csv is always written.

  Args:
    config: the whole resolved config (W&B stores all of it).
    run_dir: where files go.
    resume_step: environment steps of the checkpoint that the run continues from; later records are dropped, since
      they are about to be made again. Log the metrics of step S before saving checkpoint S, and none is ever lost.
    notify: takes one sentence when a tracker drops out.
  """
  resolved: dict[str, Any] = plain(config)
  tracking = resolved["tracking"]
  csv = CsvTracker(run_dir.metrics_csv)
  if resume_step is not None:
    csv.truncate_after(resume_step)
  trackers: list[Tracker] = [csv]
  if tracking["tensorboard"]:
    trackers.append(TensorBoardTracker(run_dir.path / "tensorboard", resume_step))
  if tracking["wandb"]["enable"]:
    trackers.append(WandbTracker(tracking["wandb"], run_dir.path, resolved, notify))
  return TrackerGroup(trackers)
