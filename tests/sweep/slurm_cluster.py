"""A real Slurm of one node on this machine, for as long as a test takes; touches no Slurm that is there already."""

import contextlib
import getpass
import os
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

PATH = f"{os.environ.get('PATH', '')}{os.pathsep}/usr/sbin"  # where the daemons are
CPUS = 2  # of the node, whatever the machine has
# Jobs in `high` take the place of those in `low`, who are told GraceTime seconds before. cred_expire is how long a job
# that is queued again waits at least. Nothing here needs a cgroup, a database or another account.
CONFIG = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket,cred_expire=5
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
{parameters}
SlurmdParameters=config_overrides
SchedulerParameters=batch_sched_delay=1,sched_interval=2,bf_interval=2
KillWait=5
NodeName=node NodeHostname={host} NodeAddr=127.0.0.1 CPUs={cpus} RealMemory=4096
PartitionName=low Nodes=node Default=YES PriorityTier=1 GraceTime=20 MaxTime=INFINITE
PartitionName=high Nodes=node PriorityTier=2 PreemptMode=OFF MaxTime=INFINITE
"""


class SlurmCluster:
  """Says what its commands say."""

  def __init__(self, folder: Path):
    self.config = folder / "slurm.conf"

  def __call__(self, *command: str) -> str:
    """What a Slurm command prints; raises CalledProcessError if it fails."""
    env = os.environ | {"SLURM_CONF": str(self.config)}
    return subprocess.run(command, env=env, stdout=subprocess.PIPE, text=True, check=True).stdout

  def queue(self) -> list[str]:
    """The state of every job that has not left."""
    return self("squeue", "--noheader", "--format=%T").split()

  def preempt(self, seconds: int = 2) -> None:
    """Submits what needs the whole node and may take it."""
    self("sbatch", "--partition=high", f"-c{CPUS}", "--output=/dev/null", f"--wrap=sleep {seconds}")

  def clear(self) -> None:
    """Ends all jobs."""
    self("scancel", f"--user={getpass.getuser()}")
    _wait(self, lambda: not self.queue())


@contextlib.contextmanager
def slurm_cluster(user_signal: bool = True) -> Iterator[SlurmCluster]:
  """Starts munged, slurmctld and slurmd on free ports of the loopback, and ends them, their jobs and their files.

  Args:
    user_signal: whether jobs hear by the signal they asked for, SIGUSR2, that another takes their place, or by SIGTERM.
  """
  missing = [name for name in ("munged", "slurmctld", "slurmd", "sbatch") if shutil.which(name, path=PATH) is None]
  if missing:
    pytest.skip(f"needs {missing[0]}: apt-get install slurmctld slurmd slurm-client munge (Debian, Ubuntu).")
  with contextlib.ExitStack() as stack:
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="slurm-")))
    for name in ("state", "spool"):
      (folder / name).mkdir()
    key = folder / "munge.key"
    key.write_bytes(os.urandom(128))
    key.chmod(0o600)
    cluster = SlurmCluster(folder)
    facts = {"host": socket.gethostname(), "user": getpass.getuser(), "ports": _free_ports(2), "cpus": CPUS}
    parameters = "SlurmctldParameters=preempt_send_user_signal" if user_signal else ""
    cluster.config.write_text(CONFIG.format(folder=folder, parameters=parameters, **facts))
    files = {"key-file": key} | {f"{n}-file": folder / f"munged.{n}" for n in ("pid", "log", "seed")}
    stack.enter_context(
      _daemon(cluster, "munged", "--foreground", "--force", f"--socket={folder}/munge.socket",
              *(f"--{name}={path}" for name, path in files.items()))
    )  # fmt: skip
    _wait(cluster, (folder / "munge.socket").exists)
    stack.enter_context(_daemon(cluster, "slurmctld", "-D"))
    stack.enter_context(_daemon(cluster, "slurmd", "-D", "-N", "node"))
    _wait(cluster, lambda: _idle(cluster))
    stack.callback(cluster.clear)
    yield cluster


@contextlib.contextmanager
def _daemon(cluster: SlurmCluster, name: str, *args: str) -> Iterator[None]:
  program = shutil.which(name, path=PATH)
  assert program is not None
  env = os.environ | {"SLURM_CONF": str(cluster.config)}
  with cluster.config.with_name(f"{name}.out").open("wb") as out:
    process = subprocess.Popen([program, *args], env=env, stdout=out, stderr=subprocess.STDOUT)
  try:
    yield
  finally:
    process.terminate()
    try:
      process.wait(20)
    except subprocess.TimeoutExpired:
      process.kill()
      process.wait()


def _wait(cluster: SlurmCluster, what: Callable[[], bool], seconds: float = 30.0) -> None:
  until = time.monotonic() + seconds
  while not what():
    logs = [f"{path.name}: {path.read_text()[-1500:]}" for path in cluster.config.parent.glob("*.out")]
    assert time.monotonic() < until, "\n".join(["Slurm does not get there.", *logs])
    time.sleep(0.2)


def _idle(cluster: SlurmCluster) -> bool:
  try:
    return cluster("sinfo", "--noheader", "--partition=low", "--format=%T").strip() == "idle"
  except subprocess.CalledProcessError:
    return False


def _free_ports(count: int) -> list[int]:
  with contextlib.ExitStack() as stack:
    sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
    for held in sockets:
      held.bind(("127.0.0.1", 0))
    return [held.getsockname()[1] for held in sockets]
