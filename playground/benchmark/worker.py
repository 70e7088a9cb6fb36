"""Runs one measurement, `python -m playground.benchmark.worker <json>`, and prints its rows as lines."""

import importlib
import json
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from playground.gc_pause import gc_paused

ROW = "ROW "  # prefix of a line with a row; libraries print other lines
CACHES = ("JAX_COMPILATION_CACHE_DIR", "WARP_CACHE_PATH", "CUDA_CACHE_PATH")


class Rows(dict[str, object]):
  """Holds the columns that all rows of a measurement share, and emits rows.

  Attributes:
    lock: a file to lock while timing, if several measurements share a device; else None.
  """

  lock: str | None = None

  def emit(self, quantity: str, value: float, unit: str, **columns: object) -> None:
    """Prints a row of the shared columns, a quantity of `schema.QUANTITIES` and further columns."""
    row = {"quantity": quantity, "value": float(f"{value:.6g}"), "unit": unit, **self, **columns}
    print("\n" + ROW + json.dumps(row), flush=True)  # a library may have left a line unfinished


def main() -> None:
  """Runs a function of `measures`; records an error that the user can act on as the job's reason, and exits with 2."""
  from playground.errors import PlaygroundError
  from playground.files import write_json

  job = json.loads(sys.argv[1])
  arguments, folder, rows = job["arguments"], Path(job["folder"]), Rows()
  os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # else a GPU appears full from the start
  if not job["cache"]:
    os.environ |= {name: str(folder / name) for name in CACHES}
  if job["shares"]:  # other measurements use the same GPUs
    gpus = re.sub(r"\W", "_", os.environ.get("CUDA_VISIBLE_DEVICES", "all"))
    rows.lock = str(folder.parent / f"gpu{gpus}.lock")
  module, _, function = job["measure"].partition(":")
  try:
    with gc_paused(stays=True):
      if module == "training":  # in this process
        _prestart(**arguments)
      measure = getattr(importlib.import_module(f"playground.benchmark.measures.{module}"), function or "measure")
    measure(rows, **arguments)
  except PlaygroundError as error:
    write_json(folder / "status.json", {"status": "failed", "reason": " ".join(str(error).split())})
    sys.exit(2)


def _prestart(task: str, agent: str, overrides: Sequence[str], **_: object) -> None:
  """Starts the process that compiles Warp's kernels, as `playground-run` does."""
  from playground.config import compose
  from playground.envs.options import impl_on_gpu
  from playground.physics.warp_kernels import prestart

  config = compose([f"env={task}", f"agent={agent}", *overrides])
  prestart(impl_on_gpu(config.env), config.hardware.platform)


if __name__ == "__main__":
  main()
