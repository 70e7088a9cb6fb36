"""Runs jobs on a Slurm cluster, through submitit; they continue when the submitting process ends.

A job that is preempted, or reaches its time limit, saves, is queued again, and resumes from its checkpoint.
"""

import dataclasses
import math
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

from playground.config.sweep_options import SlurmConfig
from playground.errors import ConfigError, HardwareError
from playground.extras import install_command
from playground.interpreter import PYTHON
from playground.settings import Plain
from playground.sweep.folder import ENDED, STOP_FILE, Job, JobFolder, SweepDirectory
from playground.sweep.worker import COMMAND, Worker
from playground.text import first_line

try:
  import submitit
except ImportError:
  raise ConfigError(f"launcher=slurm needs submitit: {install_command('slurm')}.") from None

SETTLED = tuple(status for status in ENDED if status not in ("preempted", "killed"))  # Slurm may restart others
_SLURM_ID = re.compile(r"\d+(_\d+)?")  # an id must not be an option of squeue or scancel
QUEUE_S = 5.0  # s between queries of Slurm
ANSWER_S = 60.0  # s after which an answer of Slurm is given up


@dataclasses.dataclass
class SlurmJob:
  """Runs a worker under submitit; the job saves and is queued again on preemption."""

  folder: Path
  command: tuple[str, ...]
  timeout: float | None
  grace: float
  _worker = None  # no field: it is not pickled

  def __call__(self) -> int:
    self._worker = Worker([self.folder], self.command, self.timeout, self.grace)
    code = self._worker.run(where=socket.gethostname())
    if self._taken():
      signal.raise_signal(signal.SIGUSR2)  # submitit's: Slurm requeues no job that exited before it was killed
    return code

  def checkpoint(self) -> submitit.helpers.DelayedSubmission:
    """Saves the job and requeues it; submitit calls this during `__call__`, on preemption and near the time limit."""
    if self._worker is not None:
      self._worker.interrupt("stopped by Slurm, which queues it again unless launcher.requeues are used up")
    return submitit.helpers.DelayedSubmission(dataclasses.replace(self))

  def _taken(self) -> bool:
    """Returns whether the run, not submitit, got Slurm's preemption signal, and the job was not cancelled."""
    if JobFolder(self.folder).state().status != "preempted" or (self.folder.parents[1] / STOP_FILE).exists():
      return False
    job_id = os.environ.get("SLURM_JOB_ID")
    return job_id is not None and Queue().state(job_id) == "RUNNING"


class Queue:
  """Queries the user's jobs with squeue, which works on every cluster; sacct needs accounting."""

  def __init__(self) -> None:
    self._states: dict[str, str] | None = {}
    self.forget()

  def forget(self) -> None:
    """Drops the cached answer of squeue."""
    self._asked = -math.inf

  def state(self, job_id: str) -> str | None:
    """Returns Slurm's state of a job, None if it left the queue; at most `QUEUE_S` old, UNKNOWN without an answer."""
    if time.monotonic() - self._asked > QUEUE_S:
      command = ["squeue", "--me", "--all", "--noheader", "--format=%i %T"]
      try:
        answer = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, timeout=ANSWER_S)
        self._states = dict(line.split(maxsplit=1) for line in answer.stdout.splitlines())
      except (OSError, subprocess.SubprocessError):
        self._states = None
      self._asked = time.monotonic()
    return "UNKNOWN" if self._states is None else self._states.get(job_id)


