"""Writes and reads metrics.csv: one row for each call of `log`, complete on disk when `log` returns."""

import csv
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TextIO

from playground.files import csv_text, keep_copy, write_text

if TYPE_CHECKING:
  import pandas as pd

_STEP = re.compile(r"[0-9]{1,18}")
STAGE = "stage"  # the one column of text, in a chain's metrics.csv
RETURN = "eval/episode_reward"  # of the actions that `agent.deterministic_eval` chooses
OTHER_RETURNS = {"mode": "eval/mode/episode_reward", "sampled": "eval/sampled/episode_reward"}  # of the other kind


class Table(NamedTuple):
  """The content of a metrics.csv.

  Attributes:
    columns: names of the columns; the first is `step`.
    rows: cells by column; a cell that is not a number is ''.
    torn: whether the last line is incomplete, as after a SIGKILL; `rows` omits this line.
    damage: description of any other damage, '' if there is none.
  """

  columns: list[str]
  rows: list[dict[str, str]]
  torn: bool
  damage: str


class CsvTracker:
  """Appends rows to a CSV file whose first column is `step` and whose other columns grow as metrics appear.

  An existing file is continued. A half-written last row (SIGKILL) is dropped. A file with other damage is renamed to
  `metrics_damaged.csv`, and its readable rows are written to a new file.

  Args:
    path: the file.
    columns: names of the columns at the checkpoint that the run continues from; the header may be damaged.
    notify: takes one sentence about a damaged file.
  """

  def __init__(self, path: Path, columns: Sequence[str] = (), notify: Callable[[str], None] = print):
    self._path = path
    self._file: TextIO | None = None
    self._columns = list(columns) or ["step"]
    if path.is_file():
      table = read_table(path, columns)
      self._columns = table.columns
      if table.damage:
        aside = keep_copy(path, f"{path.stem}_damaged")
        notify(f"{path} is damaged ({table.damage}): it is kept as {aside.name}, {len(table.rows)} rows are rebuilt.")
      if table.damage or table.torn:
        self._rewrite(table.rows)

  @property
  def columns(self) -> list[str]:
    """Returns the names of the columns so far."""
    return list(self._columns)

  def log(self, step: int, metrics: dict[str, float]) -> None:
    if "step" in metrics:
      raise ValueError("a metric cannot be called 'step': that is the first column of metrics.csv")
    new = [name for name in metrics if name not in self._columns]
    if new or not self._path.exists():
      rows = self._rows()
      self._columns += new
      self._rewrite(rows)
    if self._file is None:
      self._file = self._path.open("a", encoding="utf-8", newline="")
    # float() first: NumPy scalars print as 'np.float32(0.1)' or at lower precision.
    row = {"step": str(int(step))} | {name: repr(float(value)) for name, value in metrics.items()}
    self._file.write(csv_text(self._columns, [row]))
    self._file.flush()

  def truncate_after(self, step: int) -> int:
    """Drops, atomically, every row whose step is larger than `step`; returns the last remaining step, or -1."""
    if not self._path.is_file():
      return -1
    rows = [row for row in self._rows() if int(row["step"]) <= step]
    self._rewrite(rows)
    return int(rows[-1]["step"]) if rows else -1

  def close(self, status: str = "finished") -> None:
    if self._file is not None:
      self._file.close()
      self._file = None

  def _rows(self) -> list[dict[str, str]]:
    return read_table(self._path, self._columns).rows if self._path.exists() else []

  def _rewrite(self, rows: list[dict[str, str]]) -> None:
    self.close()
    write_text(self._path, csv_text(self._columns, rows, header=True))


def read_metrics(path: Path) -> "pd.DataFrame":
  """Reads a metrics.csv: `step` as integers, the other columns as numbers; empty without a file."""
  import pandas as pd

  table = read_table(path) if path.is_file() else Table(["step"], [], False, "")
  frame = pd.DataFrame(table.rows, columns=pd.Index(table.columns), dtype=str)
  kinds = {name: int if name == "step" else float for name in table.columns if name != STAGE}
  return frame.replace("", "nan").astype(kinds)


def newest_evaluation(path: Path, step: int) -> dict[str, Any] | None:
  """Returns the last row of a metrics.csv up to `step` that has an evaluation, None without one."""
  table = read_metrics(path)
  if RETURN not in table:
    return None
  evaluated = table[(table["step"] <= step) & table[RETURN].notna()]
  return evaluated.iloc[-1].to_dict() if len(evaluated) else None


def read_table(path: Path, known: Sequence[str] = ()) -> Table:
  """Reads the undamaged rows of a metrics.csv.

  Every row is parsed as a line of numbers, so a stray quote damages only its cell.

  Args:
    path: the file.
    known: names of the first columns, which override the header; empty if unknown.
  """
  content, newline, rest = path.read_bytes().decode("utf-8", errors="replace").rpartition("\n")
  if not newline:
    return Table(list(known) or ["step"], [], bool(rest), "")
  header, *lines = content.split("\n")
  names, damage = _split(header), ""
  headless = _STEP.fullmatch(names[0]) is not None
  if headless:
    names, lines, damage = [], [header, *lines], "its header is missing"
  columns = _unique([*(known or ["step"]), *names[max(len(known), 1) :]])
  if not headless and f"{header}\n" != csv_text(columns, [], header=True):
    damage = "its header has changed"
  rows = []
  for line in lines:
    cells = line.split(",")
    if headless:  # the names of columns after the known ones are lost
      cells = cells[: len(columns)]
    values = [text if name == STAGE else _number(text) for name, text in zip(columns, cells, strict=False)]
    if len(cells) == len(columns) and _STEP.fullmatch(values[0]):
      rows.append(dict(zip(columns, values, strict=True)))
      intact = cells == values
    else:
      intact = False
    damage = damage or ("" if intact else "a line has changed")
  return Table(columns, rows, bool(rest), damage)


def _number(text: str) -> str:
  """Returns the text of a number without quotes; '' if the text is no number."""
  text = text.strip("\"' \r\ufeff")
  try:
    float(text)
  except ValueError:
    return ""
  return text


def _split(line: str) -> list[str]:
  try:
    return next(csv.reader([line]), [""]) or [""]
  except csv.Error:
    return [line]


def _unique(names: Sequence[str]) -> list[str]:
  """Returns the names; a repeated one gets a number."""
  return [name if name not in names[:i] else f"{name} ({i})" for i, name in enumerate(names)]
