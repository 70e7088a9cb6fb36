"""Builds tables of tasks: the best run of each beside the best public ones at equal steps, and that of each agent."""

import re
from collections.abc import Sequence
from statistics import fmean

from playground.benchmark.report.public import agent_of, at, is_ppo, public_curves
from playground.catalog import Entry, best_runs, by_seed, reached_return, run_name
from playground.reporting.page import NOT_MEASURED, Table, mean_and_ci95, short
from playground.text import millions

_HEADER = ("task", "status", "best run", "M steps", "default budget", "runs (seeds)", "sampled", "mode", "in C MuJoCo")
_PUBLIC = ("best public PPO", "best public")  # at as many steps
_AGENTS = ("task", "best run", "M steps", "runs (seeds)", "sampled", "mode", "ended", "trained on", "default")
_BY_MODE = ("reppo", "fast_td3", "fast_sac")  # whose agent.deterministic_eval is true by default
Row = dict[str, str]


def by_mode(row: Row) -> bool:
  """Returns whether a run's `final_return` is of the policy's mode, not of sampled actions."""
  return row["agent"] in _BY_MODE or "deterministic_eval=true" in row.get("setting", "")


def table(entries: Sequence[Entry], rows: Sequence[Row]) -> Table:
  """Builds the table of a suite's tasks, in the order of the catalogue.

  Args:
    entries: catalogue entries of the tasks.
    rows: rows of the tasks' runs, from results/reference.
  """
  cells = []
  for entry in entries:
    budget = millions(entry.budget)
    runs = best_runs(rows, entry.task)
    if not runs:
      cells.append([entry.task, entry.status, NOT_MEASURED, "", budget, *[""] * 6])
      continue
    name, steps, *returns = _cells(runs)
    public = [_public(entry.task, float(runs[0]["steps"]), ppo_only) for ppo_only in (True, False)]
    cells.append([entry.task, entry.status, name, steps, budget, *returns, _in_c_mujoco(runs), *public])
  if not any(row[-1] for row in cells):
    return Table(_HEADER, [row[: -len(_PUBLIC)] for row in cells])
  return Table([*_HEADER, *_PUBLIC], cells)


def agents_table(entries: Sequence[Entry], rows: Sequence[Row]) -> Table:
  """Builds a table of the tasks that several agents trained: the best runs of each agent, the best agent first.

  Args:
    entries: catalogue entries of the tasks.
    rows: rows of the tasks' runs, from results/reference.
  """
  cells = []
  for entry in entries:
    by_agent: dict[str, list[Row]] = {}
    for row in rows:
      by_agent.setdefault(agent_of(row["agent"]), []).append(row)
    found = [runs for of_agent in by_agent.values() if (runs := best_runs(of_agent, entry.task))]
    for runs in sorted(found, key=lambda runs: -fmean(by_seed(runs, reached_return))) if len(found) > 1 else []:
      on = "CPU" if runs[0].get("device") == "CPU" else "GPU"
      default = "yes" if agent_of(runs[0]["agent"]) == entry.agent else ""
      cells.append([entry.task, *_cells(runs), ended(runs), on, default])
  return Table(_AGENTS, cells)


def _cells(runs: Sequence[Row]) -> list[str]:
  """Returns the name, M steps, number, and mean returns of runs, sampled and by the mode."""
  count = f"{len(runs)} ({len({row['seed'] for row in runs})})"
  sampled = "" if by_mode(runs[0]) else _with_ci(runs, "final_return")
  mode = _with_ci(runs, "final_return" if by_mode(runs[0]) else "final_mode_return")
  return [run_name(runs[0]), millions(float(runs[0]["steps"])), count, sampled, mode]


def ended(runs: Sequence[Row], prefix: str = "") -> str:
  """Returns the fraction of successes, the turns of a cube or the falls an episode, means; "" if no run logged one."""
  for column, text in (("success", "success {:.2f}"), ("turns", "{:.1f} turns"), ("falls_per_episode", "{:.2f} falls")):
    if values := _returns(runs, prefix + column):
      return text.format(fmean(values))
  return ""


def _in_c_mujoco(runs: Sequence[Row]) -> str:
  """Returns the mean return and how episodes ended in C MuJoCo, in brackets without pushes; "" if no run was played."""
  texts = []
  for prefix in ("c_mujoco_", "c_mujoco_calm_"):
    if values := _returns(runs, f"{prefix}return"):
      texts.append(", ".join(filter(None, (short(fmean(values)), ended(runs, prefix)))))
  return f"{texts[0]} ({texts[1]})" if len(texts) > 1 else "".join(texts)


def _returns(runs: Sequence[Row], column: str) -> list[float]:
  """Returns a column's mean for each seed that has it."""
  return by_seed([row for row in runs if row.get(column)], lambda row: float(row[column]))


def _with_ci(runs: Sequence[Row], column: str) -> str:
  """Formats the mean over seeds, for several with half its 95 % confidence interval; "" if it was not measured.

  In brackets stands how many seeds were measured, where that is not all.
  """
  values = _returns(runs, column)
  if not values:
    return ""
  mean, ci95 = mean_and_ci95(values)
  some = f" ({len(values)})" if len(values) < len({row["seed"] for row in runs}) else ""
  return short(mean) + ("" if ci95 is None else f" ± {ci95:.0f}" if ci95 >= 10 else f" ± {ci95:.2g}") + some


def _public(task: str, steps: float, ppo_only: bool) -> str:
  """Returns the best public return at equal steps, and its algorithm; a curve that ended earlier counts by its end.

  If all curves begin later, the result is the best of the earliest first points, with its steps.
  """
  curves = [curve for curve in public_curves().get(task, ()) if is_ppo(curve) or not ppo_only]
  named = lambda curve: f"{re.split(r'[ ,(]', curve.label)[0]}, {curve.actions}"
  if found := [(value, named(curve)) for curve in curves if (value := at(curve.points, steps)) is not None]:
    value, name = max(found)
    return f"{short(value)} ({name})"
  if curves:
    first = min(curve.points[0][0] for curve in curves)
    value, name = max((curve.points[0][1], named(curve)) for curve in curves if curve.points[0][0] == first)
    return f"{short(value)} after {millions(first)} ({name})"
  return ""
