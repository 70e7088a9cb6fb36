"""Compares our learning curves with those of public repositories (`benchmarks/public/`)."""

import dataclasses
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from itertools import groupby, pairwise

from playground.benchmark.report.evidence import Evidence
from playground.benchmark.report.sections import Notes, curves_of, runs_by_step
from playground.catalog import entries
from playground.config.files import shipped, task_names
from playground.files import read_csv
from playground.reporting.page import Block, Heading, Image, Table, Text

Points = list[tuple[float, float]]  # (environment steps, return), steps ascending
SHARE = 0.95  # of the best public PPO at equal steps: below it a task counts as below
_AS_SET = "as set"
_AGENT = re.compile(r"(?<![a-z])(fast_sac|fast_td3|reppo|ppo|sac)(?![a-z])")
_SLM_LAB = "kengz/SLM-Lab"  # whose manipulation tasks have episodes of other lengths, and whose returns of 0.0 failed


@dataclasses.dataclass(frozen=True)
class Curve:
  """A learning curve with its run and kind of action.

  Attributes:
    label: the run, or algorithm and repository.
    actions: sampled, mode, or as set in the run.
    points: (environment steps, return), steps ascending.
  """

  label: str
  actions: str
  points: Points


def beside_public(evidence: Evidence, notes: Notes) -> Iterable[Block]:
  """Draws each task's best run of ours over public curves, and a table with the tasks where we are below first."""
  theirs = public_curves()
  starts = {task: min((c.points[0][0] for c in curves if is_ppo(c)), default=0) for task, curves in theirs.items()}
  ours = our_best(evidence, starts)
  shared = sorted(set(ours) & set(theirs))
  if not shared:
    return
  yield Heading(2, "Beside public curves")
  yield Text(
    "Our best run of each task and algorithm, of those that train as long if there are any, over what public "
    "repositories report (`benchmarks/public/`). `At equal steps` is the best public PPO there, read between its "
    f"points and never beyond our last step; our PPO is below where it has under {SHARE:.0%} of that. A run whose name "
    "has no algorithm does not count as PPO. Policies act as "
    "`our actions` and the public names say (as set: as the run's agent.deterministic_eval says, sampled by default). "
    "Public settings stand below the table, ours are in the run's name."
  )
  drawn = curves_of({task: _panel(ours[task], theirs[task]) for task in shared})
  yield Image("public", drawn, "Our curves over public ones, of each public algorithm the one that ends highest.")
  compared = [_compared(task, curve, theirs[task]) for task in shared for curve in ours[task]]
  rows = [row.cells() for row in sorted(compared, key=lambda row: (-row.below, row.ratio))]
  header = ["task", "our run", "our actions", "ours", "million steps", "best public PPO at equal steps", "of it", ""]
  yield Table([*header, "best public at its end"], rows)
  settings = [list(row.values()) for row in _read("settings")]
  yield Table(["repository", "pushes", "randomisation", "actions", "note"], settings)


@dataclasses.dataclass(frozen=True)
class _Comparison:
  task: str
  curve: Curve
  equal: tuple[float, str] | None
  best: tuple[float, str]

  @property
  def score(self) -> float:
    return self.curve.points[-1][1]

  @property
  def below(self) -> bool:
    return (
      self.equal is not None
      and agent_of(self.curve.label) == "ppo"
      and self.score < self.equal[0] - (1 - SHARE) * abs(self.equal[0])
    )

  @property
  def ratio(self) -> float:
    """Our return divided by the public one; infinite if the public one is missing or not positive."""
    return self.score / self.equal[0] if self.equal and self.equal[0] > 0 else math.inf

  def cells(self) -> list[str]:
    named = lambda found: f"{found[0]:,.1f} ({found[1]})" if found else "none so early"
    share = f"{self.ratio:.2f}" if math.isfinite(self.ratio) else ""
    steps = f"{self.curve.points[-1][0] / 1e6:,.0f}"
    own = [self.task, self.curve.label, self.curve.actions, f"{self.score:,.1f}", steps]
    return [*own, named(self.equal), share, "below" * self.below, named(self.best)]


