"""Curves with bands, and one page that holds the whole result of a sweep."""

import base64
import html
import math
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from playground.runs.csv_tracker import read_metrics
from playground.runs.files import replacing, write_text
from playground.sweep.folder import FAILED, Job, SweepDirectory
from playground.sweep.results import AVERAGED, CONFIDENCE, group_keys, with_interval

if TYPE_CHECKING:
  import pandas as pd

AXES = {  # file -> (column, label)
  "curves_over_steps.png": ("step", "environment steps"),
  "curves_over_wall_clock.png": ("time/wall_clock_s", "wall-clock time (s)"),
}
PANEL = "env"  # tasks are not paid alike: each has a panel of its own
POINTS = 200  # of a mean curve
LINES = 10  # groups of one panel that have a colour


def write_curves(sweep: SweepDirectory) -> list[Path]:
  """Draws mean evaluation returns with their 95 % confidence bands over seeds; returns the files written."""
  keys = group_keys(sweep)
  panels: dict[str, dict[str, list[pd.DataFrame]]] = defaultdict(lambda: defaultdict(list))
  for job in sweep.jobs:
    if (table := _metrics(sweep, job)) is not None:
      words = [f"{key.split('.')[-1]}={job.varies.get(key)}" for key in keys if key != PANEL]
      panels[str(job.varies.get(PANEL, sweep.name))][", ".join(words)].append(table)
  written = []
  folder = sweep.path / "plots"
  for name, (column, label) in AXES.items():
    if panels:
      folder.mkdir(exist_ok=True)
      with replacing(folder / name) as temporary:
        _draw(panels, column, label, temporary)
      written.append(folder / name)
  return written


def mean_curve(curves: "list[tuple[np.ndarray, np.ndarray]]") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Mean and half-width of the confidence interval of several curves, over the stretch that all of them have.

  Args:
    curves: (x, y) of each, x ascending.

  Returns:
    x, mean and half-width, [POINTS]; the half-width of a single curve is 0.
  """
  from scipy.stats import t

  low, high = max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves)
  if low > high:  # over time, a job may have ended before another's first evaluation
    low = high
  grid = np.linspace(low, high, POINTS)
  values = np.stack([np.interp(grid, x, y) for x, y in curves])
  count = len(curves)
  factor = t.ppf((1 + CONFIDENCE) / 2, count - 1) / math.sqrt(count) if count > 1 else 0.0
  return grid, values.mean(axis=0), factor * (values.std(axis=0, ddof=1) if count > 1 else np.zeros(POINTS))


def _metrics(sweep: SweepDirectory, job: Job) -> "pd.DataFrame | None":
  """A job's evaluations; None if it has none."""
  table = read_metrics(sweep.folder(job).path / "metrics.csv")
  if "eval/episode_reward" not in table:
    return None
  table = table.dropna(subset=["eval/episode_reward"])
  return table if len(table) else None


