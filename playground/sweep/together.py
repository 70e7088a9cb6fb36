"""A launcher that trains jobs which differ only in numbers in one process and one compiled program."""

import math
from collections.abc import Sequence

from playground.config import compose
from playground.config.sweep_options import LocalConfig, TogetherConfig
from playground.errors import ConfigError, PlaygroundError
from playground.runs.programs import population_of, program_of
from playground.sweep.folder import Job, SweepDirectory
from playground.sweep.local import LocalLauncher, Slot
from playground.sweep.worker import COMMAND
from playground.text import format_value, quoted


class TogetherLauncher(LocalLauncher):
  """Implements `runner.Launcher`. Jobs with the same program (`program_of`) share a process; others have their own."""

  def __init__(
    self, sweep: SweepDirectory, config: TogetherConfig, command: Sequence[str] = COMMAND, slots: Sequence[Slot] = ()
  ):
    super().__init__(sweep, config, command, slots)
    explore = [f"--explore={key}" for key in config.explore]
    self._population = [f"--exploit-every={config.exploit_every}", *explore] if config.exploit_every else []
    self._max_agents = config.max_agents
    self._groups: dict[str, list[Job]] = {}  # by the names of their jobs
    self._group(sweep.jobs)

  @staticmethod
  def check(config: LocalConfig, jobs: Sequence[Job]) -> None:
    LocalLauncher.check(config, jobs)
    if not isinstance(config, TogetherConfig):
      return
    if not config.exploit_every and tuple(config.explore) != TogetherConfig.explore:
      raise ConfigError(f"launcher.explore={format_value(config.explore)} needs launcher.exploit_every=1 or more.")
    if config.exploit_every:
      population_of([compose(job.overrides) for job in jobs], config.exploit_every, config.explore)
      if len(jobs) > config.max_agents:
        raise ConfigError(f"launcher.max_agents={config.max_agents} is below the {len(jobs)} jobs of the population.")

  def start(self, job: Job) -> bool:
    if job.name in self._workers:  # started with the first job of its group
      return True
    if job.name not in self._groups:  # a search has added it
      self._group([job])
    group = self._groups[job.name]
    return self._start(group, self._population if len(group) > 1 else ())

  def _group(self, jobs: Sequence[Job]) -> None:
    """Groups the unfinished jobs that can share a program."""
    programs: dict[str, list[Job]] = {}
    for job in jobs:
      folder = self._sweep.folder(job)
      if folder.state().status != "finished" and not folder.locked():
        lines = [f"resume={quoted(folder.path.absolute())}"] if folder.begun else job.overrides
        try:
          with self._sweep.in_cwd():
            program = program_of(compose(lines))
        except PlaygroundError:  # the job fails alone, and its log says why
          program = None
        programs.setdefault(program or job.name, []).append(job)
    total = sum(map(len, programs.values()))
    for same in programs.values():
      needs = 1 if self.slots[0].gpu is None else max(1, same[0].needs or 1)
      at_once = max(1, len(self.slots) // needs)
      size = min(self._max_agents, math.ceil(total / at_once))  # so that no slot stays empty
      size = len(same) if self._population else size
      groups = [same[i : i + size] for i in range(0, len(same), size)]
      self._groups |= {job.name: group for group in groups for job in group}
