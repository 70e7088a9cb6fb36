"""The catalogue of our tasks, `catalog.json`: what `playground list` shows without building a task.

`make catalog` (`python -m playground.catalog`) generates it from the configurations, the built tasks and the
reference runs in results/reference/. A task of another package is not in it.
"""

import dataclasses
import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Literal, get_args

from playground.files import read_csv

Status = Literal["solved", "learning", "open", "not measured"]
STATUSES = get_args(Status)
FILE = Path(__file__).parent / "catalog.json"
_REFERENCE = FILE.parents[1] / "results/reference"
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
    status: solved, learning or open, see `status`; "not measured" without a reference run.
    reference_return: return of the best reference run at its end, or of a chain's last stage.
    reference_steps: environment steps of that run.
    reference_agent: what trained it.
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
  reference_return: float | None
  reference_steps: int | None
  reference_agent: str


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

  config = compose([f"env={task}"])
  env = registry.build(config.env)
  observations = jax.eval_shape(env.reset, jax.random.PRNGKey(0)).obs
  groups = observations if isinstance(observations, dict) else {"state": observations}
  shown = ", ".join(f"{name} {' x '.join(map(str, group.shape))}" for name, group in groups.items())
  row = _reference(task)
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
    status=status(row) if row else "not measured",
    reference_return=float(row["final_return"]) if row else None,
    reference_steps=int(row["steps"]) if row else None,
    reference_agent=row["agent"].split(",")[0] if row else "",
  )


def status(row: dict[str, str]) -> Status:
  """Returns how far a reference run got.

  By success where the task counts it (from 0.9: solved; none: open), else by falls an episode (at most 0.2: solved;
  from 0.9: open), else by the return of 1000 that DM Control has (from 750: solved; below 50: open).
  """
  if row["note"].startswith("solved"):
    return "solved"
  success, falls = row.get("success"), row.get("falls_per_episode")
  if falls == "":  # not logged yet
    falls = 1 - float(row["episode_length"]) / 1000
  if success:
    return "solved" if float(success) >= 0.9 else "learning" if float(success) > 0 else "open"
  if falls:
    return "solved" if float(falls) <= 0.2 else "learning" if float(falls) < 0.9 else "open"
  if "success" in row:
    return "learning"
  score = float(row["final_return"])
  return "solved" if score >= 750 else "learning" if score >= 50 else "open"


def our_runs(rows: Sequence[dict[str, str]], task: str) -> list[dict[str, str]]:
  """Returns the rows of our runs of a task; of a chain's stages, which a table has in order, those of the last."""
  ours = [row for row in rows if row["task"] == task and row["who"] == "ours"]
  last = {row["experiment"]: row["setting"] for row in ours if "chain" in row.get("experiment", "")}
  return [row for row in ours if row["setting"] == last.get(row.get("experiment", ""), row["setting"])]


def _reference(task: str) -> dict[str, str] | None:
  """The run of ours that got furthest; of several the one of the highest return."""
  rows: list[dict[str, str]] = []
  for name in _TABLES:
    found = read_csv(_REFERENCE / f"{name}.csv")
    rows += our_runs(found, task)
  return max(rows, key=lambda row: (-STATUSES.index(status(row)), float(row["final_return"])), default=None)


def _write() -> None:
  from playground.config import task_names

  rows = [dataclasses.asdict(measure(task)) for task in task_names()]
  FILE.write_text("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n", encoding="utf-8")
  print(f"{FILE}: {len(rows)} tasks")


if __name__ == "__main__":
  _write()
