"""Reads measurements: the rows of all tables, and learning curves."""

import csv
import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from playground.benchmark.schema import COLUMNS, QUANTITIES
from playground.errors import ConfigError
from playground.reporting.page import mean_and_ci95
from playground.runs.csv_tracker import OTHER_RETURNS, RETURN

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
      lines = _read(path)
      rows, curves = list(_rows(path, lines)), _curves(path, lines, RETURN)
      self.rows += rows
      self.curves |= curves
      self.mode_curves |= _curves(path, lines, OTHER_RETURNS["mode"])
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


SAME = (
  *("benchmark", "task", "agent", "who", "setting", "quantity", "backend", "devices", "device"),
  *("precision", "versions", "commit", "note"),
)


def _read(path: Path) -> list[dict[str, str]]:
  """Reads the rows of a CSV, without incomplete ones."""
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
  """Yields rows of a table in the columns of the schema; a table of whole runs has a column for each quantity."""
  if not lines or "task" not in lines[0]:
    return
  for line in lines:
    if None in line:
      raise ConfigError(f"{path} has a line of too many columns, of {line['task']}: mend or remove it.")
    known = {name: line.get(name, "") for name in (*COLUMNS, "note")}
    values = {line["quantity"]: line["value"]} if {"quantity", "value"} <= set(line) else line
    for quantity in QUANTITIES:
      if value := values.get(quantity):
        yield {**known, "source": path, "quantity": quantity, "value": _number(path, value)}


def _curves(path: Path, lines: Sequence[dict[str, str]], column: str) -> dict[str, list[tuple[float, float]]]:
  """Returns learning curves of a file, (steps, return in `column`) by name, one for each run."""
  curves: dict[str, list[tuple[float, float]]] = {}
  if (path.parent.parent / "config.yaml").is_file():  # a stage of a chain; the chain's curve includes it
    return curves
  if lines and {"step", column} <= set(lines[0]):
    name = path.parent.name if path.stem == "metrics" else path.stem.removeprefix("curve_")
    for line in lines:
      if line[column]:
        point = _number(path, line["step"]), _number(path, line[column])
        curves.setdefault(line.get("run") or name, []).append(point)
  return curves
