"""Runs NVIDIA's Multi-Process Service, with which processes that share a GPU run concurrently instead of in turns."""

import contextlib
import hashlib
import os
import shutil
import stat
import subprocess
import tempfile
from pathlib import Path

from playground.errors import HardwareError

CONTROL = "nvidia-cuda-mps-control"
TIMEOUT_S = 60.0


def control_program() -> str:
  """Returns the path of the service's control program; raises HardwareError if it is not installed."""
  program = shutil.which(CONTROL)
  if program is None:
    raise HardwareError(
      f"launcher.mps=true, but {CONTROL}, which comes with NVIDIA's driver, is not on PATH: leave launcher.mps out."
    )
  return program


def _make_own(folder: Path) -> None:
  """Makes a private folder in a shared one; raises HardwareError if another user owns or can read it."""
  with contextlib.suppress(FileExistsError):
    folder.mkdir(mode=0o700)
  found = folder.lstat()
  if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or stat.S_IMODE(found.st_mode) & 0o077:
    raise HardwareError(
      f"launcher.mps=true, but {folder} is not a folder of yours alone: remove it, or set TMPDIR to another place."
    )


class MultiProcessService:
  """Runs the service of one sweep, on all GPUs of the driver.

  A restarted sweep uses the service of its earlier jobs, if they still run.
  """

  def __init__(self, sweep: Path):
    """Starts the service, unless it runs already.

    Args:
      sweep: the sweep's folder, for the logs.

    Raises:
      HardwareError: the service is not installed, or does not start.
    """
    self._program = control_program()
    name = hashlib.sha256(str(sweep.resolve()).encode()).hexdigest()[:12]
    pipes = Path(tempfile.gettempdir(), f"playground-mps-{os.getuid()}-{name}")  # names of sockets must be short
    logs = sweep / "mps"
    logs.mkdir(mode=0o700, exist_ok=True)
    _make_own(pipes)
    self.environment = {"CUDA_MPS_PIPE_DIRECTORY": str(pipes), "CUDA_MPS_LOG_DIRECTORY": str(logs)}
    if self._control(command="get_server_list\n")[0] == 0:
      return
    code, output = self._control("-d")
    if code:
      raise HardwareError(f"launcher.mps=true, but {CONTROL} does not start: {output or f'exit code {code}'}")

  def stop(self) -> None:
    """Ends the service once the processes that use it have ended."""
    self._control(command="quit\n")
    shutil.rmtree(self.environment["CUDA_MPS_PIPE_DIRECTORY"], ignore_errors=True)

  def _control(self, *args: str, command: str = "") -> tuple[int, str]:
    """Runs the control program; returns its exit code and output."""
    # All GPUs: a service that sees only some would renumber them for the jobs.
    env = {key: value for key, value in os.environ.items() if key != "CUDA_VISIBLE_DEVICES"} | self.environment
    with tempfile.TemporaryFile("w+") as out:  # a file: the service continues, and would hold a pipe open
      call = [self._program, *args]
      try:
        done = subprocess.run(
          call, input=command, stdout=out, stderr=subprocess.STDOUT, text=True, env=env, timeout=TIMEOUT_S
        )
      except subprocess.TimeoutExpired:
        return 1, f"nothing after {TIMEOUT_S:.0f} s"
      out.seek(0)
      return done.returncode, out.read().strip()