class SlurmLauncher:
  """Implements `runner.Launcher` on Slurm."""

  outlives = True

  def __init__(
    self,
    sweep: SweepDirectory,
    config: SlurmConfig,
    command: Sequence[str] = COMMAND,
    executor: submitit.Executor | None = None,
  ):
    """See `runner.Launcher`; `executor` defaults to submitit's for Slurm."""
    self.check(config, sweep.jobs)
    self._folder = sweep.path.absolute() / "slurm"
    self._executor = executor or _executor(self._folder, config.requeues)
    self._sweep = sweep
    self._config = config
    self._command = tuple(command)
    self._queue = Queue()
    self.submitted: dict[str, submitit.Job[int]] = {}

  @staticmethod
  def check(config: SlurmConfig, jobs: Sequence[Job]) -> None:
    """See `runner.LauncherClass`; sbatch checks whether the cluster can run a job."""
    if not config.wait and config.max_parallel is not None:
      raise ConfigError("launcher.wait=false submits all jobs at once: leave launcher.max_parallel out.")
    if config.minutes * 60 <= _notice_s(config):
      raise ConfigError(
        f"launcher.minutes={config.minutes} leaves no time to train: jobs are asked to save {_notice_s(config)} s "
        "(launcher.grace + 30) before it is over."
      )
    if "parsable" in config.parameters:
      raise ConfigError(
        "launcher.parameters has parsable, which hides sbatch's sentence with the job's number: drop it."
      )
    for program in ("sbatch", "squeue"):
      if shutil.which(program) is None:
        raise HardwareError(f"launcher=slurm, but there is no {program} here: start it on a machine of the cluster.")

  def start(self, job: Job) -> bool:
    at_once = self._config.max_parallel
    if at_once is not None and sum(self.busy(job) for job in self._sweep.jobs) >= at_once:
      return False
    folder = self._sweep.folder(job)
    if isinstance(self._executor, submitit.SlurmExecutor):
      self._executor.update_parameters(**slurm_parameters(self._config, job))
    folder.write_waiting("submitted")
    task = SlurmJob(folder.path.absolute(), self._command, self._config.timeout, self._config.grace)
    try:
      submitted = self._executor.submit(task)
    except submitit.core.utils.FailedJobError as error:
      folder.write_waiting("queued")
      why = (str(error).strip() or "without a reason").splitlines()[-1].removeprefix("sbatch: ")
      raise HardwareError(
        f"launcher=slurm: sbatch refused job {job.name} ({why}); what was submitted before goes on, and so does the "
        "same command once that is mended."
      ) from None
    except submitit.core.utils.FailedSubmissionError as error:
      folder.write_waiting("queued")
      raise HardwareError(
        f"launcher=slurm: sbatch names no number of job {job.name} ({first_line(error)}): if squeue shows the job, "
        "cancel it; what was submitted before goes on, and so does the same command once that is mended."
      ) from None
    (folder.path / "slurm_id").write_text(submitted.job_id)
    self.submitted[job.name] = submitted
    self._queue.forget()
    return True

  def busy(self, job: Job) -> bool:
    folder = self._sweep.folder(job)
    submitted = self._submitted(job, folder)
    if submitted is None or folder.state().status in SETTLED:
      return False
    if not isinstance(submitted, submitit.SlurmJob):
      return not submitted.done()
    return self._queue.state(submitted.job_id) is not None  # whatever the worker returned: Slurm may have requeued it

  def kill(self) -> None:
    for job in self._sweep.jobs:
      if self.busy(job):
        self.submitted[job.name].cancel()

  def close(self) -> None:
    """Does nothing: jobs outlive this process."""

  def _submitted(self, job: Job, folder: JobFolder) -> "submitit.Job[int] | None":
    """Returns submitit's handle of a job, even if an earlier process submitted the job; None without one."""
    known = folder.path / "slurm_id"
    if job.name not in self.submitted and known.is_file() and _SLURM_ID.fullmatch(job_id := known.read_text()):
      self.submitted[job.name] = self._executor.job_class(self._folder, job_id)
    return self.submitted.get(job.name)


def _executor(folder: Path, requeues: int) -> submitit.SlurmExecutor:
  """Returns submitit's executor, whose jobs start Python with the command `PYTHON`."""
  return submitit.SlurmExecutor(folder, max_num_timeout=requeues, python=shlex.join(PYTHON))


def slurm_parameters(config: SlurmConfig, job: Job) -> dict[str, Plain]:
  """Returns the sbatch parameters of a job, by submitit's names."""
  gpus = config.gpus_per_job if config.gpus_per_job is not None else 1 if job.needs is None else job.needs
  parameters = {
    "job_name": job.name,
    "time": config.minutes,
    "cpus_per_task": config.cores_per_job,
    "mem": f"{config.memory_gb}GB",
    "nodes": 1,
    "ntasks_per_node": 1,
    "signal_delay_s": _notice_s(config),
    "setup": list(config.setup),
    "additional_parameters": dict(config.parameters),
  }
  named = {key: getattr(config, key) for key in ("partition", "account", "qos", "constraint")}
  return parameters | {key: value for key, value in named.items() if value} | ({"gpus_per_node": gpus} if gpus else {})


def _notice_s(config: SlurmConfig) -> int:
  """Returns the seconds before the time limit at which a job is asked to save."""
  return int(config.grace) + 30
