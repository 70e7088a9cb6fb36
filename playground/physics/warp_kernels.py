"""Compiles Warp's kernels for a model before its first step, in parallel, in another process.

Warp compiles a module of kernels at the first launch of one of them. A cold start therefore compiles one module after
another when everything else is ready: 30 to 95 s, longer than tracing and XLA together. Here another process runs a
physics step without launching a kernel, records the modules that the step needs, and compiles all of them at once into
Warp's cache while this process traces. Warp compiles a module that the process missed at its first launch.

The imports of that process take seconds. `prestart` starts it before this process imports its own modules.
"""

import contextlib
import hashlib
import importlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import mujoco

from playground.gc_pause import gc_paused
from playground.interpreter import PYTHON

LIMIT_S = 900.0  # for a machine with few cores; a process that takes longer hangs
_NEEDS = ("warp", "mujoco.mjx.warp.ffi", "mujoco.mjx.third_party.mujoco_warp")
_LONGEST = "ccd_kernel"  # in the name of the module that takes NVRTC longest, half a minute and more

_prestarted: list[subprocess.Popen[str]] = []  # at most one


def prestart(impl: str, platform: str) -> None:
  """Starts the process for the next `KernelBuild` if the run may need it; unused, it ends with this process.

  Call it before slow imports; this module imports fast.

  Args:
    impl: the backend that the task has on a GPU.
    platform: `hardware.platform`.
  """
  no_gpu = "cpu" in (platform, os.environ.get("JAX_PLATFORMS")) or not shutil.which("nvidia-smi")
  if impl == "warp" and not (_prestarted or no_gpu):
    _prestarted.append(_start())


def cancel_prestart() -> None:
  """Ends the process that `prestart` started, if no `KernelBuild` took it."""
  while _prestarted:
    with _prestarted.pop() as process:
      process.kill()


def _start() -> subprocess.Popen[str]:
  command = [*PYTHON, "-W", "ignore", "-m", __name__]
  pipe = subprocess.PIPE
  return subprocess.Popen(command, stdin=pipe, stdout=subprocess.DEVNULL, stderr=pipe, text=True)


def _send(process: subprocess.Popen[str], job: dict[str, Any]) -> None:
  assert process.stdin is not None
  with contextlib.suppress(BrokenPipeError), process.stdin as pipe:  # `wait` reports why it failed
    json.dump(job, pipe)
  process.stdin = None  # so that `communicate` does not write to it


class KernelBuild:
  """Compiles the kernels of one model, unless Warp's cache has them."""

  def __init__(self, mj_model: mujoco.MjModel, njmax: int | None):
    """Starts to compile the kernels that Warp's cache does not have.

    Args:
      mj_model: the compiled model, as the physics has it.
      njmax: constraint rows of an environment, on which some kernels depend.
    """
    import warp

    warp.init()
    self._folder = tempfile.TemporaryDirectory(prefix="playground-")
    path = Path(self._folder.name, "model.mjb")
    mujoco.mj_saveModel(mj_model, str(path), None)
    versions = f"{njmax} {warp.get_device()} {warp.get_device().arch} {mujoco.__version__}"
    key = hashlib.sha256(path.read_bytes() + versions.encode()).hexdigest()[:16]
    # In the folder of Warp's version, so that clearing Warp's cache clears this with it.
    self._marker = Path(str(warp.config.kernel_cache_dir), f"playground_{key}")
    self._process: subprocess.Popen[str] | None = None
    if not self._marker.exists():
      self._process = _prestarted.pop() if _prestarted else _start()
      _send(self._process, {"model": str(path), "njmax": njmax, "cache": str(self._marker.parents[1])})
    cancel_prestart()

  def wait(self) -> str | None:
    """Waits for all kernels; returns a sentence if they could not be compiled ahead."""
    if self._process is None:
      return None
    try:
      errors = self._process.communicate(timeout=LIMIT_S)[1]
    except subprocess.TimeoutExpired:
      errors = f"nothing after {LIMIT_S:.0f} s"
    finally:
      self.stop()
    if self._process.returncode == 0:
      self._marker.touch()
      return None
    why = (errors.strip().splitlines() or [f"exit code {self._process.returncode}"])[-1]
    return f"Warp's kernels were not compiled ahead; Warp compiles them at their first launch: {why}"

  def stop(self) -> None:
    """Ends the process if it still runs, and removes its files."""
    if self._process is not None and self._process.poll() is None:
      self._process.kill()
      self._process.wait()
    self._folder.cleanup()


def quiet_warp() -> Any:
  """The module `warp`, without its messages on starting and on loading kernels; ImportError where there is none."""
  import warp

  warp.config.log_level = warp.LOG_WARNING
  return warp


def compile_all(mj_model: mujoco.MjModel, njmax: int | None, workers: int) -> None:
  """Compiles the kernels of a physics step for this process's device; it cannot launch any afterwards."""
  import warp

  modules = sorted(_launched(mj_model, njmax), key=lambda module: _LONGEST not in module[0].name)
  device = warp.get_device()
  with ThreadPoolExecutor(workers) as pool:
    list(pool.map(lambda module, block_dim: warp.force_load(device, [module], block_dim), *zip(*modules, strict=True)))


def _launched(mj_model: mujoco.MjModel, njmax: int | None) -> list[tuple[Any, int | None]]:
  """The modules whose kernels a step launches, with the threads of a block that they are launched with."""
  import mujoco.mjx.warp.ffi  # MJX's own module
  from mujoco.mjx.third_party import mujoco_warp

  warp = quiet_warp()
  with warp.ScopedDevice("cpu"):  # as MJX does
    model = mujoco_warp.put_model(mj_model)
  model.opt.warn_overflow = 0  # as `physics` does
  data = mujoco_warp.make_data(mj_model, nworld=1, njmax=njmax)
  own = warp.get_module(mujoco.mjx.warp.ffi.__name__)
  modules: dict[tuple[Any, int | None], None] = {(own, None): None}  # a dict keeps the order

  def launch(kernel: Any, dim: Any, *_: Any, block_dim: int | None = None, **__: Any) -> None:
    if 0 not in (dim if isinstance(dim, tuple | list) else (dim,)):
      modules[kernel.module, block_dim] = None

  def run(_: Any, while_body: Any = None, on_true: Any = None, **arguments: Any) -> None:
    (while_body or on_true)(**arguments)

  instead = {"launch": launch, "launch_tiled": launch, "capture_while": run, "capture_if": run, "copy": lambda *_: None}
  for name, function in instead.items():
    setattr(warp, name, function)
  mujoco_warp.step(model, data)
  mujoco_warp.forward(model, data)
  return list(modules)


def _main() -> None:
  """Imports, waits for a job on stdin and compiles it; ends if there is none."""
  with gc_paused(stays=True):
    for name in _NEEDS:
      importlib.import_module(name)
  if text := sys.stdin.read():
    job = json.loads(text)
    os.environ["WARP_CACHE_PATH"] = job["cache"]  # to which Warp adds its version
    compile_all(mujoco.MjModel.from_binary_path(job["model"]), job["njmax"], len(os.sched_getaffinity(0)))


if __name__ == "__main__":
  _main()
