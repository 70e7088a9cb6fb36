"""A launcher that trains jobs in one process and one compiled program where they differ only in numbers."""

import math
from collections.abc import Sequence

from playground.config import compose
from playground.config.sweep_options import TogetherConfig
from playground.runs.programs import program_of
from playground.sweep.folder import Job, SweepDirectory
from playground.sweep.local import LocalLauncher, Slot
from playground.sweep.worker import COMMAND
from playground.text import quoted


class TogetherLauncher(LocalLauncher):
  """See `runner.Launcher`. Jobs that can share a program do (`program_of`); the others are processes of their own."""

  def __init__(
    self, sweep: SweepDirectory, config: TogetherConfig, command: Sequence[str] = COMMAND, slots: Sequence[Slot] = ()
  ):
    super().__init__(sweep, config, command, slots)
    self._max_agents = config.max_agents
    self._groups: dict[str, list[Job]] = {}  # by the names of their jobs
    self._group(sweep.jobs)

  def start(self, job: Job) -> bool:
    if job.name in self._workers:  # with the first of its group
      return True
    if job.name not in self._groups:  # a search has added it
      self._group([job])
    return self._start(self._groups[job.name])

  def _group(self, jobs: Sequence[Job]) -> None:
    """Finds jobs that can share a program, among those that are not done."""
    programs: dict[str, list[Job]] = {}
    for job in jobs:
      folder = self._sweep.folder(job)
      if folder.state().status != "finished" and not folder.locked():
        config = compose([f"resume={quoted(folder.path)}"] if folder.begun else job.overrides)
        programs.setdefault(program_of(config) or job.name, []).append(job)
    for same in programs.values():
      size = min(self._max_agents, math.ceil(len(same) / len(self.slots)))  # no slot stays empty
      groups = [same[i : i + size] for i in range(0, len(same), size)]
      self._groups |= {job.name: group for group in groups for job in group}
