"""metrics.csv: one row a log call, complete on disk as soon as `log` returns."""

import csv
import io
from pathlib import Path
from typing import TextIO

from playground.runs.files import write_text


class CsvTracker:
  """Appends rows to a CSV file whose first column is `step` and whose other columns grow as metrics appear.

  A file that is already there is continued; what a SIGKILL left of a half-written last row is dropped.
  """

  def __init__(self, path: Path):
    self._path = path
    self._columns = ["step"]
    self._file: TextIO | None = None
    if path.is_file():
      rows, torn = self._read()
      if torn:
        self._rewrite(rows)

  def log(self, step: int, metrics: dict[str, float]) -> None:
    if "step" in metrics:
      raise ValueError("a metric cannot be called 'step': that is the first column of metrics.csv")
    new = [name for name in metrics if name not in self._columns]
    if new or not self._path.exists():
      rows, _ = self._read() if self._path.exists() else ([], False)
      self._columns += new
      self._rewrite(rows)
    if self._file is None:
      self._file = self._path.open("a", encoding="utf-8", newline="")
    # float() first: NumPy scalars print as 'np.float32(0.1)' or at lower precision.
    row = {"step": str(int(step))} | {name: repr(float(value)) for name, value in metrics.items()}
    self._file.write(self._text([row]))
    self._file.flush()

  def truncate_after(self, step: int) -> None:
    """Drops, atomically, every row whose step is larger than `step`."""
    if self._path.is_file():
      rows, _ = self._read()
      self._rewrite([row for row in rows if int(row["step"]) <= step])

  def close(self, status: str = "finished") -> None:
    if self._file is not None:
      self._file.close()
      self._file = None

  def _read(self) -> tuple[list[dict[str, str]], bool]:
    """Returns the file's whole rows, and whether there was a torn one; takes over the file's columns."""
    whole, newline, rest = self._path.read_text(encoding="utf-8", errors="replace").rpartition("\n")
    reader = csv.DictReader(io.StringIO(whole + newline))
    if reader.fieldnames and reader.fieldnames[0] == "step":
      self._columns = list(reader.fieldnames)
    lines = list(reader)
    rows = [row for row in lines if (row.get("step") or "").isdecimal() and None not in row.values()]
    return rows, bool(rest) or len(rows) < len(lines)

  def _rewrite(self, rows: list[dict[str, str]]) -> None:
    self.close()
    write_text(self._path, self._text([dict(zip(self._columns, self._columns, strict=True)), *rows]))

  def _text(self, rows: list[dict[str, str]]) -> str:
    buffer = io.StringIO()
    csv.DictWriter(buffer, self._columns, restval="", lineterminator="\n").writerows(rows)
    return buffer.getvalue()
