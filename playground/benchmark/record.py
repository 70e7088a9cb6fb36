"""`playground-bench record`: appends finished or stopped runs to the tables of results/reference."""

import csv
import dataclasses
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from playground.benchmark.arguments import check_limits
from playground.benchmark.schema import commit_of
from playground.catalog import entries
from playground.config import compose
from playground.config.limits import nodes
from playground.config.overrides import SHORT_KEYS
from playground.errors import ConfigError, PlaygroundError
from playground.extras import need
from playground.files import is_locked, lock_holder, locking, need_folder, read_csv, write_text
from playground.learning.checkpoints import find_checkpoints, find_stages
from playground.limits import count
from playground.runs.csv_tracker import OTHER_RETURNS, RETURN, read_table
from playground.runs.run_dir import RunDirectory
from playground.settings import select
from playground.text import format_value

Row = dict[str, Any]
_EPISODES = 20  # in C MuJoCo, of a row that does not say otherwise
_EVAL_ENVS = 128  # episodes of an evaluation, of a row that does not say otherwise
_MEASURED = {  # column -> its column of metrics.csv, and decimals
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
_NOT_OF_SETTING = {  # overrides that have a column of their own, or that change no result
  *("env", "agent", "seed", "experiment", "name", "run_dir", "resume", "trust"),
  *("hardware", "tracking", "video", "visuals", "checkpoint", "profile", "launcher", "search", "sweep", "sweep_dir"),
}
_OF_MANIFEST = ("impl", "platform", "device", "num_devices", "matmul_precision", "network_precision", "versions")
_OF_CONFIG = ("choices.env", "choices.agent", "agent.num_timesteps", "agent.num_eval_envs", "env", "seed")
_PRECISION = {"tensorfloat32": "TF32", "highest": "float32"}


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
    has_pushes: whether the task has interval events.
  """

  run: RunDirectory
  table: Path
  row: Row
  curves: Path
  evaluations: list[Row]
  name: str
  policy: int | None
  has_pushes: bool


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
  columns = _header(table)
  _header(curves)
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
  stage = _stage(run)
  setting, later = _setting(run)
  notes = []
  if deterministic:
    sampled = _fixed(last.get(OTHER_RETURNS["sampled"]), decimals)
    notes.append("evaluated by the policy's mode")
    notes += [f"sampled {sampled}"] * bool(sampled)
  elif "final_mode_return" not in columns and mode:
    notes.append(f"by the policy's mode {_fixed(mode, decimals)}")
  notes += _stopped(run, int(last["step"]), max(policy or 0, int(metrics[-1]["step"])))
  if policy is not None and _millions(policy) != _millions(int(last["step"])):
    notes.append(f"played in C MuJoCo: the policy after {_millions(policy)} M")
  if policy is not None and options.episodes != _EPISODES:
    notes.append(f"{options.episodes} episodes in C MuJoCo")
  commit = commit_of(manifest.get("git"))
  starts = [commit_of(start.get("git")) for start in manifest.get("earlier_starts", [])]
  notes += [f"begun at commit {start}" for start in starts[:1] if start != commit]
  notes += [f"then with {later}"] * bool(later) + [options.note] * bool(options.note)
  row = {
    "task": task,
    "agent": agent,
    "who": "ours",
    "experiment": config["choices"].get("experiment") or "",
    "setting": setting,
    "seed": config["seed"],
    "backend": manifest["impl"],
    "steps": int(last["step"]),
    "final_return": _fixed(last[RETURN], decimals),
    "final_mode_return": _fixed(mode, decimals),
    "return_std": _fixed(last.get(f"{RETURN}_std"), decimals),
    "best_return": _fixed(max(float(row[RETURN]) for row in evaluations if int(row["step"])), decimals),
    "nonfinite": _fixed(sum(float(row.get("training/nonfinite") or 0) for row in metrics), 1),
    "note": "; ".join(notes),
    "devices": manifest["num_devices"],
    "device": "CPU" if manifest["platform"] == "cpu" else manifest["device"],
    "conditions": _conditions(config, manifest, options.machine, commit),
    **{column: _fixed(last.get(metric), digits) for column, (metric, digits) in _MEASURED.items()},
    **(_times(run, manifest) if options.alone else {}),
  }
  name = "_".join(filter(None, (task, agent, f"s{config['seed']}", stage, commit.rstrip("+"))))
  points = list(_points(evaluations, _header(curves), stage, deterministic, options.alone))
  return Entry(run, table, row, curves, points, name, policy, _has_pushes(config["env"]))


def _stage(run: RunDirectory) -> str:
  """Returns the name of a chain's stage, "" for a run of its own."""
  in_chain = (run.path.parent / "config.yaml").is_file()
  return run.path.absolute().name.partition("_")[2] if in_chain else ""


def _setting(run: RunDirectory) -> tuple[str, str]:
  """Returns the overrides that differ from the task's set, and what else differs from today's configuration.

  Where today's configuration does not take the overrides, all of them are the setting. Of a stage, the setting is that
  of its chain.
  """
  stage, config = _stage(run), run.config
  texts = RunDirectory(run.path.parent).overrides if stage else run.overrides
  kept = [text for text in texts if _key_of(text).split(".")[0] not in _NOT_OF_SETTING or _is_value(text)]
  kept = [f"init_from=<{_start(text)}>" if _key_of(text) == "init_from" else text.lstrip("+") for text in kept]
  if stage:
    return " ".join([*kept, f"stage={stage}"]), ""
  choices = config["choices"]
  base = [f"experiment={choices['experiment']}"] if choices.get("experiment") else []
  base += [f"env={choices['env']}", f"agent={choices['agent']}"]
  try:
    default = compose(base).resolved
    same = lambda key: (
      select(config, key) == select(default, key) and ("." in key or choices.get(key) == default["choices"].get(key))
    )
    kept = [text for text in kept if text.startswith(("~", "init_from=")) or not same(_key_of(text))]
    today = compose([*base, *(text for text in kept if not text.startswith("init_from="))]).resolved
  except PlaygroundError as error:
    print(f"{run.path}: its setting has all of its overrides, for today's configuration is another one ({error})")
    return " ".join(kept), ""
  leaves = lambda values: {
    f"{part}.{key}": value for part in ("env", "agent") for key, value in nodes(values[part]) if not _nested(value)
  }
  before, now = leaves(config), leaves(today)
  changed = [key for key in before if key in now and before[key] != now[key]]
  return " ".join(kept), " ".join(f"{key}={format_value(before[key])}" for key in changed)


def _key_of(override: str) -> str:
  key = override.lstrip("+~").partition("=")[0].partition("@")[0]
  return SHORT_KEYS.get(key, key)


def _is_value(override: str) -> bool:
  """Returns whether an override sets a value of the task, the agent, or the number of environments of each device."""
  return _key_of(override).startswith(("env.", "agent.")) or _key_of(override) == "hardware.scale_envs"


def _nested(value: object) -> bool:
  return isinstance(value, Mapping)


def _start(override: str) -> str:
  """Returns the task of the policy in `init_from=`, the name of its folder where there is no longer a run."""
  path = override.partition("=")[2].strip("'\"").removeprefix("pretrained:")
  folders = [Path(path).expanduser(), *Path(path).expanduser().parents]
  started = next((folder for folder in folders if (folder / "config.yaml").is_file()), None)
  return str(select(RunDirectory(started).config, "choices.env")) if started else Path(path).name


def _stopped(run: RunDirectory, evaluated: int, trained: int) -> list[str]:
  """Returns the remark on a run that ended before its budget."""
  if run.status.get("status") == "finished":
    return []
  budget = run.config["agent"]["num_timesteps"]
  late = f", last evaluated after {_millions(evaluated)} M" if _millions(evaluated) != _millions(trained) else ""
  return [f"stopped after {_millions(trained)} of {_millions(budget)} M steps{late}"]


def _millions(steps: float) -> str:
  return f"{steps / 1e6:.0f}" if steps >= 1e7 else f"{steps / 1e6:.3g}"


def _fixed(value: object, decimals: int) -> str:
  """Formats a number; "" for None, an empty cell and NaN."""
  return (
    "" if value in (None, "") or value != value or str(value).lower() == "nan" else f"{float(str(value)):.{decimals}f}"
  )


def _conditions(config: Row, manifest: Row, machine: str | None, commit: str) -> str:
  """Returns machine, versions, precision, commit, and an unusual number of episodes of an evaluation."""
  on_cpu, versions = manifest["platform"] == "cpu", manifest["versions"]
  device = "CPU" if on_cpu else manifest["device"]
  devices = f"{manifest['num_devices']}x {device}" if manifest["num_devices"] > 1 else device
  mujoco, mjx = versions.get("mujoco"), versions.get("mujoco-mjx")
  physics, networks = (
    "float32" if on_cpu else _PRECISION.get(manifest[kind], manifest[kind])
    for kind in ("matmul_precision", "network_precision")
  )
  dtype = select(config, "agent.network.value_dtype")
  critic = ("float32" if on_cpu else "bfloat16") if dtype == "auto" else dtype
  precision = f"physics {physics}, networks {networks}"
  if critic not in (None, "float32"):
    precision += f", critic's hidden activations {critic} but for its first layer"
  count = config["agent"]["num_eval_envs"]
  parts = [
    machine or devices,
    f"Python {versions.get('python')}",
    f"JAX {versions.get('jax')}",
    f"MuJoCo and MJX {mujoco}" if mujoco == mjx else f"MuJoCo {mujoco}, MJX {mjx}",
    *([f"Warp {versions.get('warp-lang')}"] if manifest["impl"] == "warp" or not on_cpu else []),
    precision,
    f"commit {commit or 'unknown'}" + f", {count} episodes an evaluation" * (count != _EVAL_ENVS),
  ]
  return "; ".join(parts)


def _times(run: RunDirectory, manifest: Row) -> Row:
  """Returns the columns of rate and time of a run that had its device to itself."""
  timings, wall_clock = manifest.get("timings", {}), run.summary.get("wall_clock_s")
  whole = None if wall_clock is None or manifest.get("earlier_starts") else timings.get("start_to_compiled_s")
  return {
    "training_steps_per_s": _fixed(timings.get("steady_steps_per_second"), 0),
    "wall_clock_s": _fixed(wall_clock, 1),
    "command_to_end_s": _fixed(None if whole is None else whole + wall_clock, 0),
  }


def _points(
  evaluations: Sequence[Mapping[str, str]], columns: Sequence[str], stage: str, deterministic: bool, alone: bool
) -> Iterator[Row]:
  """Yields the evaluations in the columns of a table of curves."""
  for row in evaluations:
    values = dict(row)
    if deterministic:
      values[OTHER_RETURNS["mode"]] = row[RETURN]
    if not alone:
      values.pop("time/steps_per_second", None)
    numbers = {column: _fixed(values.get(column), 3) for column in columns if column not in ("run", "stage", "step")}
    yield {"stage": stage, "step": row["step"], **numbers}


def _has_pushes(env: Row) -> bool:
  events = [event for event in (env.get("events") or {}).values() if event]
  return any(event.get("mode") == "interval" and event.get("enabled", True) for event in events)


def _played(entry: Entry, episodes: int) -> Row:
  """Plays a run's policy in C MuJoCo, or reads the result of an earlier play, and returns the columns c_mujoco_*."""
  from playground.cli.play import play_scores

  row = {}
  for prefix, interval_events in {"c_mujoco": True, **({"c_mujoco_calm": False} if entry.has_pushes else {})}.items():
    scores = play_scores(entry.run.path, entry.policy or 0, episodes, interval_events)
    row |= {f"{prefix}_{column}": f"{scores[name]:.4g}" for column, name in _IN_C_MUJOCO.items() if name in scores}
  return row


def _key(row: Mapping[str, object]) -> tuple[str, ...]:
  """Returns what two records of the same run have in common."""
  commit = re.search(r"\bcommit (\w+\+?)", str(row["conditions"]))
  columns = ("who", "task", "agent", "experiment", "setting", "seed", "steps")
  return (*(str(row.get(column) or "") for column in columns), commit.group(1) if commit else "")


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


def _header(path: Path) -> list[str]:
  """Returns the columns of a table; raises ConfigError if there is none."""
  try:
    return next(csv.reader([path.read_text(encoding="utf-8").partition("\n")[0]]), [])
  except OSError as error:
    raise ConfigError(f"reference={path.parent}: {path} cannot be read: {error.strerror}.") from None


def _append(path: Path, rows: Sequence[Row]) -> None:
  """Adds rows to a CSV atomically, in its columns, without touching the rows that it has."""
  text, lines = path.read_bytes().decode("utf-8"), io.StringIO()
  csv.DictWriter(lines, _header(path), restval="", extrasaction="ignore", lineterminator="\n").writerows(rows)
  write_text(path, text + "\n" * (not text.endswith("\n")) + lines.getvalue())
