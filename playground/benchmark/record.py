"""`playground-bench record`: appends finished or stopped runs to the tables of results/reference."""

import csv
import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

from playground.benchmark.arguments import check_limits
from playground.benchmark.run_columns import conditions_of, fixed, notes_on_end, setting_of, stage_of, times_of
from playground.benchmark.schema import commit_of
from playground.catalog import entries
from playground.errors import ConfigError
from playground.extras import need
from playground.files import csv_text, is_locked, lock_holder, locking, need_folder, read_csv, write_text
from playground.learning.checkpoints import find_checkpoints, find_stages
from playground.limits import count
from playground.runs.csv_tracker import OTHER_RETURNS, RETURN, read_table
from playground.runs.run_dir import RunDirectory
from playground.settings import select

Row = dict[str, object]
_EPISODES = 20  # in C MuJoCo, of a row that does not say otherwise
_MEASURED = {  # column -> its column of metrics.csv, the mode's where it was evaluated, too, and decimals
  "tracking_error_lin_m_s": ("eval/episode_tracking_error/lin_vel", 3),
  "tracking_error_ang_rad_s": ("eval/episode_tracking_error/ang_vel", 3),
  "falls_per_episode": ("eval/episode_fall", 3),
  "episode_length": ("eval/episode_length", 1),
  "success": ("eval/episode_success", 3),
  "position_error_cm": ("eval/episode_position_error_cm", 2),
  "rotation_error_deg": ("eval/episode_rotation_error_deg", 2),
  "rotations": ("eval/episode_rotations", 2),
  "turns": ("eval/episode_turns", 2),
  "goals_reached": ("eval/episode_goals_reached", 2),
}
_IN_C_MUJOCO = {"return": "episode_reward", "falls_per_episode": "episode_fall", "success": "episode_success"}
_IDENTITY = ("who", "task", "agent", "experiment", "setting", "seed", "steps")  # columns that tell runs apart
_OF_MANIFEST = ("impl", "platform", "device", "num_devices", "matmul_precision", "network_precision", "versions")
_OF_CONFIG = ("choices.env", "choices.agent", "agent.num_timesteps", "agent.num_eval_envs", "env.impl", "seed")


@dataclasses.dataclass(frozen=True)
class Options:
  """Appends a row and the evaluations of each finished or stopped run to the tables of results/reference."""

  runs: Annotated[Sequence[str], "run directories; of a chain, all of its stages"] = ()
  note: Annotated[str, "a remark for each row, after those that follow from the run"] = ""
  machine: Annotated[str | None, "the machine and its other load, for conditions; null is the device's name"] = None
  alone: Annotated[bool, "whether each run had its device to itself, and so its rate and times count"] = False
  c_mujoco: Annotated[bool, "whether to play each policy's mode in C MuJoCo, with and without pushes"] = False
  episodes: Annotated[int, count(1), "episodes in C MuJoCo"] = _EPISODES
  reference: Annotated[str, "folder of the tables"] = "results/reference"


@dataclasses.dataclass(frozen=True)
class Entry:
  """A run, as the tables have it.

  Attributes:
    run: its directory.
    table: the suite's table.
    row: its row by column, without what is played in C MuJoCo.
    curves: table of the suite's evaluations.
    evaluations: its rows of `curves`, without the run's name.
    name: the run's name in `curves`, of which a number makes another one where it is taken.
    policy: steps of the newest checkpoint; None if nothing is to be played.
  """

  run: RunDirectory
  table: Path
  row: Row
  curves: Path
  evaluations: list[Row]
  name: str
  policy: int | None


