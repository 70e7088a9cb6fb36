"""The process of one measurement: `python -m playground.benchmark.worker <json>`; its rows are lines on stdout."""

import importlib
import json
import os
import sys
from collections.abc import Callable
from typing import Any

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
  os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # else a GPU looks full from the start
  try:
    importlib.import_module(f"playground.benchmark.measures.{job['measure']}").measure(Facts(), **job["arguments"])
  except PlaygroundError as error:
    print(ERROR + " ".join(str(error).split()), flush=True)
    sys.exit(2)


if __name__ == "__main__":
  main()
