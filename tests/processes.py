"""Starts processes that train together, as several machines would, on devices that XLA simulates on this one."""

import os
import socket
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
COMMAND = "from playground.cli.run import main; main()"
# For a process that does not use Warp, as where it is not installed: its import is most of the time that MJX's takes.
WITHOUT_WARP = {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests" / "without_warp")])}


def start(script: str, folder: Path, *overrides: str, devices: int = 1) -> "subprocess.Popen[str]":
  """Starts a Python script in `folder`, with its arguments, on so many devices."""
  simulated = {"JAX_NUM_CPU_DEVICES": str(devices), "JAX_PLATFORMS": "cpu"}
  command = [sys.executable, "-c", script, *overrides]
  env = os.environ | simulated | WITHOUT_WARP
  return subprocess.Popen(command, cwd=folder, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def two_processes(
  folder: Path, script: str, *overrides: str, devices: int = 2, second: Path | None = None
) -> "list[subprocess.Popen[str]]":
  """Starts both processes of a training over the loopback, both in `folder` or the second one in its own."""
  with socket.socket() as free:
    free.bind(("localhost", 0))
    address = f"localhost:{free.getsockname()[1]}"
  keys = {"coordinator": address, "num_processes": 2, "timeout": 200}
  line = ["hardware=multi_node", "hardware.platform=cpu", *(f"hardware.distributed.{k}={v}" for k, v in keys.items())]
  of = lambda index: [*line, f"hardware.distributed.process_id={index}"]
  places = (folder, second or folder)
  return [start(script, place, *of(index), *overrides, devices=devices) for index, place in enumerate(places)]


def ended(processes: "list[subprocess.Popen[str]]") -> list[str]:
  """Returns what each process said; all of them ended well."""
  said = [process.communicate(timeout=800)[0] for process in processes]
  assert [process.returncode for process in processes] == [0, 0], "\n\n".join(out[-3000:] for out in said)
  return said