def run(options: Options) -> int:
  """Records the runs; skips, with a message, those that the tables have already.

  Returns:
    The exit code, 0.

  Raises:
    ConfigError: no run is named, a run is incomplete, still training or was not evaluated after training, its task is
      not one of `playground list`, or a table is missing, cannot be written or lacks columns.
    PlaygroundError: no such run or checkpoint, or a policy that cannot be played.
  """
  check_limits(options)
  if not options.runs:
    raise ConfigError("Name what to record: runs=<run directory>,<run directory>.")
  folder = Path(options.reference).expanduser()
  if not folder.is_dir():
    raise ConfigError(f"reference={folder} is not a folder: name that of the tables, results/reference.")
  need_folder(folder, f"reference={folder}")
  if options.c_mujoco:
    need("deploy", "onnx", "onnxruntime")
  found = [_entry(each, folder, options) for path in options.runs for each in _directories(path)]
  with locking(folder / ".lock") as lock:
    if lock is None:
      raise ConfigError(f"reference={folder} is being written by {lock_holder(folder / '.lock')}: wait for it.")
    for entry in found:
      if any(_key(row) == _key(entry.row) for row in read_csv(entry.table)):
        print(f"{entry.run.path} is in {entry.table} already: same task, agent, setting, seed, steps and commit.")
        continue
      row = entry.row | (_played(entry, options.episodes) if entry.policy is not None else {})
      name = _add_curves(entry)  # first: without its row, the run is not recorded yet
      _append(entry.table, [row])
      print(f"{entry.run.path}: a row in {entry.table}, {len(entry.evaluations)} in {entry.curves} ({name})")
  return 0


def _directories(path: str) -> list[RunDirectory]:
  """Returns the run at `path`, of a chain its stages that have a checkpoint."""
  opened = RunDirectory.open(path)
  return [RunDirectory(stage) for stage in find_stages(opened.path)] or [opened]


def _entry(run: RunDirectory, folder: Path, options: Options) -> Entry:
  """Reads a run; raises ConfigError for one that cannot be recorded."""
  for path in (run.overrides_path, run.path / "manifest.json", run.metrics_csv):
    if not path.is_file():
      raise ConfigError(f"{path} is missing: only a whole run can be recorded.")
  if is_locked(run.path / "run.lock"):
    raise ConfigError(f"{run.path} is being written by {lock_holder(run.path / 'run.lock')}: wait until it has ended.")
  config, manifest = run.config, run.manifest
  missing = [key for key in _OF_CONFIG if select(config, key) is None] + [k for k in _OF_MANIFEST if k not in manifest]
  if missing:
    raise ConfigError(f"{run.path} is damaged: its config.yaml or manifest.json lacks {missing[0]}.")
  task, agent = config["choices"]["env"], config["choices"]["agent"]
  if task not in entries():
    raise ConfigError(f"{run.path} trained env={task}: only tasks that `playground list` shows have tables.")
  suite = entries()[task].suite
  table, curves = folder / f"{suite}.csv", folder / f"{suite}_curves.csv"
  if select(config, "env.vision.enable"):
    table = folder / "vision.csv"
  columns, _ = _header(table, (*_IDENTITY, "conditions")), _header(curves, ("run", "step", RETURN))
  if options.c_mujoco and "c_mujoco_return" not in columns:
    raise ConfigError(f"{table} has no columns c_mujoco_*: leave c_mujoco=true away for {run.path}.")
  metrics = read_table(run.metrics_csv).rows
  evaluations = [row for row in metrics if row.get(RETURN, "").lower() not in ("", "nan")]
  if not evaluations or int(evaluations[-1]["step"]) == 0:
    raise ConfigError(f"{run.path} was not evaluated after training: there is nothing to record.")
  last, deterministic = evaluations[-1], bool(config["agent"].get("deterministic_eval"))
  decimals = 1 if suite == "dm_control" or abs(float(last[RETURN])) >= 100 else 2
  mode = last[RETURN] if deterministic else last.get(OTHER_RETURNS["mode"], "")
  policy = int(find_checkpoints(run.path)[0].name) if options.c_mujoco else None
  stage = stage_of(run)
  setting, usual = setting_of(run, stage)
  evaluated, commit = int(last["step"]), commit_of(manifest.get("git"))
  sampled = last.get(OTHER_RETURNS["sampled"]) if deterministic else None
  notes = ["evaluated by the policy's mode"] * deterministic + [f"sampled {fixed(sampled, decimals)}"] * bool(sampled)
  if not deterministic and mode and "final_mode_return" not in columns:
    notes.append(f"by the policy's mode {fixed(mode, decimals)}")
  notes += notes_on_end(run, evaluated, max(policy or 0, int(metrics[-1]["step"])), policy)
  notes += [f"{options.episodes} episodes in C MuJoCo"] * (policy is not None and options.episodes != _EPISODES)
  notes += [f"then with {usual}"] * bool(usual) + [options.note] * bool(options.note)
  row = {
    "task": task,
    "agent": agent,
    "who": "ours",
    "experiment": config["choices"].get("experiment") or "",
    "setting": setting,
    "seed": config["seed"],
    "backend": manifest["impl"],
    "steps": evaluated,
    "final_return": fixed(last[RETURN], decimals),
    "final_mode_return": fixed(mode, decimals),
    "return_std": fixed(last.get(f"{RETURN}_std"), decimals),
    "best_return": fixed(max(float(row[RETURN]) for row in evaluations if int(row["step"])), decimals),
    "nonfinite": fixed(sum(float(row.get("training/nonfinite") or 0) for row in metrics), 1),
    "note": "; ".join(notes),
    "devices": manifest["num_devices"],
    "device": "CPU" if manifest["platform"] == "cpu" else manifest["device"],
    "conditions": conditions_of(config, manifest, options.machine, commit),
    **{column: fixed(_of_mode(last, metric), digits) for column, (metric, digits) in _MEASURED.items()},
    **(times_of(run, manifest) if options.alone else {}),
  }
  name = "_".join(filter(None, (task, agent, f"s{config['seed']}", stage, commit.rstrip("+"))))
  points = []
  for each in evaluations:
    values = each | ({OTHER_RETURNS["mode"]: each[RETURN]} if deterministic else {})
    values |= {} if options.alone else {"time/steps_per_second": ""}
    numbers = {column: fixed(values.get(column), 3) for column in _header(curves) if "/" in column}
    points.append({"stage": stage, "step": each["step"], **numbers})
  return Entry(run, table, row, curves, points, name, policy)


