"""`playground pretrained`: lists the policies that come with the package, or adds one."""

import math

from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from playground import catalog, pretrained
from playground.cli.play import play
from playground.config import task_names
from playground.console import wide_console
from playground.deploy.scores import read_scores, result_name
from playground.errors import ConfigError
from playground.files import need_folder
from playground.learning.checkpoints import find_checkpoints, find_stages
from playground.pretrained import add, cards
from playground.runs.csv_tracker import OTHER_RETURNS, RETURN, newest_evaluation
from playground.runs.run_dir import RunDirectory
from playground.settings import Plain
from playground.text import millions

_EPISODES = 20  # in C MuJoCo
_COLUMNS = ("task", "agent", "status", "M steps", "return", "in C MuJoCo", "falls")


def show_policies(console: Console | None = None) -> int:
  """Prints a table of the cards; returns the exit code, 0."""
  table = Table(*_COLUMNS, box=SIMPLE, padding=(0, 1, 0, 0), title="Pretrained policies")
  for column in table.columns:
    column.no_wrap, column.overflow = column.header != "task", "fold"
  for task, card in cards().items():
    trained, plain = card["training"], card["c_mujoco"]
    score = trained["sampled"] if trained["mode"] is None else trained["mode"]
    falls = f"{plain['falls']}/{plain['episodes']}"
    steps = millions(card["steps"])
    measured = f"{plain['return']:.1f} ± {plain['return_std']:.1f}"
    table.add_row(task, card["agent"], card["status"], steps, f"{score:.1f}", measured, falls)
  (console or wide_console()).print(table)
  return 0


def add_policy(path: str, note: str = "", replace: bool = False) -> int:
  """Measures a run's newest policy in C MuJoCo and copies it, with its card, into the package.

  Args:
    path: a run directory, or that of a chain.
    note: a remark on the training for the card, such as that the run was stopped early.
    replace: whether the policy of the same task is replaced.

  Returns:
    The exit code, 0.

  Raises:
    PlaygroundError: no such run, or a policy without an ONNX form.
    ConfigError: the run has not been evaluated, its task is not one of `playground list`, the package has a policy of
      it, or a folder cannot be written.
  """
  newest = find_checkpoints(path)[0]  # of a chain, that of its last stage
  run, steps = RunDirectory.open(newest.parents[1]), int(newest.name)
  chain = RunDirectory(run.path.parent)
  started = chain if run.path in find_stages(chain.path) else run  # by the command of the card
  path = str(run.path)
  if newest != (last := find_checkpoints(run.path)[0]):
    raise ConfigError(f"{newest} is not the run's newest policy, which alone can be added: {last}.")
  for name in ("overrides.yaml", "manifest.json", "metrics.csv"):
    if not (run.path / name).is_file():
      raise ConfigError(f"{run.path / name} is missing: only a whole run can be added.")
  task = str(run.config["choices"]["env"])
  if task not in task_names():
    raise ConfigError(f"{path} trained env={task}: only policies of tasks that `playground list` shows can be added.")
  if (old := cards().get(task)) and not replace:
    raise ConfigError(
      f"There is a policy of {task} already: {old['agent']}, {millions(old['steps'])} M steps, return "
      f"{old['c_mujoco']['return']:g} in C MuJoCo. --replace replaces it."
    )
  row = newest_evaluation(run.metrics_csv, steps)
  if row is None:
    raise ConfigError(f"{path} was not evaluated before its newest checkpoint, step {steps}.")
  result = run.path / "export" / result_name(steps, seed=0, episodes=_EPISODES)
  need_folder(result.parent, str(result.parent), run.path)
  need_folder(pretrained.POLICIES, str(pretrained.POLICIES))
  scores = read_scores(result) if result.exists() else None
  if scores is None:
    play(path, episodes=_EPISODES)
    scores = read_scores(result)
  config, manifest = run.config, run.manifest
  git: dict[str, Plain] = manifest.get("git") or {}
  as_set, other = ("mode", "sampled") if config["agent"]["deterministic_eval"] else ("sampled", "mode")
  returns = {as_set: row[RETURN], other: row.get(OTHER_RETURNS[other], math.nan)}
  card = {
    "task": task,
    "agent": config["choices"]["agent"],
    "status": _status(scores, note),
    "steps": steps,
    "seed": config["seed"],
    "command": " ".join(["playground-run", *(o for o in started.overrides if not o.startswith("run_dir="))]),
    "commit": git.get("commit"),
    "versions": {name: manifest["versions"][name] for name in ("jax", "mujoco", "mujoco-mjx", "warp-lang")},
    "device": manifest["device"],
    "date": manifest["created"][:10],
    "wall_clock_s": round(float(row["time/wall_clock_s"]), 1),
    "note": note,
    "training": {
      **{kind: None if math.isnan(returns[kind]) else round(float(returns[kind]), 2) for kind in ("sampled", "mode")},
      "episodes": config["agent"]["num_eval_envs"],
      "steps": int(row["step"]),  # fewer than the policy's where the run was stopped
    },
    "c_mujoco": {
      "action": "mode",
      "return": round(scores["episode_reward"], 2),
      "return_std": round(scores["episode_reward_std"], 2),
      "episodes": _EPISODES,
      "falls": round(scores.get("episode_fall", 0.0) * _EPISODES),
    },
  }
  folder = add(run.path, task, card)
  size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
  print(f"{folder}: {size / 1e6:.1f} MB")
  return 0


def _status(scores: dict[str, float], note: str) -> catalog.Status:
  """Returns the catalogue's status for a policy's scores in C MuJoCo, and the note of its card."""
  measured = {"falls_per_episode": "episode_fall", "success": "episode_success", "turns": "episode_turns"}
  measured["c_mujoco_falls_per_episode"] = measured["falls_per_episode"]
  row = {column: str(scores[name]) for column, name in measured.items() if name in scores}
  return catalog.status({"note": note, "final_return": str(scores["episode_reward"]), **row})