def _draw(panels: "dict[str, dict[str, list[pd.DataFrame]]]", column: str, label: str, path: Path) -> None:
  from matplotlib.figure import Figure
  from matplotlib.ticker import EngFormatter

  columns = min(len(panels), 4)
  rows = -(-len(panels) // columns)
  figure = Figure(figsize=(max(6.0, 3.8 * columns), 3.0 * rows + 0.8), layout="constrained")
  axes: Any = figure.subplots(rows, columns, squeeze=False)
  colors: dict[str, str] = {}
  for place, (title, groups) in zip(axes.flat, panels.items(), strict=False):
    for words, tables in groups.items():
      color = colors.setdefault(words, f"C{len(colors)}" if len(colors) < LINES else "0.6")
      curves = [(t[column].to_numpy(float), t["eval/episode_reward"].to_numpy(float)) for t in tables if column in t]
      if not curves:
        continue
      x, mean, half = mean_curve(curves)
      place.fill_between(x, mean - half, mean + half, color=color, alpha=0.2, linewidth=0)
      place.plot(x, mean, color=color, linewidth=1.6, label=words or "mean")
    place.set_title(title, fontsize=10)
    place.xaxis.set_major_formatter(EngFormatter(sep=""))
    place.grid(color="0.9")
    place.spines[["top", "right"]].set_visible(False)
  for place in list(axes.flat)[len(panels) :]:
    place.set_visible(False)
  figure.supxlabel(label, fontsize=10)
  figure.supylabel("evaluation return", fontsize=10)
  if any(colors):
    handles = {text: handle for a in axes.flat for handle, text in zip(*a.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=3, frameon=False, fontsize=8)
  figure.savefig(path, dpi=130)


_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 75rem; padding: 0 1rem; color: #222 }
table { border-collapse: collapse; font-size: 13px; margin: 1rem 0 } td, th { padding: .25rem .7rem; text-align: left }
th { border-bottom: 1px solid #999 } tr:nth-child(even) { background: #f5f5f5 } td.n { text-align: right }
code { background: #f0f0f0; padding: .1rem .3rem } img { max-width: 100% } .finished { color: #176b2c }
.failed, .timeout, .killed { color: #b00020 } .wide { overflow-x: auto }
"""


def write_report(sweep: SweepDirectory, jobs: "pd.DataFrame", groups: "pd.DataFrame", curves: list[Path]) -> Path:
  """Writes report.html, which needs no other file; returns its path."""
  counts = ", ".join(f"{count} {status}" for status, count in jobs["status"].value_counts().items())
  failed = jobs[jobs["status"].isin(FAILED)]
  parts = [
    f"<!doctype html><html lang=en><meta charset=utf-8><title>{_safe(sweep.name)}</title><style>{_STYLE}</style>",
    f"<h1>{_safe(sweep.name)}</h1><p><code>{_safe(' '.join(sweep.command))}</code></p>",
    f"<p>{len(jobs)} jobs: {_safe(counts)}.</p>",
  ]
  if len(failed):
    rows = "".join(f"<li><b>{_safe(row['job'])}</b> {_safe(row['reason'])}" for _, row in failed.iterrows())
    parts.append(f"<h2>What failed</h2><ul>{rows}</ul>")
  if len(groups):
    parts.append("<h2>Groups</h2><p>Mean ± 95 % confidence interval over seeds (Student's t), finished jobs.</p>")
    parts.append(_groups_html(groups))
  for path in curves:
    image = base64.b64encode(path.read_bytes()).decode()
    parts.append(f'<p><img alt="{_safe(path.stem)}" src="data:image/png;base64,{image}"></p>')
  parts.append(f"<h2>Jobs</h2>{_jobs_html(jobs)}</html>")
  out = sweep.path / "report.html"
  write_text(out, "\n".join(parts))
  return out


def _groups_html(groups: "pd.DataFrame") -> str:
  columns = list(groups.columns)
  keys = columns[: columns.index("jobs") + 1]
  head = "".join(f"<th>{_safe(name)}" for name in (*keys, *(name.replace("_", " ") for name in AVERAGED)))
  body = ""
  for _, row in groups.iterrows():
    body += "<tr>" + "".join(f"<td>{_safe(row[key])}" for key in keys)
    body += "".join(f"<td class=n>{with_interval(row[name], row[f'{name}_ci95'])}" for name in AVERAGED)
  return f"<div class=wide><table><tr>{head}{body}</table></div>"


def _jobs_html(jobs: "pd.DataFrame") -> str:
  columns = [name for name in jobs.columns if name != "overrides"]
  body = ""
  for _, row in jobs.iterrows():
    body += f"<tr title='{_safe(row['overrides'])}'>"
    for name in columns:
      value = row[name]
      number = isinstance(value, float | int) and not isinstance(value, bool)
      text = with_interval(value, None) if number else _safe("" if value is None else value)
      if name == "job":
        text = f'<a href="jobs/{_safe(value)}/">{text}</a>'
      body += f"<td class='{_safe(value) if name == 'status' else 'n' if number else ''}'>{text}"
  head = "".join(f"<th>{_safe(name.replace('_', ' '))}" for name in columns)
  return f"<div class=wide><table><tr>{head}{body}</table></div>"


def _safe(text: Any) -> str:
  return html.escape(str(text))