def _of_mode(evaluation: Mapping[str, str], metric: str) -> str | None:
  """Returns a metric of the mode's episodes, where an evaluation has both kinds, else of those it has."""
  return evaluation.get(metric.replace("eval/", "eval/mode/")) or evaluation.get(metric)


def _played(entry: Entry, episodes: int) -> Row:
  """Plays a run's policy in C MuJoCo, or reads the result of an earlier play, and returns the columns c_mujoco_*."""
  from playground.deploy.scores import newest_scores

  events = [event for event in entry.run.config["env"].get("events", {}).values() if event]
  pushed = any(event.get("mode") == "interval" and event.get("enabled", True) for event in events)
  row = {}
  for prefix in ("c_mujoco", "c_mujoco_calm")[: 1 + pushed]:
    scores = newest_scores(entry.run.path, entry.policy or 0, episodes, interval_events=prefix == "c_mujoco")
    row |= {f"{prefix}_{column}": f"{scores[name]:.4g}" for column, name in _IN_C_MUJOCO.items() if name in scores}
  return row


def _key(row: Mapping[str, object]) -> tuple[str, ...]:
  """Returns what two records of the same run have in common; older rows do not say whether files had changes."""
  commits = re.findall(r"\bcommit ([0-9a-f]{7,})", str(row["conditions"]))
  return (*(str(row.get(column) or "") for column in _IDENTITY), *commits[-1:])


def _add_curves(entry: Entry) -> str:
  """Appends the evaluations, unless an interrupted call has already, and returns the run's name in the table."""
  present: dict[str, list[str]] = {}
  for row in read_csv(entry.curves):
    present.setdefault(row["run"], []).append(f"{row['step']} {row[RETURN]}")
  name, number = entry.name, 1
  own = [f"{row['step']} {row[RETURN]}" for row in entry.evaluations]
  while name in present and present[name] != own:
    number += 1
    name = f"{entry.name}_{number}"
  if name not in present:
    _append(entry.curves, [{"run": name, **row} for row in entry.evaluations])
  return name


def _header(path: Path, needed: Sequence[str] = ()) -> list[str]:
  """Returns the columns of a table; raises ConfigError if there is none, or if it lacks a column of `needed`."""
  try:
    columns = next(csv.reader([path.read_text(encoding="utf-8").partition("\n")[0]]), [])
  except OSError as error:
    raise ConfigError(f"reference={path.parent}: {path} cannot be read: {error.strerror}.") from None
  if missing := [column for column in needed if column not in columns]:
    raise ConfigError(f"reference={path.parent}: {path} lacks the column {missing[0]}.")
  return columns


def _append(path: Path, rows: Sequence[Row]) -> None:
  """Adds rows to a CSV atomically, in its columns, without touching the rows that it has."""
  text = path.read_bytes().decode("utf-8")
  write_text(path, text + "\n" * (not text.endswith("\n")) + csv_text(_header(path), rows))
