"""The process of one measurement: `python -m playground.benchmark.worker <json>`; its rows are lines on stdout."""

import importlib
import json
import os
import sys
from collections.abc import Callable, Sequence
from typing import Any

from playground.collector import uncollected

ROW, ERROR = "ROW ", "ERROR "  # what a line begins with; other lines are the libraries' own

Emit = Callable[..., None]  # (quantity, value, unit, **columns)


class Facts(dict[str, Any]):
  """Columns that all rows of a measurement share, and the function that emits one."""

  def emit(self, quantity: str, value: float, unit: str, **columns: Any) -> None:
    row = {"quantity": quantity, "value": float(f"{value:.6g}"), "unit": unit, **self, **columns}
    print("\n" + ROW + json.dumps(row), flush=True)  # a library may have left a line unfinished


def main() -> None:
  """Runs `measures.<name>.measure(facts, **arguments)`; what the user can act on is one line, else a traceback."""
  from playground.errors import PlaygroundError

  job = json.loads(sys.argv[1])
  arguments = job["arguments"]
  os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # else a GPU looks full from the start
  try:
    with uncollected(stays=True):
      if job["measure"] == "training":  # in this process
        _stand_by(**arguments)
      measure = importlib.import_module(f"playground.benchmark.measures.{job['measure']}").measure
    measure(Facts(), **arguments)
  except PlaygroundError as error:
    print(ERROR + " ".join(str(error).split()), flush=True)
    sys.exit(2)


def _stand_by(task: str, agent: str, overrides: Sequence[str], **_: Any) -> None:
  """Starts the process that compiles Warp's kernels, as `playground-run` does."""
  from playground.config import compose
  from playground.envs.warp_kernels import stand_by

  config = compose([f"env={task}", f"agent={agent}", *overrides])
  stand_by(config.env, config.hardware.platform)


if __name__ == "__main__":
  main()
