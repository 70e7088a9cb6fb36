"""Reads measurements: the rows of all tables, and learning curves."""

import csv
import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from playground.benchmark.schema import COLUMNS, QUANTITIES
from playground.catalog import value_of
from playground.errors import ConfigError
from playground.reporting.page import mean_and_ci95
from playground.runs.csv_tracker import OTHER_RETURNS, RETURN

_POSITIVE = {  # quantities that the report divides by
  *("training_steps_per_s", "env_steps_per_s", "start_to_first_update_s", "seconds_per_step", "wall_clock_s"),
}
_COUNTS = {  # benchmark -> the column, or the keys of its setting, that hold whole numbers
  "topology": ("devices",),
  "together": ("num_agents",),
  "pixels": ("env.vision.width", "env.vision.height", "agent.num_envs"),
  "scaling": ("agent.num_envs",),
}
_LARGEST = 1e9  # of these numbers: a figure's axis has to hold them
_LONGEST = 40  # characters of a wrong number that an error shows
Row = dict[str, Any]  # the columns as text, `value` as a number, the file as `source`, and a run's `note`


@dataclasses.dataclass(frozen=True)
class Figure:
  """A mean of rows, with its confidence interval.

  Attributes:
    mean: mean value of the rows.
    ci95: half the width of the 95 % confidence interval over seeds; None for one row.
    rows: the rows, which differ only in seed and value.
  """

  mean: float
  ci95: float | None
  rows: tuple[Row, ...]

  def __getitem__(self, column: str) -> str:
    return self.rows[0][column]


class Evidence:
  """Reads all rows and curves below some folders."""

  def __init__(self, folders: Sequence[Path]):
    self.files: list[Path] = []  # files with a used row
    self.rows: list[Row] = []
    self.curves: dict[str, list[tuple[float, float]]] = {}
    self.mode_curves: dict[str, list[tuple[float, float]]] = {}  # of the policy's mode, where `curves` is of samples
    for path in (path for folder in folders for path in sorted(folder.rglob("*.csv"))):
      lines = read_lines(path)
      rows, curves = list(_rows(lines, path)), _curves(lines, path, RETURN)
      self.rows += rows
      self.curves |= curves
      self.mode_curves |= _curves(lines, path, OTHER_RETURNS["mode"])
      self.files += [path] * bool(rows or curves)

  def find(self, **wanted: str) -> list[Figure]:
    """Returns figures of the rows with these columns, sorted: GPU before CPU, then the newest, then the largest."""
    groups: dict[tuple[str, ...], dict[str, Row]] = {}
    for row in self.rows:
      if all(row[name] == text for name, text in wanted.items()):
        same = (str(row["source"]), *(row[name] for name in SAME))
        groups.setdefault(same, {})[row["seed"]] = row  # measured again: the later row counts
    figures = []
    for rows in groups.values():
      mean, ci95 = mean_and_ci95(row["value"] for row in rows.values())
      figures.append(Figure(mean, ci95, tuple(rows.values())))
    figures.sort(key=lambda figure: figure.mean, reverse=True)
    figures.sort(key=lambda figure: figure["date"], reverse=True)  # sorting is stable
    return sorted(figures, key=lambda figure: figure["device"].startswith("CPU"))

  def best(self, **wanted: str) -> Figure | None:
    """Returns the first of `find`, None if there is none."""
    return next(iter(self.find(**wanted)), None)


_OF_RUNS = ("experiment", "steps")  # columns of tables of whole runs, which tell runs apart
SAME = (
  *("benchmark", "task", "agent", "who", "setting", "quantity", "backend", "devices", "device"),
  *("precision", "versions", "commit", "note", *_OF_RUNS),
)


def read_lines(path: Path) -> dict[str, dict[str, str]]:
  """Reads the rows of a CSV, without incomplete ones, by where each stands (`<path>, line <number>`)."""
  try:
    with path.open(encoding="utf-8", errors="replace", newline="") as file:
      reader = csv.DictReader(file)
      return {f"{path}, line {reader.line_num}": line for line in reader if None not in line.values()}
  except (OSError, csv.Error) as error:
    raise ConfigError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}.") from None


def number(where: str, name: str, text: str, positive: bool = False) -> float:
  """Returns the number `name` of the row that stands at `where`; raises ConfigError for text, NaN and infinity."""
  try:
    value = float(text)
  except ValueError:
    value = math.nan
  if not math.isfinite(value) or (positive and value <= 0):
    kind = "a number above 0" if positive else "a number"
    raise ConfigError(f"{where} has {name}={_short(text)}, which must be {kind}: mend or remove that line.")
  return value


def _short(text: str) -> str:
  return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


def _rows(lines: Mapping[str, dict[str, str]], path: Path) -> Iterable[Row]:
  """Yields rows of a table in the columns of the schema; a table of whole runs has a column for each quantity."""
  for where, line in lines.items():
    if "task" not in line:
      return
    if None in line:
      raise ConfigError(f"{where} has too many columns: mend or remove it.")
    one = {"quantity", "value"} <= set(line)
    known = {name: line.get(name, "") for name in (*COLUMNS, "note")}
    known |= {name: "" if one else line.get(name, "") for name in _OF_RUNS}
    values = {line["quantity"]: line["value"]} if one else line
    for quantity in QUANTITIES:
      if value := values.get(quantity):
        measured = number(where, quantity, value, quantity in _POSITIVE)
        row = {**known, "source": path, "quantity": quantity, "value": measured}
        _check(where, row)
        yield row


def _check(where: str, row: Row) -> None:
  """Raises ConfigError for a row without the numbers, besides its value, that the section on its benchmark shows."""
  setting = row["setting"]
  for key in _COUNTS.get(row["benchmark"], ()):
    text = row[key] if key in row else value_of(setting, key)
    if not text.isdecimal() or not 1 <= float(text) <= _LARGEST:
      what = f"{key}={_short(text)}, which must be a whole number from 1 to {_LARGEST:,.0f} for {row['benchmark']}"
      raise ConfigError(f"{where} has {what}: mend or remove that line.")
  if row["quantity"] in ("return", "mode_return") and "step=" in setting:
    number(where, "step", setting.rpartition("step=")[2])


def _curves(lines: Mapping[str, dict[str, str]], path: Path, column: str) -> dict[str, list[tuple[float, float]]]:
  """Returns learning curves of a file, (steps, return in `column`) by name, one for each run.

  A return of NaN counts as not measured, as an empty one: metrics.csv of a run may have it.
  """
  curves: dict[str, list[tuple[float, float]]] = {}
  if (path.parent.parent / "config.yaml").is_file():  # a stage of a chain; the chain's curve includes it
    return curves
  name = path.parent.name if path.stem == "metrics" else path.stem.removeprefix("curve_")
  for where, line in lines.items():
    if "step" in line and line.get(column, "").lower() not in ("", "nan"):
      point = number(where, "step", line["step"]), number(where, column, line[column])
      curves.setdefault(line.get("run") or name, []).append(point)
  return curves
