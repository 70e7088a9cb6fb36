"""One row a number: the columns of every table that `playground-bench` writes, and the file that holds them."""

import csv
import threading
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from playground.errors import ConfigError
from playground.runs.files import write_text

COLUMNS = {
  "benchmark": "the command: throughput, startup, scaling, breakdown, pixels, topology, chain, compare, learning",
  "task": "the task's name, of a chain the experiment's",
  "agent": "ppo or sac",
  "who": "ours, or the peer's name and version",
  "setting": "what differs from the task's own configuration, as overrides, and what the benchmark varies",
  "seed": "of the training; empty where a number belongs to all seeds",
  "quantity": "what was measured, see QUANTITIES",
  "value": "the number",
  "unit": "its unit",
  "backend": "physics: jax or warp",
  "devices": "how many took part",
  "device": "their kind",
  "precision": "of physics and networks",
  "versions": "Python, JAX, MuJoCo, MJX, Warp, driver",
  "commit": "of our checkout, + where it had changes",
  "conditions": "what else one needs to know to compare",
  "date": "UTC",
}

QUANTITIES = {
  "training_steps_per_s": "control steps (action repeats counted) trained on a second: collecting and learning",
  "env_steps_per_s": "control steps a second with random actions, episodes limited and reset, nothing learned",
  "trace_s": "tracing the run's functions in Python",
  "compile_s": "compiling them, side by side, after tracing; on a GPU Warp's kernels, too",
  "start_to_first_update_s": "from the start of the process to the end of the first update",
  "peak_memory_gib": "most memory that JAX's allocator held on one device (Warp's own is not in it)",
  "used_memory_gib": "most memory in use on the GPU while it ran, what was in use before taken off (nvidia-smi)",
  "seconds_per_step": "breakdown, pixels: time of one control step of one environment, with the parts so far",
  "return": "mean return of one evaluation; setting says after how many steps",
  "best_return": "best mean return of an evaluation, that of the untrained policy apart",
  "final_return": "mean return of the last evaluation",
  "steps": "control steps trained",
  "wall_clock_s": "of a run without compiling (conditions say where it is in), evaluations included",
}

KEY = ("benchmark", "task", "agent", "who", "setting", "seed", "quantity", "devices", "device")


class Table:
  """A CSV of rows that grows while measuring; every row is complete on disk as soon as it is added."""

  def __init__(self, path: Path):
    """Opens or begins the table; what a kill left of a half-written last row is dropped.

    Raises:
      ConfigError: the file holds something else, or cannot be written.
    """
    self.path, self._lock = path, threading.Lock()
    self._rows: list[dict[str, str]] = []
    try:
      path.parent.mkdir(parents=True, exist_ok=True)
      if path.is_file() and path.stat().st_size:
        text = path.read_text(encoding="utf-8")
        whole, newline, rest = text.rpartition("\n")
        if rest:
          write_text(path, whole + newline)
        reader = csv.DictReader(whole.splitlines())
        if list(reader.fieldnames or ()) != list(COLUMNS):
          raise ConfigError(f"out={path} is not a table of playground-bench: name another file.")
        self._rows = list(reader)
      else:
        path.write_text(",".join(COLUMNS) + "\n", encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
      raise ConfigError(f"out={path} cannot be used: {getattr(error, 'strerror', None) or error}.") from None

  def add(self, row: Mapping[str, Any]) -> None:
    """Appends a row; columns it does not name are empty.

    Raises:
      KeyError: a column or quantity that the schema does not have.
    """
    if unknown := set(row) - set(COLUMNS):
      raise KeyError(f"no columns of a row: {unknown}")
    if row["quantity"] not in QUANTITIES:
      raise KeyError(f"{row['quantity']} is not in QUANTITIES")
    full = {name: "" if row.get(name) is None else str(row[name]) for name in COLUMNS}
    with self._lock, self.path.open("a", encoding="utf-8", newline="") as file:
      csv.DictWriter(file, list(COLUMNS), lineterminator="\n").writerow(full)
      self._rows.append(full)

  def has(self, wanted: Mapping[str, Any]) -> bool:
    """Whether there is a row with these columns."""
    texts = {name: str(value) for name, value in wanted.items()}
    return any(all(row[name] == text for name, text in texts.items()) for row in self._rows)


def mean_and_ci95(values: Iterable[float]) -> tuple[float, float | None]:
  """Mean, and half the width of its 95 % confidence interval (Student's t); None from one value."""
  import numpy as np
  from scipy.special import stdtrit

  sample = np.asarray(list(values), float)
  if len(sample) < 2:
    return float(sample.mean()), None
  error = sample.std(ddof=1) / np.sqrt(len(sample))
  return float(sample.mean()), float(stdtrit(len(sample) - 1, 0.975) * error)
