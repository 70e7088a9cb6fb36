"""Writes the result of a chain over all its stages: one metrics.csv, one curve, one summary."""

from collections.abc import Mapping

from playground.files import write_text
from playground.runs.csv_tracker import STAGE, read_metrics
from playground.runs.plots import plot_learning_curve
from playground.runs.run_dir import RunDirectory
from playground.settings import Plain, Section

_RETURNS = ("final_return", "final_sampled_return", "final_mode_return", "best_return")
_RESULT = ("env", *_RETURNS, "best_step", "params_sha256")
_OF_A_RUN = (*_RESULT, "steps", "steps_per_second", "wall_clock_s")


def write_result(chain: RunDirectory, folders: Mapping[str, str]) -> None:
  """Writes metrics.csv, plots and summary.json of a chain from its stages' files.

  Args:
    chain: its directory.
    folders: of the stages, by name.
  """
  runs = {name: RunDirectory(chain.path / folder) for name, folder in folders.items()}
  _write_metrics(chain, runs)
  plot_learning_curve(chain.metrics_csv, chain.plots)
  stages = [_stage(name, run) for name, run in runs.items()]
  begun = [stage for stage in stages if stage["steps"] is not None]
  open_ = [stage["status"] for stage in stages if stage["status"] != "finished"]
  last: Section = begun[-1] if begun else {}
  steps, rates = sum(stage["steps"] for stage in begun), [stage["steps_per_second"] for stage in begun]
  seconds = sum(stage["steps"] / rate for stage, rate in zip(begun, rates, strict=True) if rate)
  status = "finished" if not open_ else "failed" if "failed" in open_ else "preempted"
  chain.write_summary(
    {
      "status": status,
      # Stages may have different rewards, so return and step are those of the last stage.
      **{key: last.get(key) for key in _RESULT},
      "steps": steps,
      "steps_per_second": steps / seconds if seconds else None,
      "wall_clock_s": sum(stage["wall_clock_s"] or 0.0 for stage in begun),
      "stages": stages,
    }
  )


def _stage(name: str, run: RunDirectory) -> dict[str, Plain]:
  """Returns the result of a stage; None where it has none yet."""
  status, summary = run.status.get("status", "not begun"), run.summary
  return {"name": name, "folder": run.path.name, "status": status, **{key: summary.get(key) for key in _OF_A_RUN}}


def _write_metrics(chain: RunDirectory, runs: Mapping[str, RunDirectory]) -> None:
  """Writes one table of all stages: steps and wall-clock time accumulate, column `stage` names the stage."""
  import pandas as pd

  tables, steps, seconds = [], 0, 0.0
  for name, run in runs.items():
    table = read_metrics(run.metrics_csv)
    if table.empty:
      break
    table.insert(1, STAGE, name)
    table["step"] += steps
    steps = int(table["step"].iloc[-1])
    if "time/wall_clock_s" in table:
      table["time/wall_clock_s"] += seconds
      seconds = float(table["time/wall_clock_s"].iloc[-1])
    tables.append(table)
  if tables:
    write_text(chain.metrics_csv, pd.concat(tables, ignore_index=True).to_csv(index=False))