def _compared(task: str, curve: Curve, theirs: Sequence[Curve]) -> _Comparison:
  steps = curve.points[-1][0]
  ppo = [(value, c.label) for c in theirs if is_ppo(c) and (value := at(c.points, steps)) is not None]
  ends = [(c.points[-1][1], c.label) for c in theirs]
  return _Comparison(task, curve, max(ppo, default=None), max(ends))


def is_ppo(public: Curve) -> bool:
  """Returns whether a public curve is one of PPO; REPPO is another algorithm."""
  return public.label.startswith("PPO")


def at(points: Points, steps: float) -> float | None:
  """Returns a curve's return at `steps`: linear between points, the last one beyond the end, None before the first."""
  if steps < points[0][0]:
    return None
  for (x0, y0), (x1, y1) in pairwise(points):
    if steps < x1:
      return y0 + (y1 - y0) * (steps - x0) / (x1 - x0)
  return points[-1][1]


def our_best(evidence: Evidence, starts: Mapping[str, float]) -> dict[str, list[Curve]]:
  """Returns the curves of each task that end highest, one for each algorithm and kind of action.

  Curves that reach the task's step in `starts`, if there are any, come before higher ones that end sooner.
  """
  found: dict[str, list[Curve]] = {}
  for actions, curves in ((_AS_SET, evidence.curves), ("mode", evidence.mode_curves)):
    for name, points in curves.items():
      if (task := _task_of(name)) is not None:
        found.setdefault(task, []).append(
          Curve(f"ours: {name.removeprefix(task).strip('_') or 'run'}", actions, points)
        )
  for actions, quantity in ((_AS_SET, "return"), ("mode", "mode_return")):
    for task, runs in runs_by_step(evidence, quantity, only_ours=True).items():
      found.setdefault(task, []).extend(Curve(f"ours: {name}", actions, points) for name, points in runs.items())
  best: dict[str, dict[tuple[str, str], Curve]] = {}
  for task, curves in found.items():
    ascending = [dataclasses.replace(curve, points=sorted(curve.points)) for curve in curves]
    ends = lambda curve, start=starts.get(task, 0): (curve.points[-1][0] >= start, curve.points[-1][1])
    for curve in sorted(ascending, key=ends):
      best.setdefault(task, {})[agent_of(curve.label), curve.actions] = curve  # the highest is the last
  return {task: list(curves.values()) for task, curves in best.items()}


def agent_of(label: str) -> str:
  """Returns the algorithm in a run's name; `run` if the name has none, which may be any."""
  found = _AGENT.search(label)
  return found.group() if found else "run"


@cache
def public_curves() -> dict[str, list[Curve]]:
  """Returns the public curves by task, one for each algorithm of a repository, without what compares to nothing."""
  settings = {row["repository"]: row for row in _read("settings")}
  manipulation = {task for task, entry in entries().items() if entry.suite == "manipulation"}
  curves: dict[str, list[Curve]] = {}
  key = lambda row: (row["task"], row["algorithm"], row["source"].partition("@")[0])
  for (task, algorithm, repository), rows in groupby(sorted(_read("returns"), key=key), key=key):
    points = sorted((float(row["env_steps"]), float(row["return_mean"])) for row in rows)
    if repository == _SLM_LAB and (task in manipulation or all(abs(value) < 0.05 for _, value in points)):
      continue
    label = f"{algorithm}, {settings[repository]['actions']}"
    curves.setdefault(task, []).append(Curve(label, settings[repository]["actions"], points))
  return curves


def _task_of(name: str) -> str | None:
  """Returns the task that a curve's name begins with; None without one."""
  return max((task for task in task_names() if name == task or name.startswith(f"{task}_")), key=len, default=None)


def _panel(ours: Sequence[Curve], theirs: Sequence[Curve]) -> dict[str, Points]:
  """Returns a task's curves by short names, ours first."""
  named = {f"our {agent_of(curve.label)}{', mode' * (curve.actions == 'mode')}": curve.points for curve in ours}
  for curve in sorted(theirs, key=lambda curve: curve.points[-1][1]):
    named[re.split(r"[ ,(]", curve.label)[0]] = curve.points  # the highest is the last
  return named


@cache
def _read(name: str) -> Sequence[Mapping[str, str]]:
  return read_csv(shipped("benchmarks") / "public" / f"{name}.csv")
