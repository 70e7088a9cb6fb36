"""The catalogue of our tasks, `catalog.json`: what `playground list` shows without building a task.

`make catalog` (`python -m playground.catalog`) generates it from the configurations, the built tasks and the
reference runs in results/reference/. A task of another package is not in it.
"""

import dataclasses
import json
import re
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from statistics import fmean
from typing import Literal, get_args

from playground.files import read_csv

Status = Literal["solved", "learning", "open", "not measured"]
STATUSES: tuple[Status, ...] = get_args(Status)
FILE = Path(__file__).parent / "catalog.json"
_REFERENCE = FILE.parents[1] / "results/reference"
_NO_PUSHES = re.compile(r"events\.push(\.enabled=false|=null)")  # in the setting of a run
_SEEDS = 3  # that a mean needs to stand for a task
_TABLES = ("dm_control", "locomotion", "manipulation", "vision")


@dataclasses.dataclass(frozen=True)
class Entry:
  """What one task is, and how its reference run ended.

  Attributes:
    task: its name.
    suite: dm_control, locomotion or manipulation.
    robot: the option of the group robot; "" for a task with a model of its own.
    observation: size of each observation group, such as `state 48, privileged_state 123`.
    action: size of the action.
    backend: physics on an NVIDIA GPU, jax or warp.
    agent: the algorithm that its experiment trains with.
    budget: environment steps of its tuned set.
    experiment: its experiment.
    status: solved, learning or open, of the run that got furthest, see `status`; "not measured" without a run.
    best_return: mean of `reached_return` of the best runs of ours, see `best_runs`.
    best_steps: environment steps of those runs, of a chain's last stage alone.
    best_run: what trained them, see `run_name`.
  """

  task: str
  suite: str
  robot: str
  observation: str
  action: int
  backend: str
  agent: str
  budget: int
  experiment: str
  status: Status
  best_return: float | None
  best_steps: int | None
  best_run: str


@cache
def entries() -> dict[str, Entry]:
  """Returns the catalogue by task."""
  return {row["task"]: Entry(**row) for row in json.loads(FILE.read_text(encoding="utf-8"))}


def measure(task: str) -> Entry:
  """Builds a task and returns its entry."""
  import jax

  from playground import registry
  from playground.config import compose
  from playground.config.files import experiment_name
  from playground.envs.base import observation_groups

  config = compose([f"env={task}"])
  env = registry.build(config.env)
  groups = observation_groups(jax.eval_shape(env.reset, jax.random.PRNGKey(0)).obs)
  shown = ", ".join(f"{name} {' x '.join(map(str, group.shape))}" for name, group in groups.items())
  rows = [row for name in _TABLES for row in read_csv(_REFERENCE / f"{name}.csv")]
  best = best_runs(rows, task)
  reached = [STATUSES.index(status(row)) for row in our_runs(rows, task)]
  return Entry(
    task=task,
    suite=str(config.env.task).split(".")[2],
    robot=str(config.choices.get("robot") or ""),
    observation=shown,
    action=env.action_size,
    backend="warp" if config.env.vision.enable else str(config.env.cuda_impl),
    agent=str(config.agent_name),
    budget=int(config.agent.num_timesteps),
    experiment=experiment_name(task),
    status=STATUSES[min(reached, default=-1)],
    best_return=round(fmean(by_seed(best, reached_return)), 3) if best else None,
    best_steps=int(best[0]["steps"]) if best else None,
    best_run=run_name(best[0]) if best else "",
  )


def status(row: dict[str, str]) -> Status:
  """Returns how far a reference run got.

  By success where the task counts it (from 0.9: solved; none: open), for a rotation in the hand by turns and by drops
  in C MuJoCo (from 3 turns and up to 0.2 drops an episode: solved), else by falls an episode (at most 0.2: solved; from
  0.9: open), else by the return of 1000 that DM Control has (from 750: solved; below 50: open).
  """
  if row["note"].startswith("solved"):
    return "solved"
  success, falls = row.get("success"), row.get("falls_per_episode")
  if falls == "" and row["episode_length"]:  # not logged yet
    falls = 1 - float(row["episode_length"]) / 1000
  if success:
    return "solved" if float(success) >= 0.9 else "learning" if float(success) > 0 else "open"
  if turns := row.get("turns"):
    drops = row["c_mujoco_falls_per_episode"]
    return "solved" if float(turns) >= 3 and drops and float(drops) <= 0.2 else "learning"
  if falls:
    return "solved" if float(falls) <= 0.2 else "learning" if float(falls) < 0.9 else "open"
  if "success" in row or falls == "":  # of a suite without a highest return
    return "learning"
  score = float(row["final_return"])
  return "solved" if score >= 750 else "learning" if score >= 50 else "open"


