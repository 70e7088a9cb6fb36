"""Runs jobs as tasks of a Ray cluster, whose nodes share the sweep's folder; a lost node's task restarts elsewhere."""

import contextlib
import os
import signal
import socket
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from urllib.parse import urlsplit

from playground.config.sweep_options import RayConfig
from playground.errors import ConfigError, HardwareError
from playground.extras import install_command
from playground.hardware.gpus import limit_memory
from playground.sweep.folder import Job, JobFolder, SweepDirectory
from playground.sweep.local import MEMORY_FRACTION
from playground.sweep.worker import COMMAND, POLL_S, Worker, blocked
from playground.text import first_line

try:
  import ray
except ImportError:
  raise ConfigError(f"launcher=ray needs Ray: {install_command('ray')}.") from None


_CORES = 4  # of a job, unless launcher.cores_per_job is set
_PATIENCE_S = 5.0  # after a stop: a job that began just before it says so meanwhile

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
    self._stopped_at: float | None = None
    self._run = ray.remote(max_calls=1)(_run)  # a process for each job, as with the other launchers

  @staticmethod
  def check(config: RayConfig, jobs: Sequence[Job]) -> None:
    """See `runner.LauncherClass`; connects to the cluster or starts one, until `close` or the process's end."""
    if not ray.is_initialized():
      address = config.address or os.environ.get("RAY_ADDRESS")
      try:
        _knock(address)
        with contextlib.chdir(_PACKAGES), blocked(signal.SIGHUP):  # a closed terminal sends it to Ray's processes
          ray.init(address=address, log_to_driver=False, include_dashboard=False)
      except (OSError, RuntimeError, ValueError) as error:
        raise HardwareError(f"launcher=ray: no cluster at {address}: {first_line(error)}") from None
      RayLauncher._owned = True
    nodes = _nodes()
    for job in jobs:
      gpus, cores = _gpus(config, job), _cores(config)
      if not any(gpus <= has_gpus and cores <= has_cores for has_gpus, has_cores in nodes):
        takes, has = f"{gpus:g} GPUs and {cores:g} cores", "{:g} and {:g}".format(*max(nodes))
        raise HardwareError(
          f"Job {job.name} takes {takes}, but the largest node of Ray's cluster has {has}: set launcher.gpus_per_job "
          "and launcher.cores_per_job."
        )

  def start(self, job: Job) -> bool:
    folder, limits = self._sweep.folder(job), (self._config.timeout, self._config.grace)
    folder.write_waiting("submitted")
    with _cluster_there():
      gpus = _gpus(self._config, job)
      task = self._run.options(
        num_cpus=_cores(self._config), num_gpus=gpus, max_retries=self._config.retries, name=job.name
      )
      self._tasks[job.name] = task.remote(str(folder.path.absolute()), self._command, *limits, gpus)
    return True

  def busy(self, job: Job) -> bool:
    task = self._tasks.get(job.name)
    if task is None:
      return False
    with _cluster_there():
      if self._never_begins(job):
        ray.cancel(task)
      return not ray.wait([task], timeout=0)[0]

  def _never_begins(self, job: Job) -> bool:
    """Whether the sweep is stopped while the job still waits for its turn."""
    if not self._sweep.stop_file.exists():
      return False
    self._stopped_at = self._stopped_at or time.monotonic()
    waited = time.monotonic() - self._stopped_at > _PATIENCE_S
    return waited and self._sweep.folder(job).state().status == "submitted"

  def kill(self) -> None:
    for job in self._sweep.jobs:
      if self.busy(job):
        ray.cancel(self._tasks[job.name], force=True)

  def close(self) -> None:
    if self._owned:
      RayLauncher._owned = False
      ray.shutdown()


@contextlib.contextmanager
def _cluster_there() -> Iterator[None]:
  """Turns an error of the connection in the block into a sentence."""
  try:
    yield
  except (ConnectionError, ray.exceptions.RayError) as error:
    what = f"the cluster is gone ({first_line(error)})"
    raise HardwareError(f"launcher=ray: {what}; the same command runs what is missing.") from None


def _knock(address: str | None) -> None:
  """Raises OSError if nothing listens at an address of host and port; Ray itself retries for most of a minute.

  Raises ValueError for an address of another kind.
  """
  place = urlsplit(address if address and "//" in address else f"//{address or ''}")
  if place.scheme not in ("", "ray"):
    raise ValueError("write auto, local, host:port or ray://host:port")
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
  return min(_CORES, max(cores for _, cores in _nodes()))


def _nodes() -> list[tuple[float, float]]:
  """Returns the numbers of GPUs and of cores of each node that is there."""
  alive = [node["Resources"] for node in ray.nodes() if node["Alive"]]
  return [(has.get("GPU", 0), has.get("CPU", 0)) for has in alive]


def _run(folder: str, command: tuple[str, ...], timeout: float | None, grace: float, gpus: float) -> int:
  """Runs a worker as a task, on the GPUs that Ray assigned."""
  _end_orphan(JobFolder(Path(folder)), grace)
  if 0 < gpus < 1:
    limit_memory(os.environ, MEMORY_FRACTION * gpus)
  given = ",".join(map(str, ray.get_gpu_ids()))
  where = socket.gethostname() + (f" GPU {given}" if given else "")
  return Worker([Path(folder)], command, timeout, grace).run(where)


def _end_orphan(job: JobFolder, grace: float) -> None:
  """Ends the process of a job whose worker was killed, such as by Ray for want of memory: this task resumes the job.

  It is asked to save, and killed `grace` seconds later.
  """
  asked_at = None
  while job.locked() and (record := job.record).get("host") == socket.gethostname():
    if Path("/proc", str(record.get("pid"))).exists():  # another worker has it
      return
    if asked_at is None:
      asked_at = time.monotonic()
      job.signal(signal.SIGTERM)
    elif time.monotonic() - asked_at > grace:
      job.signal(signal.SIGKILL, group=True)
    time.sleep(POLL_S)
