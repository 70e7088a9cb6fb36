"""Defines the columns of the tables that `playground-bench` writes, one row for each number, and their CSV files."""

import csv
import fcntl
import io
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from playground.errors import ConfigError
from playground.files import csv_text, need_folder

COLUMNS = {
  "benchmark": "the command, such as throughput, together, startup, topology, chain, compare, learning or golden",
  "task": "name of the task, or of a chain's experiment",
  "agent": "the option of agent, such as ppo, ppo_paper or sac",
  "who": "ours, or the peer's name and version",
  "setting": "overrides of the task's own configuration, and the values that the benchmark varies",
  "seed": "of the training; empty if a number belongs to all seeds",
  "quantity": "what was measured, see QUANTITIES",
  "value": "the number",
  "unit": "its unit",
  "backend": "physics: jax or warp",
  "devices": "number of devices",
  "device": "kind of device",
  "precision": "of physics and networks",
  "versions": "Python, JAX, MuJoCo, MJX, Warp, driver",
  "commit": "of our checkout, with + if files had changes",
  "conditions": "other conditions that matter for a comparison",
  "date": "UTC",
}

QUANTITIES = {
  "training_steps_per_s": "control steps (action repeats counted) a second of all agents: rollouts and updates",
  "env_steps_per_s": "control steps a second with random actions, time limit and resets, without learning",
  "trace_s": "tracing the run's functions in Python",
  "compile_s": "compiling these functions in parallel, after tracing; on a GPU Warp's kernels, too",
  "start_to_first_update_s": "from the start of the process to the end of the first update",
  "peak_memory_gib": "peak memory of JAX's allocator on one device (without Warp's own)",
  "used_memory_gib": "peak memory in use on the GPU, minus the memory in use before (nvidia-smi)",
  "seconds_per_step": "breakdown, pixels: time of one control step of one environment, with all parts added so far",
  "return": "mean return of one evaluation (agent.deterministic_eval); setting says after how many steps",
  "mode_return": "mean return of one evaluation of the policy's mode",
  "best_return": "best mean return of an evaluation, without that of the untrained policy",
  "final_return": "mean return of the last evaluation",
  "final_mode_return": "mean return of the last evaluation of the policy's mode",
  "golden_metric": "last value of the column of metrics.csv that setting names",
  "steps": "control steps trained",
  "command_s": "from the start of the command to its end: imports, compiling, training, evaluations, saving",
  "wall_clock_s": "of a run with evaluations, without compiling (unless conditions say otherwise)",
}


class Table:
  """Reads and appends to a CSV of rows; a row is complete on disk when `add` returns.

  Several commands may add to one file at the same time: each locks the file while it writes.
  """

  def __init__(self, path: Path):
    """Opens or creates the table; drops a last row that a killed process has not completed.

    Raises:
      ConfigError: the file holds something else, or is not writable.
    """
    need_folder(path.parent, f"out={path}")
    self.path = path
    self._rows: list[dict[str, str]] = []
    with self._to_itself() as file:
      text = file.read().decode("utf-8", "replace")  # a kill may have cut a character
      if not text:
        file.write((",".join(COLUMNS) + "\n").encode())
      elif next(csv.reader([text.partition("\n")[0]])) != list(COLUMNS):
        raise ConfigError(f"out={path} is not a table of playground-bench: name another file.")
      _end_last_row(file)
      self._rows = list(_rows_of(file))

  def add(self, row: Mapping[str, object]) -> None:
    """Appends a row; missing columns are empty.

    Raises:
      KeyError: a column or quantity that the schema does not have.
      ConfigError: writing the file failed.
    """
    if unknown := set(row) - set(COLUMNS):
      raise KeyError(f"no columns of a row: {unknown}")
    if row["quantity"] not in QUANTITIES:
      raise KeyError(f"{row['quantity']} is not in QUANTITIES")
    full = {name: "" if row.get(name) is None else str(row[name]) for name in COLUMNS}
    with self._to_itself() as file:
      _end_last_row(file)
      file.write(csv_text(list(COLUMNS), [full]).encode())
    self._rows.append(full)

  def has(self, wanted: Mapping[str, object]) -> bool:
    """Returns whether a row has these columns."""
    texts = {name: str(value) for name, value in wanted.items()}
    return any(all(row[name] == text for name, text in texts.items()) for row in self._rows)

  def rows(self, start: int = 0) -> list[dict[str, str]]:
    """Returns the rows from the `start`-th on, in the order of `add`."""
    return self._rows[start:]

  @contextmanager
  def _to_itself(self) -> Iterator[BinaryIO]:
    """Yields the file, to read and append to, locked against other processes and threads."""
    try:
      self.path.parent.mkdir(parents=True, exist_ok=True)
      with self.path.open("a+b") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.seek(0)
        yield file
    except (UnicodeDecodeError, csv.Error) as error:
      raise ConfigError(f"out={self.path} is damaged ({error}): mend it or name another file.") from None
    except OSError as error:
      raise ConfigError(f"out={self.path} cannot be used: {error.strerror}.") from None


def _rows_of(file: BinaryIO) -> Iterable[dict[str, str]]:
  file.seek(0)
  return csv.DictReader(io.StringIO(file.read().decode("utf-8"), newline=""))


def _end_last_row(file: BinaryIO) -> None:
  """Drops an incomplete last row; a row that only lacks its line's end, as editors leave it, gets one."""
  file.seek(0)
  whole, newline, rest = file.read().rpartition(b"\n")
  if rest and len(next(csv.reader([rest.decode("utf-8", "replace")]))) == len(COLUMNS):
    file.write(b"\n")
  elif rest:
    file.truncate(len(whole + newline))


def commit_of(git: Mapping[str, Any] | None) -> str:
  """Returns the column `commit` from `git_state`."""
  return "" if git is None else git["commit"][:7] + "+" * bool(git.get("dirty"))