def our_runs(rows: Sequence[dict[str, str]], task: str) -> list[dict[str, str]]:
  """Returns the rows of our runs of a task; of a chain's stages, which a table has in order, those of the last."""
  ours = [row for row in rows if row["task"] == task and row["who"] == "ours"]
  last = {row["experiment"]: stage for row in ours if (stage := _stage_of(row))}
  return [row for row in ours if _stage_of(row) == last.get(row.get("experiment", ""), "")]


def _stage_of(row: dict[str, str]) -> str:
  """Returns the stage of a chain that a row is of, "" without one."""
  found = re.search(r"stage[ =](\w+)", row["setting"]) if "chain" in row.get("experiment", "") else None
  return found.group(1) if found else ""


def best_runs(rows: Sequence[dict[str, str]], task: str) -> list[dict[str, str]]:
  """Returns our runs of a task with the agent, setting and backend of the highest mean of `reached_return`.

  Runs of fewer than three seeds count only if there are no others. Of runs that differ only in their number of steps
  the longest count, as the others were stopped; of several within 2 % of the highest, those with the most seeds. A
  chain counts by its last stage. Runs without pushes count only if there are no others.
  """
  ours = our_runs(rows, task)
  groups: dict[tuple[str, ...], list[dict[str, str]]] = {}
  for row in [row for row in ours if not _NO_PUSHES.search(row["setting"])] or ours:
    groups.setdefault((row["agent"], row["setting"], row["backend"], row["steps"]), []).append(row)
  mean = lambda runs: fmean(by_seed(runs, reached_return))
  seeds = lambda runs: len({row["seed"] for row in runs})
  by_steps = sorted(groups.values(), key=lambda runs: int(runs[0]["steps"]))
  found = [runs for runs in by_steps if seeds(runs) >= _SEEDS] or by_steps
  longest = {tuple(runs[0][key] for key in ("agent", "setting", "backend")): runs for runs in found}.values()
  highest = max(map(mean, longest), default=0.0)
  close = [runs for runs in longest if mean(runs) >= highest - 0.02 * abs(highest)]
  return max(close, key=lambda runs: (seeds(runs), mean(runs)), default=[])


def reached_return(row: dict[str, str]) -> float:
  """Returns the mean return of a run's last evaluation: of the policy's mode, else of sampled actions."""
  return float(row.get("final_mode_return") or row["final_return"])


def by_seed(runs: Sequence[dict[str, str]], value: Callable[[dict[str, str]], float]) -> list[float]:
  """Returns the mean value of each seed's runs: a seed that is trained again is no other sample."""
  seeds: dict[str, list[float]] = {}
  for run in runs:
    seeds.setdefault(run["seed"], []).append(value(run))
  return [fmean(values) for values in seeds.values()]


def value_of(setting: str, key: str) -> str:
  """Returns the value of a key in the setting of a row, the last one if there are several; "" without it."""
  return next((word.partition("=")[2] for word in reversed(setting.split()) if word.startswith(f"{key}=")), "")


def run_name(row: dict[str, str]) -> str:
  """Returns a run's agent with what sets it apart: a chain's stage, its first policy's task, Warp, set, data."""
  setting = row["setting"]
  chain = f", {row['experiment']}'s {stage}" if (stage := _stage_of(row)) else ""
  start = re.search(r"init_from=<(\w+)>", setting)
  return (
    row["agent"].split(",")[0].replace("agent.", "")
    + chain
    + (f", from {start.group(1)}" if start else "")
    + ", on Warp" * ("env.impl=warp" in setting)
    + (f", tuned={tuned}" if (tuned := value_of(setting, "tuned")) else "")
    + ", mirrored data" * ("agent.mirror_augmentation=true" in setting)
    + ", without mirrored data" * ("agent.mirror_augmentation=false" in setting)
    + ", no pushes, nothing randomised" * bool(_NO_PUSHES.search(setting))
  )


def _write() -> None:
  from playground.config import task_names

  rows = [dataclasses.asdict(measure(task)) for task in task_names()]
  FILE.write_text("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n", encoding="utf-8")
  print(f"{FILE}: {len(rows)} tasks")


if __name__ == "__main__":
  _write()
