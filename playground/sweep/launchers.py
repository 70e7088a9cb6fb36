"""What a launcher is, and which there are."""

from collections.abc import Sequence
from typing import Protocol

from playground.config import Section
from playground.sweep.folder import Job, SweepDirectory
from playground.sweep.worker import COMMAND


class Launcher(Protocol):
  """Starts workers somewhere. What becomes of a job is in its folder; a launcher only knows whether it may yet change.

  Attributes:
    outlives: whether jobs go on when the process that started them ends.
  """

  outlives: bool

  def check(self, jobs: Sequence[Job]) -> None:
    """Raises PlaygroundError for a job that could never start here, before anything does."""
    ...

  def start(self, job: Job) -> bool:
    """Starts a job, or returns False because there is no room for it now."""
    ...

  def busy(self, job: Job) -> bool:
    """Whether the job may still start or is at work, as far as this launcher can see."""
    ...

  def kill(self) -> None:
    """Ends all jobs at once, saved or not."""
    ...

  def close(self) -> None:
    """Frees what the launcher holds; no job of its own is busy any more, unless they outlive it."""
    ...


def make_launcher(sweep: SweepDirectory, config: Section, command: Sequence[str] = COMMAND) -> Launcher:
  """The launcher that `config` (the section `launcher`) names.

  Args:
    sweep: what it is to launch.
    config: its settings.
    command: what jobs are run with.

  Raises:
    PlaygroundError: what it needs is not installed or not there.
  """
  if config.name == "slurm":
    from playground.sweep.slurm import SlurmLauncher

    return SlurmLauncher(sweep, config, command)
  if config.name == "ray":
    from playground.sweep.ray import RayLauncher

    return RayLauncher(sweep, config, command)
  from playground.sweep.local import LocalLauncher

  return LocalLauncher(sweep, config, command)
