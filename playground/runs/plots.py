"""Draws the learning curves of a run or chain from its metrics.csv."""

from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from playground.files import replacing
from playground.runs.csv_tracker import OTHER_RETURNS, RETURN, read_metrics

if TYPE_CHECKING:
  import pandas as pd

_AXES = {  # file name -> (column, its label)
  "return_over_steps.png": ("step", "environment steps"),
  "return_over_wall_clock.png": ("time/wall_clock_s", "wall-clock time"),
}


def plot_learning_curve(metrics_csv: str | Path, out_dir: str | Path) -> list[Path]:
  """Draws the evaluation return (mean ± standard deviation over episodes) over steps and over wall-clock time.

  Args:
    metrics_csv: needs columns `step` and `eval/episode_reward`; `eval/episode_reward_std` adds the band,
      `eval/mode/episode_reward` or `eval/sampled/episode_reward` a line for the other kind of action,
      `time/wall_clock_s` (seconds) the second figure and `stage` (names) a line where each stage begins.
    out_dir: made if needed.

  Returns:
    The files written; none if there has been no evaluation yet.
  """
  metrics_csv, out_dir = Path(metrics_csv), Path(out_dir)
  table = read_metrics(metrics_csv)
  if RETURN not in table:
    return []
  table = table.dropna(subset=[RETURN]).sort_values("step", kind="stable")
  out_dir.mkdir(parents=True, exist_ok=True)
  written = []
  for name, (column, label) in _AXES.items():
    rows = table.dropna(subset=[column]) if column in table else table.iloc[:0]
    if len(rows):
      with replacing(out_dir / name) as temporary:
        _draw(rows, column, label, temporary)
      written.append(out_dir / name)
  return written


def _draw(rows: "pd.DataFrame", column: str, label: str, path: Path) -> None:
  from matplotlib.figure import Figure  # not pyplot: no global state, no display, safe in any thread
  from matplotlib.ticker import EngFormatter

  x, mean = rows[column].to_numpy(float), rows[RETURN].to_numpy(float)
  if column == "time/wall_clock_s":
    unit, seconds = next((u, s) for u, s in (("h", 3600), ("min", 60), ("s", 1)) if x.max() >= 3 * s or s == 1)
    x, label = x / seconds, f"{label} ({unit})"
  figure = Figure(figsize=(7, 4.2), layout="constrained")
  axes = figure.subplots()
  std = rows["eval/episode_reward_std"].fillna(0).to_numpy(float) if "eval/episode_reward_std" in rows else None
  others = {name: rows[key].to_numpy(float) for name, key in OTHER_RETURNS.items() if key in rows}
  own = {"mode": "sampled", "sampled": "mode"}[next(iter(others))] if len(others) == 1 else ""
  names = rows["stage"].to_numpy(str) if "stage" in rows else np.full(len(rows), "")
  begins = [0, *np.flatnonzero(names[1:] != names[:-1]) + 1, len(rows)]
  for begin, end in pairwise(begins):  # a line each, since stages may have different rewards
    part, first = slice(begin, end), begin == 0
    if std is not None:
      low, high = (mean - std)[part], (mean + std)[part]
      shade = "± std" if first else None
      axes.fill_between(x[part], low, high, color="tab:blue", alpha=0.18, linewidth=0, label=shade)
    line = f"mean, {own}" if first and own else "mean" if first else None
    axes.plot(x[part], mean[part], color="tab:blue", linewidth=1.8, marker="o", markersize=3.5, label=line)
    for name, values in others.items():
      line = f"mean, {name}" if first else None
      axes.plot(x[part], values[part], color="tab:orange", linewidth=1.2, linestyle="--", label=line)
    if names[begin]:
      axes.axvline(float(x[begin]), color="0.5", linewidth=0.9, linestyle="--", zorder=1)
      axes.annotate(
        str(names[begin]), (x[begin], 1), (3, -3), axes.get_xaxis_transform(), "offset points",
        rotation=90, fontsize=8, color="0.35", ha="left", va="top",
      )  # fmt: skip
  axes.set_xlabel(label)
  axes.set_ylabel("evaluation return")
  axes.set_title(f"last {mean[-1]:.1f}   best {mean.max():.1f}", loc="right", fontsize=9, color="0.35")
  if column == "step":
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
  axes.grid(color="0.9")
  axes.set_axisbelow(True)
  axes.spines[["top", "right"]].set_visible(False)
  axes.legend(frameon=False, loc="lower right")
  figure.savefig(path, dpi=150)
