"""What came out of a sweep: a row for each job, mean and confidence interval for each group of seeds."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from playground.runs.files import write_text
from playground.sweep.folder import SweepDirectory

if TYPE_CHECKING:
  import pandas as pd

FIGURES = ("final_return", "best_return", "steps", "steps_per_second", "wall_clock_s")  # of a run's summary.json
AVERAGED = ("final_return", "best_return", "steps_per_second", "wall_clock_s")
SEED = "seed"  # what jobs of one group differ in
CONFIDENCE = 0.95


def write_result(sweep: SweepDirectory, notify: Callable[[str], None] = print) -> list[Path]:
  """Writes sweep.csv, groups.csv, the curves and report.html from what jobs have left so far; returns the files."""
  from playground.sweep.report import write_curves, write_report

  jobs, groups = collect(sweep), None
  groups = group(jobs, group_keys(sweep))
  files = [sweep.path / "sweep.csv", sweep.path / "groups.csv"]
  for path, table in zip(files, (jobs, groups), strict=True):
    write_text(path, table.to_csv(index=False))
  curves = write_curves(sweep)
  files += [*curves, write_report(sweep, jobs, groups, curves)]
  if len(groups):
    Console().print(as_table(groups))
  notify(f"Result of {sweep.path}: {', '.join(str(path.relative_to(sweep.path)) for path in files)}")
  return files


def collect(sweep: SweepDirectory) -> "pd.DataFrame":
  """A row for each job: its overrides, how it stands, and what its summary says (empty where there is none)."""
  import pandas as pd

  rows = []
  for job in sweep.jobs:
    folder = sweep.folder(job)
    state, summary = folder.state(), folder.run.summary
    row: dict[str, Any] = {"job": job.name, **job.varies, "status": state.status}
    row |= {key: summary.get(key) for key in FIGURES}
    row |= {"attempts": state.attempt, "reason": state.reason, "overrides": " ".join(job.overrides)}
    rows.append(row)
  keys = list(dict.fromkeys(key for job in sweep.jobs for key in job.varies))
  columns = ["job", *keys, "status", *FIGURES, "attempts", "reason", "overrides"]
  return pd.DataFrame(rows, columns=pd.Index(columns))


def group_keys(sweep: SweepDirectory) -> list[str]:
  """What jobs differ in besides the seed."""
  return [key for key in dict.fromkeys(k for job in sweep.jobs for k in job.varies) if key != SEED]


def group(jobs: "pd.DataFrame", keys: Sequence[str]) -> "pd.DataFrame":
  """A row for each group of finished jobs that differ in their seed only.

  Args:
    jobs: from `collect`.
    keys: what tells groups apart; none is one group.

  Returns:
    The keys, `jobs` (how many finished), and for each figure its mean and `<figure>_ci95`, half the width of the 95 %
    confidence interval (Student's t; empty for a single job).
  """
  import pandas as pd

  finished = jobs[jobs["status"] == "finished"]
  by = [finished[key].map(_label) for key in keys] or [pd.Series("all", finished.index, name="jobs of")]
  rows = []
  labels: Any
  for labels, part in finished.groupby(by, sort=False, dropna=False):
    row: dict[str, Any] = {**dict(zip(keys or ["jobs of"], labels, strict=True)), "jobs": len(part)}
    for name in AVERAGED:
      values = part[name].dropna().to_numpy(float)
      row[name], row[f"{name}_ci95"] = float(values.mean()) if len(values) else None, half_width(values)
    rows.append(row)
  columns = [*(keys or ["jobs of"]), "jobs", *(c for name in AVERAGED for c in (name, f"{name}_ci95"))]
  return pd.DataFrame(rows, columns=pd.Index(columns))


def half_width(values: Sequence[float] | Any) -> float | None:
  """Half the width of the confidence interval of the mean of independent values; None for fewer than two."""
  import numpy as np
  from scipy.stats import t

  values = np.asarray(values, float)
  if len(values) < 2:
    return None
  return float(t.ppf((1 + CONFIDENCE) / 2, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values)))


def as_table(groups: "pd.DataFrame") -> Table:
  """The groups for a terminal: mean ± half the interval."""
  columns = list(groups.columns)
  keys = columns[: columns.index("jobs")]
  table = Table(title="mean ± 95 % confidence interval")
  for name in (*keys, "jobs", *AVERAGED):
    table.add_column(name.replace("_", " ") if name in AVERAGED else name, no_wrap=name in keys)
  for _, row in groups.iterrows():
    cells = [with_interval(row[name], row[f"{name}_ci95"]) for name in AVERAGED]
    table.add_row(*(str(row[key]) for key in keys), str(row["jobs"]), *cells)
  return table


def with_interval(mean: Any, half: Any) -> str:
  """'12.3 ± 0.4', as far as there are numbers."""
  import pandas as pd

  if pd.isna(mean):
    return ""
  digits = lambda x: f"{x:,.0f}" if abs(x) >= 1000 else f"{x:.4g}"
  return digits(mean) if pd.isna(half) else f"{digits(mean)} ± {digits(half)}"


def _label(value: Any) -> str:
  return "null" if value is None or value != value else str(value)
