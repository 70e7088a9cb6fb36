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

  def __init__(self, sweep: SweepDirectory, config: Section, command: Sequence[str] = COMMAND):
    """Args:
      sweep: what it is to launch.
      config: its settings.
      command: what jobs are run with.

    Raises:
      PlaygroundError: as `check`.
    """
    ...

  @staticmethod
  def check(config: Section, jobs: Sequence[Job]) -> None:
    """Raises PlaygroundError for what it needs and is not there, settings that cannot be, a job that could never start.

    It is asked before a sweep is laid out, too, and writes nothing.
    """
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


def launcher_class(name: str) -> type[Launcher]:
  """The launcher of that name (`launcher.name`).

  Raises:
    ConfigError: what it is made of is not installed.
  """
  if name == "slurm":
    from playground.sweep.slurm import SlurmLauncher

    return SlurmLauncher
  if name == "ray":
    from playground.sweep.ray import RayLauncher

    return RayLauncher
  from playground.sweep.local import LocalLauncher

  return LocalLauncher
