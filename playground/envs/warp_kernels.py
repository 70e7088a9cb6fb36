"""Compiles Warp's kernels for a model ahead of its first step, side by side, in a process of their own.

Warp compiles a module of kernels when one of them is first launched, so a cold start compiles one after another when
everything else is ready: half a minute to one and a half, longer than tracing and XLA together. Here another process
walks through a physics step without launching anything, notes the modules it would need, and compiles all of them at
once into Warp's cache while this one traces. What it should miss is compiled at its first launch, as ever.
"""

import hashlib
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import mujoco

LIMIT_S = 900.0  # for a machine with few cores; a process that takes longer hangs


class Building:
  """Kernels that are being compiled for one model, or were before."""

  def __init__(self, mj_model: mujoco.MjModel, njmax: int | None):
    """Starts to compile what Warp's cache does not have yet.

    Args:
      mj_model: the compiled model, as the physics has it.
      njmax: constraint rows of an environment, on which some kernels depend.
    """
    import warp

    warp.init()
    self._folder = tempfile.TemporaryDirectory(prefix="playground-")
    path = Path(self._folder.name, "model.mjb")
    mujoco.mj_saveModel(mj_model, str(path), None)
    facts = f"{njmax} {warp.get_device()} {warp.get_device().arch} {mujoco.__version__}"
    key = hashlib.sha256(path.read_bytes() + facts.encode()).hexdigest()[:16]
    # In the folder of Warp's version, so that clearing Warp's cache clears this with it.
    self._marker = Path(str(warp.config.kernel_cache_dir), f"playground_{key}")
    self._process: subprocess.Popen[str] | None = None
    if not self._marker.exists():
      command = [sys.executable, "-W", "ignore", "-m", __name__, str(path), str(njmax or 0)]
      self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)

  def wait(self) -> str | None:
    """Waits until all of them are there; returns a sentence if they could not be compiled ahead."""
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
    return f"Warp's kernels were not compiled ahead, they are at their first launch: {why}"

  def stop(self) -> None:
    """Ends the process if it is still there, and removes what it was given."""
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

  modules = _launched(mj_model, njmax)
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


if __name__ == "__main__":
  compile_all(mujoco.MjModel.from_binary_path(sys.argv[1]), int(sys.argv[2]) or None, len(os.sched_getaffinity(0)))
