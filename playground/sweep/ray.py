"""Runs jobs as tasks of a Ray cluster, whose nodes share the sweep's folder; a lost node's task restarts elsewhere."""

import contextlib
import os
import socket
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import urlsplit

from playground.config.sweep_options import RayConfig
from playground.errors import ConfigError, HardwareError
from playground.extras import install_command
from playground.hardware.gpus import limit_memory
from playground.sweep.folder import Job, SweepDirectory
from playground.sweep.local import MEMORY_FRACTION
from playground.sweep.worker import COMMAND, Worker
from playground.text import first_line

try:
  import ray
except ImportError:
  raise ConfigError(f"launcher=ray needs Ray: {install_command('ray')}.") from None


_CORES = 4  # of a job, unless launcher.cores_per_job is set

# Ray puts the working directory first on its workers' path, where a stray yaml.py would be imported: start it here.
_PACKAGES = Path(__file__).parents[2]


class RayLauncher:
  """Implements `runner.Launcher` on a Ray cluster."""

  outlives = False
  _owned = False  # whether this launcher made the process's connection

  def __init__(self, sweep: SweepDirectory, config: RayConfig, command: Sequence[str] = COMMAND):
    self.check(config, sweep.jobs)
    self._sweep = sweep
    self._config = config
    self._command = tuple(command)
    self._tasks: dict[str, ray.ObjectRef] = {}
    self._run = ray.remote(max_calls=1)(_run)  # a process for each job, as with the other launchers

  @staticmethod
  def check(config: RayConfig, jobs: Sequence[Job]) -> None:
    """See `runner.LauncherClass`; connects to the cluster or starts one, until `close` or the process's end."""
    if not ray.is_initialized():
      address = config.address or os.environ.get("RAY_ADDRESS")
      try:
        _knock(address)
        with contextlib.chdir(_PACKAGES):
          ray.init(address=address, log_to_driver=False, include_dashboard=False)
      except (OSError, RuntimeError, ValueError) as error:
        raise HardwareError(f"launcher=ray: no cluster at {address}: {first_line(error)}") from None
      RayLauncher._owned = True
    has = ray.cluster_resources()
    for job in jobs:
      gpus, cores = _gpus(config, job), _cores(config)
      if gpus > has.get("GPU", 0) or cores > has.get("CPU", 0):
        raise HardwareError(
          f"Job {job.name} takes {gpus:g} GPUs and {cores:g} cores, but Ray's cluster has {has.get('GPU', 0):g} and "
          f"{has.get('CPU', 0):g}: set launcher.gpus_per_job and launcher.cores_per_job."
        )

  def start(self, job: Job) -> bool:
    folder, gpus = self._sweep.folder(job), _gpus(self._config, job)
    folder.write_waiting("submitted")
    task = self._run.options(
      num_cpus=_cores(self._config), num_gpus=gpus, max_retries=self._config.retries, name=job.name
    )
    limits = (self._config.timeout, self._config.grace)
    self._tasks[job.name] = task.remote(str(folder.path.absolute()), self._command, *limits, gpus)
    return True

  def busy(self, job: Job) -> bool:
    task = self._tasks.get(job.name)
    return task is not None and not ray.wait([task], timeout=0)[0]

  def kill(self) -> None:
    for job in self._sweep.jobs:
      if self.busy(job):
        ray.cancel(self._tasks[job.name], force=True)

  def close(self) -> None:
    if self._owned:
      RayLauncher._owned = False
      ray.shutdown()


def _knock(address: str | None) -> None:
  """Raises OSError if nothing listens at an address of host and port; Ray itself retries for most of a minute."""
  place = urlsplit(address if address and "//" in address else f"//{address or ''}")
  if place.hostname and place.port:
    socket.create_connection((place.hostname, place.port), timeout=10.0).close()


def _gpus(config: RayConfig, job: Job) -> float:
  """Returns the number of GPUs that a job takes."""
  if config.gpus_per_job is not None:
    return 0 if job.needs == 0 else config.gpus_per_job
  return job.needs if job.needs is not None else min(1, ray.cluster_resources().get("GPU", 0))


def _cores(config: RayConfig) -> float:
  """Returns the number of cores that a job takes."""
  if config.cores_per_job is not None:
    return config.cores_per_job
  return min(_CORES, max(node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"]))


def _run(folder: str, command: tuple[str, ...], timeout: float | None, grace: float, gpus: float) -> int:
  """Runs a worker as a task, on the GPUs that Ray assigned."""
  if 0 < gpus < 1:
    limit_memory(os.environ, MEMORY_FRACTION * gpus)
  given = ",".join(map(str, ray.get_gpu_ids()))
  where = socket.gethostname() + (f" GPU {given}" if given else "")
  return Worker([Path(folder)], command, timeout, grace).run(where)
