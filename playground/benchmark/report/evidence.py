"""What has been measured: rows of all tables, whoever wrote them, and learning curves."""

import csv
import dataclasses
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from playground.benchmark.schema import COLUMNS, QUANTITIES
from playground.errors import ConfigError
from playground.reporting.page import mean_and_ci95
from playground.runs.csv_tracker import OTHER_RETURNS, RETURN

# Tables measured before `playground-bench`: their words for what a row's quantity is, and their columns.
_WORDS = {
  "training steps/s": "training_steps_per_s",
  "command to first update, cold": "start_to_first_update_s",
  "final return": "final_return",
  "peak_gib": "peak_memory_gib",
}
_UNITS = {"training_steps_per_s": "steps/s", "steps": "steps", "peak_memory_gib": "GiB"}
_UNITS |= dict.fromkeys(("return", "mode_return", "best_return", "final_return", "final_mode_return"), "")

Row = dict[str, Any]  # the columns of a row as text, `value` as a number, and `source`: the file


@dataclasses.dataclass(frozen=True)
class Figure:
  """A number with its evidence.

  Attributes:
    mean: over the rows.
    ci95: half the width of the confidence interval over seeds, None from one row.
    rows: what it is the mean of; they agree in all but seed and value.
  """

  mean: float
  ci95: float | None
  rows: tuple[Row, ...]

  def __getitem__(self, column: str) -> str:
    return self.rows[0][column]


class Evidence:
  """All rows and curves below some folders."""

  def __init__(self, folders: Sequence[Path]):
    self.files: list[Path] = []  # those that something was found in
    self.rows: list[Row] = []
    self.curves: dict[str, list[tuple[float, float]]] = {}
    self.mode_curves: dict[str, list[tuple[float, float]]] = {}  # of the policy's mode, where `curves` is of samples
    for path in (path for folder in folders for path in sorted(folder.rglob("*.csv"))):
      lines = _read(path)
      rows, curves = list(_rows(path, lines)), _curves(path, lines, RETURN)
      self.rows += rows
      self.curves |= curves
      self.mode_curves |= _curves(path, lines, OTHER_RETURNS["mode"])
      self.files += [path] * bool(rows or curves)
    self.rows = _once(self.rows)

  def find(self, **wanted: str) -> list[Figure]:
    """Figures of the rows with these columns, a GPU's before a CPU's, then the newest, then the largest."""
    groups: dict[tuple[str, ...], dict[str, Row]] = {}
    for row in self.rows:
      if all(row[name] == text for name, text in wanted.items()):
        same = (str(row["source"]), *(row[name] for name in SAME), row.get("apart", ""))
        groups.setdefault(same, {})[row["seed"]] = row  # measured again: the later one counts
    figures = []
    for rows in groups.values():
      mean, ci95 = mean_and_ci95(row["value"] for row in rows.values())
      figures.append(Figure(mean, ci95, tuple(rows.values())))
    order = lambda f: (f["device"].startswith("CPU"), _before(f["date"]), -f.mean)
    return sorted(figures, key=order)

  def best(self, **wanted: str) -> Figure | None:
    """The first of `find`, None if there is none."""
    return next(iter(self.find(**wanted)), None)


SAME = ("benchmark", "task", "agent", "who", "setting", "quantity", "backend", "devices", "device", "commit")


def _once(rows: Sequence[Row]) -> list[Row]:
  """The rows, without the final return of a run that another file has, too: the schema's stays, else the first.

  Every file has its own words for a run; it is the same one where task, side, steps/s and return agree up to rounding.
  """
  of_run = lambda row: tuple(row.get(name) for name in (*SAME, "source", "seed", "apart") if name != "quantity")
  rates = {of_run(row): row["value"] for row in rows if row["quantity"] == "training_steps_per_s"}
  told: list[tuple[Row, float]] = []
  repeated: set[int] = set()
  for row in sorted((row for row in rows if row["quantity"] == "final_return"), key=lambda row: "apart" in row):
    rate = rates.get(of_run(row), math.nan)  # which is close to none
    if any(_alike(row, other) and math.isclose(rate, its, rel_tol=1e-4) for other, its in told):
      repeated.add(id(row))
    told.append((row, rate))
  return [row for row in rows if id(row) not in repeated]


def _alike(row: Row, other: Row) -> bool:
  """Whether two final returns may be one that two files have."""
  same = row["task"] == other["task"] and (row["who"] == "ours") == (other["who"] == "ours")
  return same and row["source"] != other["source"] and abs(row["value"] - other["value"]) < 0.06


def _before(date: str) -> list[int]:
  """A key that sorts later dates first."""
  return [-ord(character) for character in date] or [0]


def _read(path: Path) -> list[dict[str, str]]:
  """Lines of a CSV, without those that a kill, or a command that is writing them now, left cut short."""
  try:
    with path.open(encoding="utf-8", errors="replace", newline="") as file:
      return [line for line in csv.DictReader(file) if None not in line.values()]
  except (OSError, csv.Error) as error:
    raise ConfigError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}.") from None


def _number(path: Path, text: str) -> float:
  try:
    return float(text)
  except ValueError:
    raise ConfigError(f"{path} has {text!r} where a number belongs: mend or remove that line.") from None


def _rows(path: Path, lines: Sequence[dict[str, str]]) -> Iterable[Row]:
  """Rows of a table in the columns of the schema."""
  if not lines or "task" not in lines[0]:
    return
  for line in lines:
    if None in line:
      raise ConfigError(f"{path} has a line of too many columns, of {line['task']}: mend or remove it.")
    if {"quantity", "value"} <= set(line):
      values = {line["quantity"]: line["value"]}
    else:
      values = {name: line[name] for name in line if _WORDS.get(name, name) in QUANTITIES}
    for quantity, value in values.items():
      quantity = _WORDS.get(quantity, quantity)
      if quantity in QUANTITIES and value:
        yield _row(path, line, quantity, _number(path, value))


def _row(path: Path, line: dict[str, str], quantity: str, value: float) -> Row:
  row: Row = dict.fromkeys(COLUMNS, "") | {name: text for name, text in line.items() if name in COLUMNS}
  row |= {"source": path, "quantity": quantity, "value": value, "unit": row["unit"] or _UNITS.get(quantity, "s")}
  if row["benchmark"]:
    return row
  call, note = line.get("call", ""), line.get("note", "")
  row |= {
    "benchmark": "compare" if "call" in line else "throughput" if "compile_s" in line else "",
    "agent": row["agent"] or "ppo",
    "who": row["who"] or "ours",
    "device": "NVIDIA H200" if "NVIDIA H200" in row["conditions"] else "",
    "devices": "1",
    "conditions": "; ".join(part for part in (note, row["conditions"]) if part),
    "call": call,
    "apart": call or note,  # what sets runs apart that agree in all else
  }
  return row


def _curves(path: Path, lines: Sequence[dict[str, str]], column: str) -> dict[str, list[tuple[float, float]]]:
  """Learning curves of a file, (steps, return in `column`) by name: one a run, where it says which."""
  curves: dict[str, list[tuple[float, float]]] = {}
  if (path.parent.parent / "config.yaml").is_file():  # a stage of a chain, whose own curve has it
    return curves
  if lines and {"step", column} <= set(lines[0]):
    name = path.parent.name if path.stem == "metrics" else path.stem.removeprefix("curve_")
    for line in lines:
      if line[column]:
        point = _number(path, line["step"]), _number(path, line[column])
        curves.setdefault(line.get("run") or name, []).append(point)
  return curves
