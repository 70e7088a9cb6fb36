"""Writes the result of a sweep: rows of jobs, mean and confidence interval of each group of seeds, curves, a page."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.markup import escape
from rich.table import Table as ConsoleTable

from playground.console import wide_console
from playground.files import replacing, write_text
from playground.reporting.page import (
  Block,
  Heading,
  Image,
  Link,
  Table,
  Text,
  mean_and_ci95,
  short,
  t_factor,
  to_html,
)
from playground.runs.csv_tracker import RETURN, STAGE, read_metrics
from playground.sweep.folder import FAILED, SweepDirectory

if TYPE_CHECKING:
  import numpy as np
  import pandas as pd

AVERAGED = ("final_return", "final_mode_return", "best_return", "steps_per_second", "wall_clock_s")
FIGURES = (*AVERAGED, "final_sampled_return", "steps")  # of a run's summary.json
SEED = "seed"  # jobs of a group differ in the seed
PANEL = "env"  # returns of tasks are not comparable, so each task has its own panel
POINTS = 200  # of a mean curve
AXES = {  # file -> (column, its unit in the drawing, label)
  "curves_over_steps.png": ("step", 1e6, "million environment steps"),
  "curves_over_wall_clock.png": ("time/wall_clock_s", 1.0, "wall-clock time (s)"),
}


def write_result(sweep: SweepDirectory, notify: Callable[[str], None] = print) -> list[Path]:
  """Writes sweep.csv, groups.csv, curves and report.html from the jobs' present files; returns the files written."""
  jobs = collect(sweep)
  groups = group(jobs, group_keys(sweep))
  files = [sweep.path / "sweep.csv", sweep.path / "groups.csv"]
  for path, table in zip(files, (jobs, groups), strict=True):
    write_text(path, table.to_csv(index=False))
  curves = _write_curves(sweep)
  page = sweep.path / "report.html"
  write_text(page, to_html(_page(sweep, jobs, groups, curves), sweep.name))
  if len(groups):
    header, rows = _group_rows(groups)
    shown = ConsoleTable(*header, title="mean ± 95 % confidence interval")
    for row in rows:
      shown.add_row(*map(escape, row))
    wide_console().print(shown)
  files += [*curves, page]
  notify(f"Result of {sweep.path}: {', '.join(str(path.relative_to(sweep.path)) for path in files)}")
  return files


def collect(sweep: SweepDirectory) -> "pd.DataFrame":
  """Returns a row for each job: overrides, status, and figures of its summary (empty without one)."""
  import pandas as pd

  rows = []
  for job in sweep.jobs:
    folder = sweep.folder(job)
    state, summary = folder.state(), folder.run.summary
    row: dict[str, object] = {"job": job.name, **job.varies, "status": state.status}
    row |= {key: summary.get(key) for key in FIGURES}
    row |= {"attempts": state.attempt, "reason": state.reason, "overrides": " ".join(job.overrides)}
    rows.append(row)
  keys = list(dict.fromkeys(key for job in sweep.jobs for key in job.varies))
  columns = ["job", *keys, "status", *FIGURES, "attempts", "reason", "overrides"]
  return pd.DataFrame(rows, columns=pd.Index(columns), dtype=object)  # else a key that some jobs lack turns 5 into 5.0


def group_keys(sweep: SweepDirectory) -> list[str]:
  """Returns the keys in which jobs differ, without the seed."""
  return [key for key in dict.fromkeys(k for job in sweep.jobs for k in job.varies) if key != SEED]


def group(jobs: "pd.DataFrame", keys: Sequence[str]) -> "pd.DataFrame":
  """Returns a row for each group of finished jobs that differ in the seed only.

  Args:
    jobs: from `collect`.
    keys: the keys in which groups differ; without keys there is one group.

  Returns:
    The keys, `jobs` (how many finished), and for each figure its mean and `<figure>_ci95`, half the width of the 95 %
    confidence interval (Student's t; empty for a single job).
  """
  import pandas as pd

  finished = jobs[jobs["status"] == "finished"]
  by = [finished[key].map(_label) for key in keys] or [pd.Series("all", finished.index, name="jobs of")]
  rows = []
  for labels, part in finished.groupby(by, sort=False, dropna=False):
    named = zip(keys or ["jobs of"], labels, strict=True)  # pyright: ignore[reportArgumentType]
    row: dict[str, object] = {**dict(named), "jobs": len(part)}
    for name in AVERAGED:
      values = part[name].dropna().to_list()
      row[name], row[f"{name}_ci95"] = mean_and_ci95(values) if values else (None, None)
    rows.append(row)
  columns = [*(keys or ["jobs of"]), "jobs", *(c for name in AVERAGED for c in (name, f"{name}_ci95"))]
  return pd.DataFrame(rows, columns=pd.Index(columns))


