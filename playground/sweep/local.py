"""Runs jobs as processes on this machine, each on GPU slots and CPU cores of its own."""

import dataclasses
import os
import signal
import subprocess
from collections.abc import Sequence

from playground.config.sweep_options import LocalConfig
from playground.errors import ConfigError, HardwareError
from playground.hardware.gpus import limit_memory, visible_gpus
from playground.interpreter import PYTHON
from playground.sweep.folder import Job, SweepDirectory
from playground.sweep.mps import MultiProcessService, control_program
from playground.sweep.worker import COMMAND

ALL = "all"
MEMORY_FRACTION = 0.9  # of a GPU, shared among its slots; the rest is for Warp and the driver


@dataclasses.dataclass(frozen=True)
class Slot:
  """A slot for one job: a GPU (None without one, `ALL` for all that are visible here) and CPU cores."""

  number: int
  gpu: str | None
  cores: tuple[int, ...]


def make_slots(gpus: Sequence[str], slots_per_gpu: int, cores: Sequence[int], cores_per_job: int) -> list[Slot]:
  """Divides a machine into slots, which alternate between GPUs so that jobs spread; cores are divided evenly."""
  places = [gpu for _ in range(slots_per_gpu) for gpu in gpus] or [None] * max(1, len(cores) // cores_per_job)
  each = len(cores) // len(places)
  share = lambda i: tuple(cores[i * each : (i + 1) * each]) if each else tuple(cores)
  return [Slot(i, gpu, share(i)) for i, gpu in enumerate(places)]


def pick(free: Sequence[Slot], needs: int | None) -> list[Slot] | None:
  """Returns slots for a job of `needs` GPUs (None: one, if there is any), one on each; None if too few are free."""
  needs = max(1, needs or 0)
  first: dict[str | None, Slot] = {}
  for slot in free:
    first.setdefault(slot.gpu, slot)
  return list(first.values())[:needs] if len(first) >= needs else None


class LocalLauncher:
  """Implements `runner.Launcher` on this machine."""

  outlives = False

  def __init__(
    self, sweep: SweepDirectory, config: LocalConfig, command: Sequence[str] = COMMAND, slots: Sequence[Slot] = ()
  ):
    """See `runner.Launcher`; `slots` replace those of `config` on this machine."""
    with sweep.in_cwd():
      self.check(config, sweep.jobs)
    cores = sorted(os.sched_getaffinity(0))
    self.slots = slots or make_slots(visible_gpus()[: config.gpus], config.slots_per_gpu, cores, config.cores_per_job)
    self._sweep = sweep
    self._config = config
    self._command = tuple(command)
    self._workers: dict[str, subprocess.Popen[bytes]] = {}
    self._taken: dict[str, list[Slot]] = {}
    for job in sweep.jobs:  # jobs that outlived an earlier launcher
      folder = sweep.folder(job)
      if folder.locked():
        numbers = folder.record.get("slots", [])
        self._taken[job.name] = [slot for slot in self.slots if slot.number in numbers]
    self._mps = MultiProcessService(sweep.path) if config.mps else None  # last: `close` ends it

  @staticmethod
  def check(config: LocalConfig, jobs: Sequence[Job]) -> None:
    gpus = visible_gpus()
    if config.gpus is not None and config.gpus > len(gpus):
      raise HardwareError(f"launcher.gpus={config.gpus}, but this machine has {len(gpus)}.")
    gpus = gpus[: config.gpus]
    if config.mps and (config.slots_per_gpu < 2 or not gpus):
      raise ConfigError("launcher.mps=true is for jobs that share a GPU: a GPU, and launcher.slots_per_gpu above 1.")
    if config.mps:
      control_program()
    for job in jobs:
      if (job.needs or 1) > max(1, len(gpus)) and gpus:
        raise HardwareError(
          f"Job {job.name} asks for hardware.devices={job.needs}, but launcher=local has {len(gpus)} GPUs here."
        )

  def start(self, job: Job) -> bool:
    return self._start([job])

  def _start(self, jobs: Sequence[Job], options: Sequence[str] = ()) -> bool:
    """Starts jobs that need the same devices in one process, or returns False if no slot is free now.

    `options` are added to their command.
    """
    job = jobs[0]
    for name in [name for name in self._taken if not self._at_work(name)]:
      del self._taken[name]
    taken = {slot for slots in self._taken.values() for slot in slots}
    free = [slot for slot in self.slots if slot not in taken]
    slots = pick(free, 0 if self.slots[0].gpu is None else job.needs)
    if slots is None:
      return False
    gpus = [slot.gpu for slot in slots if slot.gpu is not None] if job.needs != 0 else []
    cores = [core for slot in slots for core in slot.cores]
    where = f"GPU {','.join(gpus)}" if gpus else f"cores {','.join(map(str, cores))}" if cores else ""
    limits = ["--grace", str(self._config.grace)]
    limits += [] if self._config.timeout is None else ["--timeout", str(self._config.timeout)]
    folders = [self._sweep.folder(job) for job in jobs]
    for folder in folders:
      folder.write_waiting("submitted")
    numbers = [str(slot.number) for slot in slots]
    args = [*limits, "--where", where, "--slots", *numbers, "--cores", *map(str, cores), "--", *self._command, *options]
    with folders[0].log.open("ab") as log:
      worker = subprocess.Popen(
        [*PYTHON, "-m", "playground.sweep.worker", *(str(folder.path) for folder in folders), *args],
        env=self._environment(gpus),
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=subprocess.STDOUT,
        start_new_session=True,  # Ctrl-C stops this process; jobs are stopped through the sweep's folder
      )
    self._workers |= {job.name: worker for job in jobs}
    self._taken[job.name] = slots
    return True

  def busy(self, job: Job) -> bool:
    return self._at_work(job.name)

  def kill(self) -> None:
    for job in self._sweep.jobs:
      if self._at_work(job.name):
        # The worker sees its job end; a worker of an earlier start is no child process, but its job ends, too.
        self._sweep.folder(job).signal(signal.SIGKILL, group=True)

  def close(self) -> None:
    for worker in self._workers.values():
      worker.wait()
    if self._mps:
      self._mps.stop()

  def _at_work(self, name: str) -> bool:
    worker = self._workers.get(name)
    if worker is not None and worker.poll() is None:
      return True
    return self._sweep.folder(next(job for job in self._sweep.jobs if job.name == name)).locked()

  def _environment(self, gpus: Sequence[str]) -> dict[str, str]:
    """Returns the environment of a job: visible GPUs, its share of their memory, MPS."""
    env = dict(os.environ) if ALL in gpus else os.environ | {"CUDA_VISIBLE_DEVICES": ",".join(gpus)}
    shared = self._config.slots_per_gpu
    if gpus and shared > 1:
      limit_memory(env, MEMORY_FRACTION / shared)
    return env | (self._mps.environment if self._mps else {})
