"""Describes a run directory in the columns of the tables of runs: setting, conditions, rate and times."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from playground.benchmark.schema import commit_of
from playground.config import compose
from playground.config.limits import nodes
from playground.config.overrides import SHORT_KEYS
from playground.errors import PlaygroundError
from playground.mdp.terms import MODULES
from playground.runs.run_dir import RunDirectory
from playground.settings import Section, select
from playground.text import format_value

_EVAL_ENVS = 128  # episodes of an evaluation, of a row that does not say otherwise
_OF_SETTING = re.compile(  # keys of the overrides in the setting; others have columns or change no result
  r"(env|agent(?!\.num_eval_envs$)|curriculum|on_nonfinite)\."
  r"|(debug|randomization|robot|tuned|curriculum|init_from|hardware\.scale_envs)$"
)
_PRECISION = {"tensorfloat32": "TF32", "highest": "float32"}


def stage_of(run: RunDirectory) -> str:
  """Returns the name of a chain's stage, "" for a run of its own."""
  in_chain = (run.path.parent / "config.yaml").is_file()
  return run.path.absolute().name.partition("_")[2] if in_chain else ""


def setting_of(run: RunDirectory, stage: str) -> tuple[str, str]:
  """Returns what differs from the task's set of today, and the overrides that have become part of it.

  Where today's configuration does not take the overrides, all of them are the setting. Of a stage, the setting is that
  of its chain.
  """
  config = run.config
  texts = RunDirectory(run.path.parent).overrides if stage else run.overrides
  kept = list({_key_of(text): text.lstrip("+") for text in texts if _OF_SETTING.match(_key_of(text))}.values())
  starts = [f"init_from=<{_start(text)}>" for text in kept if _key_of(text) == "init_from" and config["init_from"]]
  kept = [text for text in kept if _key_of(text) != "init_from"]
  if stage:
    return " ".join([*kept, *starts, f"stage={stage}"]), ""
  choices = config["choices"]
  base = [f"experiment={choices['experiment']}"] * bool(choices.get("experiment"))
  base += [f"env={choices['env']}", f"agent={choices['agent']}"]
  value = lambda values, key: values["choices"].get(key) if key in values["choices"] else select(values, key)
  try:
    default = compose(base).resolved
    same = not _differences(config, default) and _terms(config) == _terms(default)  # whatever the overrides are called
    differ = [t for t in kept if not same and value(config, _key_of(t)) != value(default, _key_of(t))]
    older = _differences(config, compose([*base, *differ]).resolved)
  except PlaygroundError as error:
    print(f"{run.path}: its setting has all of its overrides, for today's configuration is another one ({error})")
    return " ".join([*kept, *starts]), ""
  part = [text for text in kept if text not in differ and _key_of(text) != "tuned"]  # that one a run adds itself
  return " ".join([*differ, *older, *starts]), " ".join(part)


def _differences(config: Section, other: Section) -> list[str]:
  """Returns the values of task and agent that are other ones in `other`, as overrides."""
  known = dict(_leaves(other))
  changed = {key: value for key, value in _leaves(config) if key in known and known[key] != value}
  return [f"{key}={format_value(value)}".replace(", ", ",") for key, value in changed.items()]


def _terms(config: Section) -> set[str]:
  """Returns the keys of the task's terms: one that was removed or added has no value to compare."""
  return {key for key, value in nodes(config["env"]) if key.split(".")[0] in MODULES and isinstance(value, Mapping)}


def _leaves(config: Section) -> Iterator[tuple[str, object]]:
  """Yields the values of task and agent by dotted key, without the episodes of an evaluation, which conditions have."""
  for part in ("env", "agent"):
    for key, value in nodes(config[part]):
      if not isinstance(value, Mapping) and key != "num_eval_envs":
        yield f"{part}.{key}", value


def _key_of(override: str) -> str:
  key = re.split("[=@]", override.lstrip("+~"))[0]
  return SHORT_KEYS.get(key, key)


def _start(override: str) -> str:
  """Returns the task of the policy in `init_from=`, the name of its folder where there is no longer a run."""
  path = override.partition("=")[2].strip("'\"").removeprefix("pretrained:")
  folders = [Path(path).expanduser(), *Path(path).expanduser().parents]
  started = next((folder for folder in folders if (folder / "config.yaml").is_file()), None)
  return str(select(RunDirectory(started).config, "choices.env")) if started else Path(path).name


def notes_on_end(run: RunDirectory, evaluated: int, trained: int, policy: int | None) -> list[str]:
  """Returns remarks on a run that ended before its budget, on a policy that is later than its row, and on its start.

  Args:
    run: the run.
    evaluated: steps of its last evaluation.
    trained: steps that it trained.
    policy: steps of the policy that is played in C MuJoCo; None if none is.
  """
  notes, budget, manifest = [], run.config["agent"]["num_timesteps"], run.manifest
  millions = lambda steps: f"{steps / 1e6:.0f}" if steps >= 1e7 else f"{steps / 1e6:.3g}"
  if run.status.get("status") != "finished" and trained < budget:
    late = f", last evaluated after {millions(evaluated)} M" * (millions(evaluated) != millions(trained))
    notes.append(f"stopped after {millions(trained)} of {millions(budget)} M steps{late}")
  if policy is not None and millions(policy) != millions(evaluated):
    notes.append(f"played in C MuJoCo: the policy after {millions(policy)} M")
  commits = [commit_of(start.get("git")) for start in (*manifest.get("earlier_starts", [])[:1], manifest)]
  return notes + [f"begun at commit {commits[0]}"] * (commits[0] != commits[-1])


def fixed(value: object, decimals: int) -> str:
  """Formats a number; "" for None, an empty cell and NaN."""
  return "" if str(value).lower() in ("", "nan", "none") else f"{float(str(value)):.{decimals}f}"


def conditions_of(config: Section, manifest: Section, machine: str | None, commit: str) -> str:
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


def times_of(run: RunDirectory, manifest: Section) -> dict[str, str]:
  """Returns the columns of rate and time of a run that had its device to itself."""
  timings, wall_clock = manifest.get("timings", {}), run.summary.get("wall_clock_s")
  whole = None if wall_clock is None or manifest.get("earlier_starts") else timings.get("start_to_compiled_s")
  return {
    "training_steps_per_s": fixed(timings.get("steady_steps_per_second"), 0),
    "wall_clock_s": fixed(wall_clock, 1),
    "command_to_end_s": fixed(None if whole is None else whole + wall_clock, 0),
  }