def mean_curve(curves: "Sequence[tuple[np.ndarray, np.ndarray]]") -> "tuple[np.ndarray, np.ndarray, np.ndarray]":
  """Returns mean and half-width of the confidence interval of several curves, over their common range.

  Args:
    curves: (x, y) of each, x ascending.

  Returns:
    x, mean and half-width, [POINTS]; the half-width of a single curve is 0.
  """
  import numpy as np

  low, high = max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves)
  grid = np.linspace(min(low, high), high, POINTS)  # over time, a job may end before another's first evaluation
  values = np.stack([np.interp(grid, x, y) for x, y in curves])
  half = t_factor(len(curves)) * values.std(axis=0, ddof=1) if len(curves) > 1 else np.zeros(POINTS)
  return grid, values.mean(axis=0), half


def _write_curves(sweep: SweepDirectory) -> list[Path]:
  """Draws mean evaluation returns with their 95 % confidence bands over seeds; returns the files written.

  The curve of a chain is that of the stages that train its last task.
  The curve of a group is that of its finished jobs, if there are any: one that failed early would cut it off.
  """
  from playground.reporting.figures import Curve, curves

  keys = [key for key in group_keys(sweep) if key != PANEL]
  tables: dict[str, dict[str, list[tuple[bool, pd.DataFrame]]]] = defaultdict(lambda: defaultdict(list))
  for job in sweep.jobs:
    folder = sweep.folder(job)
    table = read_metrics(folder.path / "metrics.csv")
    if STAGE in table and (stages := (summary := folder.run.summary).get("stages")):
      table = table.loc[table[STAGE].isin([s["name"] for s in stages if s.get("env") == summary.get("env")])]
    if RETURN in table and len(table := table.dropna(subset=[RETURN])):
      name = ", ".join(f"{key.split('.')[-1]}={_label(job.varies.get(key))}" for key in keys)
      task = job.task or str(job.varies.get(PANEL, sweep.name))
      tables[task][name or "mean"].append((folder.state().status == "finished", table))
  written = []
  for file, (column, unit, label) in AXES.items() if tables else ():
    panels: dict[str, dict[str, Curve]] = {}
    for task, groups in tables.items():
      finished = {name: [t for done, t in some if done] or [t for _, t in some] for name, some in groups.items()}
      lines = {name: [_line(t, column, unit) for t in some if column in t] for name, some in finished.items()}
      means = {name: mean_curve(some) for name, some in lines.items() if some}
      panels[task] = {name: Curve(*(axis.tolist() for axis in mean)) for name, mean in means.items()}
    path = sweep.path / "plots" / file
    path.parent.mkdir(exist_ok=True)
    with replacing(path) as temporary:
      temporary.write_bytes(curves(panels, label, "evaluation return", "png"))
    written.append(path)
  return written


def _line(table: "pd.DataFrame", column: str, unit: float) -> "tuple[np.ndarray, np.ndarray]":
  return table[column].to_numpy(float) / unit, table[RETURN].to_numpy(float)


def _page(
  sweep: SweepDirectory, jobs: "pd.DataFrame", groups: "pd.DataFrame", curves: Sequence[Path]
) -> list[Block]:  # fmt: skip
  counts = ", ".join(f"{count} {status}" for status, count in jobs["status"].value_counts().items())
  failed = jobs[jobs["status"].isin(FAILED)]
  blocks: list[Block] = [Heading(1, sweep.name), Text(f"`{' '.join(sweep.command)}`")]
  blocks.append(Text(f"{len(jobs)} jobs: {counts}."))
  if len(failed):
    reasons = [[_job_link(job), reason] for job, reason in zip(failed["job"], failed["reason"], strict=True)]
    blocks += [Heading(2, "What failed"), Table(["job", "reason"], reasons)]
  if len(groups):
    mean = (
      "Mean ± 95 % confidence interval over seeds (Student's t), finished jobs. `final return`, `best return` and the "
      "curves are of `eval/episode_reward`, where the policy acts as `agent.deterministic_eval` says; in `final mode "
      "return` it acts by its mode."
    )
    blocks += [Heading(2, "Groups"), Text(mean), Table(*_group_rows(groups))]
  blocks += [Image(path.stem, path.read_bytes(), "") for path in curves]
  columns = [name for name in jobs.columns if name != "overrides"]
  rows = [[_text(value) for value in row] for row in jobs[columns].to_numpy(object).tolist()]
  rows = [[_job_link(job), *rest] for job, *rest in rows]
  return [*blocks, Heading(2, "Jobs"), Table([name.replace("_", " ") for name in columns], rows)]


def _job_link(job: str) -> Link:
  return Link(job, f"jobs/{job}/")


def _group_rows(groups: "pd.DataFrame") -> tuple[list[str], list[list[str]]]:
  """Returns header and rows of the groups: mean ± half the interval."""
  keys = list(groups.columns)[: list(groups.columns).index("jobs") + 1]
  rows = []
  for _, row in groups.iterrows():
    pairs = ((_text(row[name]), _text(row[f"{name}_ci95"])) for name in AVERAGED)
    rows.append([*(str(row[key]) for key in keys), *(f"{mean} ± {half}" if half else mean for mean, half in pairs)])
  return [*keys, *(name.replace("_", " ") for name in AVERAGED)], rows


def _text(value: object) -> str:
  if value is None or value != value:
    return ""
  return short(value) if isinstance(value, float | int) and not isinstance(value, bool) else str(value)


def _label(value: object) -> str:
  return "null" if value is None or value != value else str(value)
