"""From command line to configuration: finds configs/, composes them with Hydra, checks them, hands out ConfigDicts.

The only file that knows OmegaConf. Nothing here needs JAX, so that a mistake is reported at once.

How a value is chosen, later wins: config.yaml and the chosen option of every group; the tuned set of the pair agent and
env; the experiment; debug; the command line. The options alone are also the schema: what they do not have does not
exist, and what they have fixes each value's type, wherever that value is set.
"""

import dataclasses
import functools
import importlib.metadata
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from ml_collections import ConfigDict
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from playground.errors import ConfigError, UnknownNameError, nearest

if TYPE_CHECKING:
  from rich.tree import Tree

DEFAULT_EXPERIMENT = "quickstart"
ENTRY_POINTS = "playground.tasks"

_SECTIONS = (
  *("env", "agent", "randomization", "curriculum", "hardware", "tracking"),
  *("video", "checkpoint", "on_nonfinite", "profile"),
)
_SCALARS = ("seed", "run_dir", "resume", "init_from")
_DELTAS = ("experiment", "tuned", "debug")  # groups that change what the others define, and define nothing
_RESUMABLE = ("hardware", "tracking", "video")  # what may differ when a run goes on
# Any of these on the command line, and it is not the default run that is meant.
_CHOOSES_A_RUN = {"experiment", "env", "agent", "robot", "curriculum", "resume"}

_PRECISIONS = ("default", "high", "highest", "bfloat16", "tensorfloat32", "float32")
_CHOICES = {
  "env.impl": ("auto", "jax", "warp"),
  "hardware.platform": ("auto", "cpu", "gpu"),
  "hardware.matmul_precision": _PRECISIONS,
  "hardware.network_precision": _PRECISIONS,
}
_PATHS = ("run_dir", "resume", "init_from", "hardware.cache_dir")
_RANGES: tuple[tuple[str, Callable[[float], bool], str], ...] = (
  (
    "above 0",
    lambda x: x > 0,
    "agent.num_timesteps agent.num_evals agent.num_envs agent.num_eval_envs agent.unroll_length agent.batch_size "
    "agent.num_minibatches agent.num_updates_per_batch agent.learning_rate agent.max_grad_norm agent.clipping_epsilon "
    "agent.clipping_epsilon_value env.ctrl_dt env.sim_dt env.episode_length env.action_repeat checkpoint.keep "
    "video.every_evals video.episodes video.width video.height hardware.devices profile.steps",
  ),
  ("0 or more", lambda x: x >= 0, "seed agent.num_resets_per_eval agent.entropy_cost agent.vf_loss_coefficient"),
  (
    "between 0 and 1",
    lambda x: 0 <= x <= 1,
    "agent.discounting agent.gae_lambda hardware.memory_fraction on_nonfinite.max_fraction",
  ),
)


Section = Any  # a ConfigDict; pyright cannot know its attributes


@dataclasses.dataclass(frozen=True)
class RunConfig:
  """A run's whole configuration, checked. The sections are those of `configs/`, every value resolved.

  Attributes:
    name: the experiment, or the task if there is none.
    run_dir: where the run lives; without `run_dir` or `resume` a new name from the time of composing, which `resolved`
      leaves null.
    choices: the option of each group, None where none is chosen.
    overrides: the command line in Hydra's form, numbers in their final type, the default experiment spelt out.
    resolved: all of it as plain dicts, lists and scalars; what `config.yaml` in the run directory holds.
  """

  name: str
  env: Section
  agent: Section
  randomization: Section
  curriculum: Section
  hardware: Section
  tracking: Section
  video: Section
  checkpoint: Section
  on_nonfinite: Section
  profile: Section
  seed: int
  run_dir: str | None
  resume: str | None
  init_from: str | None
  choices: dict[str, Any]
  overrides: tuple[str, ...]
  resolved: dict[str, Any]


class _Override(NamedTuple):
  """One `key=value` of the command line; the value of a group that is switched off is None."""

  key: str
  value: Any
  is_group: bool
  text: str


def compose(overrides: Sequence[str] = (), config_dir: Path | None = None) -> RunConfig:
  """Composes the configuration of a run.

  Args:
    overrides: as on the command line, `env=CartpoleBalance`, `agent.num_envs=1024`.
    config_dir: the folder that holds config.yaml, by default the one we ship.

  Raises:
    ConfigError: whatever cannot work, in one sentence.
    UnknownNameError: a group, option or key that does not exist.
  """
  roots = config_roots(config_dir)
  ours = [text for text in overrides if not text.lstrip("+~").startswith(("hydra.", "hydra/"))]
  parsed = [_parse(text, roots) for text in with_default_experiment(ours, config_dir)]
  given = {o.key: o.value for o in parsed}
  for key in ("resume", "init_from"):
    if given.get(key) is not None:
      _check_path(key, given[key])
  if given.get("resume") is not None:
    return _compose_resumed(Path(given["resume"]), parsed, roots)

  config, choices = _hydra(_group_overrides(parsed), roots)
  schema, _ = _hydra([f"{g}={c}" for g, c in choices.items() if c and g not in _DELTAS] + _without(*_DELTAS), roots)
  _check_robot(config, choices, roots)
  resolved = _apply(config, [o for o in parsed if not o.is_group], _plain(schema))
  _check_values(resolved)
  name = choices.get("experiment") or choices["env"]
  head = {"name": name, "choices": choices}
  ordered = {key: resolved[key] for key in (*_SCALARS, *_SECTIONS) if key in resolved}
  run_config = from_dict({**head, **ordered, **resolved}, _canonical(parsed, resolved))
  run_dir = run_config.run_dir or f"results/{name}/{datetime.now():%Y-%m-%d_%H-%M-%S}"
  return dataclasses.replace(run_config, run_dir=run_dir)


def from_dict(resolved: Mapping[str, Any], overrides: Sequence[str] = ()) -> RunConfig:
  """Rebuilds a configuration from its `resolved` dict, e.g. a run directory's config.yaml.

  Raises:
    ConfigError: a part is missing, so this is not a run's configuration.
  """
  resolved = dict(resolved)
  if missing := [key for key in ("name", "choices", *_SECTIONS, *_SCALARS) if key not in resolved]:
    raise ConfigError(f"This is not the configuration of a run: it lacks {', '.join(missing)}.")
  return RunConfig(
    name=resolved["name"],
    **{key: ConfigDict(resolved[key]) for key in _SECTIONS},
    **{key: resolved[key] for key in _SCALARS},
    choices=dict(resolved["choices"]),
    overrides=tuple(overrides),
    resolved=resolved,
  )


def load(path: Path) -> RunConfig:
  """Reads a saved config.yaml; raises ConfigError if it is not one."""
  try:
    resolved = OmegaConf.to_container(OmegaConf.load(path))
  except (OSError, ValueError, YAMLError, OmegaConfBaseException) as error:
    raise ConfigError(f"{path} cannot be read: {_first_line(error)}.") from None
  if not isinstance(resolved, dict):
    raise ConfigError(f"{path} is not the configuration of a run.")
  return from_dict(resolved)  # pyright: ignore[reportArgumentType]


def to_yaml(config: RunConfig) -> str:
  """The resolved configuration as YAML, which `load` reads."""
  return OmegaConf.to_yaml(OmegaConf.create(config.resolved))


def tree(config: RunConfig) -> "Tree":
  """The configuration as a tree for printing with rich."""
  from rich.text import Text
  from rich.tree import Tree

  def grow(branch: Tree, node: Mapping[str, Any]) -> Tree:
    for key, value in node.items():
      if isinstance(value, Mapping) and value:
        grow(branch.add(Text(str(key), style="bold")), value)
      else:
        branch.add(Text.assemble((f"{key}: ", "cyan"), format_value(value)))
    return branch

  return grow(Tree(Text(config.name, style="bold")), {k: v for k, v in config.resolved.items() if k != "name"})


def override_section(section: str, default: Section, overrides: Mapping[str, Any]) -> dict[str, Any]:
  """Returns a section, e.g. env, with dotted keys such as `reward.scales.energy` replaced, checked as in `compose`."""
  schema = {section: _plain(default)}
  parsed = [_Override(f"{section}.{key}", value, False, "") for key, value in overrides.items()]
  resolved = _apply(OmegaConf.create(schema), parsed, schema)
  _check_values(resolved)
  return resolved[section]


# Files


def config_roots(config_dir: Path | None = None) -> list[Path]:
  """Folders that hold groups: ours (in the wheel beside this file, else the checkout's), then outside packages'."""
  here = Path(__file__).parent
  inside = here / "configs"
  return [(config_dir or (inside if inside.is_dir() else here.parent / "configs")).resolve(), *_outside_roots()]


def options(group: str, roots: Iterable[Path] | None = None) -> list[str]:
  """Names of a group's options, sorted; files whose name begins with an underscore are parts that options share."""
  folders = [root / group for root in (config_roots() if roots is None else roots)]
  files = [(path, folder) for folder in folders for path in folder.rglob("*.yaml") if not path.stem.startswith("_")]
  return sorted({path.relative_to(folder).with_suffix("").as_posix() for path, folder in files})


def task_names(roots: Iterable[Path] | None = None) -> list[str]:
  """Options of env that are tasks, in CamelCase; the others need a robot to become one."""
  return [name for name in options("env", roots) if name[0].isupper()]


@functools.cache
def _outside_roots() -> tuple[Path, ...]:
  """Folders of outside packages, by entry point; one that is broken is skipped with a warning, once."""
  roots = []
  for point in importlib.metadata.entry_points(group=ENTRY_POINTS):
    try:
      target = point.load()
      root = Path(str(target() if callable(target) else target))
      if root.suffix == ".yaml":  # <root>/env/<Task>.yaml
        root = root.parent.parent
      if not any((root / "env").glob("*.yaml")):
        raise FileNotFoundError(f"{root} holds no env/<TaskName>.yaml")
      roots.append(root.resolve())
    except Exception as error:  # whatever an outside package does wrong, ours go on working
      warnings.warn(f"Entry point {point.name!r} of {ENTRY_POINTS} is skipped: {_first_line(error)}", stacklevel=2)
  return tuple(dict.fromkeys(roots))


def search_path_override(roots: Sequence[Path]) -> list[str]:
  """The override that makes Hydra look into outside packages' folders too."""
  quoted = ", ".join("'" + f"file://{root}".replace("'", "\\'") + "'" for root in roots[1:])
  return [f"hydra.searchpath=[{quoted}]"] if quoted else []


# Overrides


def with_default_experiment(overrides: Sequence[str], config_dir: Path | None = None) -> list[str]:
  """Adds the default experiment if the command line chooses no run of its own."""
  chosen = {re.split(r"[=@]", text.lstrip("+~"))[0] for text in overrides}
  available = (config_roots(config_dir)[0] / "experiment" / f"{DEFAULT_EXPERIMENT}.yaml").is_file()
  return [f"experiment={DEFAULT_EXPERIMENT}"] * (available and not chosen & _CHOOSES_A_RUN) + list(overrides)


def _parse(text: str, roots: Sequence[Path]) -> _Override:
  try:
    parsed = OverridesParser.create().parse_override(text)
  except HydraException:
    example = "such as env=CartpoleBalance or agent.num_envs=1024 (quote a value with special characters)"
    raise ConfigError(f"{text!r} is not an override: write key=value, {example}.") from None
  key, groups = parsed.key_or_group, _groups(roots)
  if parsed.is_sweep_override():
    raise ConfigError(f"{text} names several values, which is a sweep: add -m, or quote the value.")
  is_group = key in groups and parsed.package is None
  value = parsed.value()
  if parsed.is_delete():
    if not is_group:
      raise ConfigError(f"{text}: a key cannot be removed, set another value.")
    value = None
  if is_group and (value is not None or key not in ("robot", *_DELTAS)):
    for option in value if isinstance(value, list) and key in _DELTAS else [value]:
      _check_option(key, option, roots)
  return _Override(key if parsed.package is None else f"{key}@{parsed.package}", value, is_group, text.lstrip("+"))


def _groups(roots: Sequence[Path]) -> list[str]:
  return sorted({folder.name for root in roots for folder in root.iterdir() if folder.is_dir()})


def _check_option(group: str, option: Any, roots: Sequence[Path]) -> None:
  known = options(group, roots)
  if option in known:
    return
  shown = task_names(roots) if group == "env" else known
  allowed = ", ".join(shown) if len(shown) <= 12 else f"the {len(shown)} that `playground list` shows"
  raise UnknownNameError(
    f"{group}={format_value(option)} does not exist: choose from {allowed}.{nearest(str(option), shown)}"
  )


def _group_overrides(parsed: Iterable[_Override]) -> list[str]:
  """Hydra knows no group=null: switching a group off is removing it."""
  return [f"~{o.key}" if o.value is None else f"{o.key}={format_value(o.value)}" for o in parsed if o.is_group]


def _without(*groups: str) -> list[str]:
  return [f"~{group}" for group in groups]


def _canonical(parsed: Iterable[_Override], resolved: Mapping[str, Any]) -> list[str]:
  """Overrides for Hydra's own use: as typed, but with groups that are off and numbers in the form that it takes."""
  config = OmegaConf.create(dict(resolved))
  lines = []
  for override in parsed:
    if override.is_group:
      lines += _group_overrides([override])
    elif isinstance(override.value, int | float):
      lines.append(f"{override.key}={format_value(OmegaConf.select(config, override.key))}")
    else:
      lines.append(override.text)
  return lines


# Composition


def _hydra(overrides: Sequence[str], roots: Sequence[Path]) -> tuple[DictConfig, dict[str, str | None]]:
  """Hydra's composition, and what it chose for each group."""
  outer = GlobalHydra.instance().hydra  # the app's, when this is a job of a sweep: Hydra allows one at a time
  GlobalHydra.instance().clear()
  try:
    with hydra.initialize_config_dir(str(roots[0]), version_base="1.3"):
      lines = [*overrides, *search_path_override(roots)]
      config = hydra.compose("config", overrides=lines, return_hydra_config=True)
      chosen = dict(config.hydra.runtime.choices)
  except (HydraException, YAMLError, OmegaConfBaseException) as error:
    files = " ".join(o for o in overrides if not o.startswith("~"))
    raise ConfigError(f"The files of {files or 'config.yaml'} do not compose: {_first_line(error)}.") from None
  finally:
    GlobalHydra.instance().hydra = outer
  OmegaConf.set_struct(config, False)
  del config["hydra"]
  choices = {group: chosen.get(group) for group in _groups(roots)}
  if choices.get("tuned") not in options("tuned", roots):  # it is optional, and this pair has none
    choices["tuned"] = None
  return config, choices


def _apply(config: DictConfig, overrides: Iterable[_Override], schema: Mapping[str, Any]) -> dict[str, Any]:
  """Sets values, resolves, and checks the whole against the schema."""
  try:
    for override in overrides:
      _check_key(override.key, schema)
      OmegaConf.update(config, override.key, override.value, merge=isinstance(override.value, Mapping))
    if missing := OmegaConf.missing_keys(config):
      raise ConfigError(f"{min(missing)} has no value: set {min(missing)}=<value>.")
    return _fit(OmegaConf.to_container(config, resolve=True), schema, "")
  except OmegaConfBaseException as error:
    raise ConfigError(f"{_first_line(error)}.") from None


def _compose_resumed(run: Path, parsed: Sequence[_Override], roots: Sequence[Path]) -> RunConfig:
  """The configuration of a run that goes on: its own, but for the sections that may differ."""
  _check_resumable(run, parsed)
  saved = load(run / "config.yaml").resolved
  fresh, choices = _hydra(_group_overrides(parsed), roots)
  schema = _plain(fresh)
  chosen = {o.key for o in parsed if o.is_group}
  sections = {s: schema[s] if s in chosen else saved[s] for s in _RESUMABLE}
  values = [o for o in parsed if not o.is_group and o.key != "resume"]
  changed = _apply(OmegaConf.create(sections), values, {s: schema[s] for s in sections})
  resolved = {**saved, **changed, "resume": str(run), "run_dir": str(run), "init_from": None}
  resolved["choices"] = {**saved["choices"], **{group: choices[group] for group in chosen}}
  _check_values(resolved)
  return from_dict(resolved, _canonical(parsed, resolved))


def _check_resumable(run: Path, parsed: Iterable[_Override]) -> None:
  """A resumed run ends as if it had never stopped, so nothing that changes its numbers may change."""
  for override in parsed:
    if override.key == "init_from":
      what = "resume continues a run exactly, init_from starts a new one from its weights"
      raise ConfigError(f"{override.text} and resume={run} exclude each other: {what}.")
    if override.key.split(".")[0] not in ("resume", *_RESUMABLE):
      what = f"which continues exactly that run and takes only {', '.join(_RESUMABLE)}"
      instead = f"init_from={run} starts a new run from its weights"
      raise ConfigError(f"{override.text} cannot be given with resume, {what}; {instead}.")


# Checks


def _check_path(key: str, value: Any) -> None:
  path = Path(str(value))
  wanted, what = (path / "config.yaml", "run directory") if key == "resume" else (path, "run directory or checkpoint")
  if not wanted.exists():
    siblings = [p.name for p in path.parent.iterdir() if p.is_dir()] if path.parent.is_dir() else []
    raise ConfigError(f"{key}={value} is no {what}: {wanted} does not exist.{nearest(path.name, siblings)}")


def _check_robot(config: DictConfig, choices: Mapping[str, str | None], roots: Sequence[Path]) -> None:
  """A task that names a robot gets one, and one that names none gets none."""
  env, robot = choices["env"], choices.get("robot")
  robots = ", ".join(options("robot", roots))
  if OmegaConf.is_missing(config.env, "robot"):
    raise ConfigError(f"env={env} needs a robot: add robot=<name>, one of {robots}.")
  if robot is not None:
    own, chosen = _hydra([f"env={env}", *_without(*_DELTAS)], roots)
    # `in` would be false for a mandatory robot that nobody has set
    if not chosen.get("robot") and "robot" not in list(own.env):
      raise ConfigError(f"robot={robot}: env={env} takes no robot, leave robot= out.")


def _check_key(key: str, schema: Mapping[str, Any]) -> None:
  """Raises, with what is there instead, if the schema has no such dotted key."""
  node: Any = schema
  parts = key.split(".")
  for i, part in enumerate(parts):
    if isinstance(node, list) and part.isdigit() and int(part) < len(node):
      node = node[int(part)]
    elif isinstance(node, Mapping) and part in node:
      node = node[part]
    else:
      raise _unknown_key(key, ".".join(parts[:i]), part, node, schema)


def _unknown_key(key: str, parent: str, part: str, node: Any, schema: Mapping[str, Any]) -> UnknownNameError:
  if not isinstance(node, Mapping):
    what = f"a list of {len(node)}" if isinstance(node, list) else "a single value"
    return UnknownNameError(f"{key} does not exist: {parent} is {what}.")
  known = [str(k) for k in node] if parent else [*schema, "robot", *_DELTAS]
  near = _nearest_in(parent, part, known)
  if not near and not parent:  # perhaps only the section is missing
    near = nearest(part, _keys(schema))
  has = f"has {', '.join(known)}" if len(known) <= 12 or not near else f"has {len(known)} keys (--cfg job shows them)"
  return UnknownNameError(f"{key} does not exist: {parent or 'the configuration'} {has}.{near}")


def _keys(node: Any, prefix: str = "") -> Iterable[str]:
  """Dotted names of everything in a nested mapping."""
  if isinstance(node, Mapping):
    for key, value in node.items():
      yield f"{prefix}{key}"
      yield from _keys(value, f"{prefix}{key}.")


def _fit(value: Any, default: Any, key: str) -> Any:
  """Returns the value in the type of its default; raises if it cannot be, or if a key is in the value only."""
  if isinstance(default, Mapping) and default:
    if not isinstance(value, Mapping):
      raise _wrong_type(key, value, f"a mapping with the keys {', '.join(map(str, default))}")
    for name in value:
      if name not in default:
        dotted = f"{key}.{name}".lstrip(".")
        near = _nearest_in(key, str(name), default)
        raise UnknownNameError(f"{dotted}, set by a chosen file or mapping, does not exist.{near}")
    return {name: _fit(value[name], default[name], f"{key}.{name}".lstrip(".")) for name in value}
  if default is None:
    if isinstance(value, Mapping):
      raise _wrong_type(key, value, "a single value, a list or null")
    return value
  if isinstance(default, list) and isinstance(value, list):
    kinds = {float if float in map(type, default) and type(d) is int else type(d) for d in default}
    scalars = len(kinds) == 1 and kinds <= {bool, int, float, str}
    sample = next((d for d in default if type(d) is float), default[0]) if scalars else None
    return [_fit(v, sample, f"{key}[{i}]") for i, v in enumerate(value)] if scalars else value
  number = isinstance(value, int | float) and not isinstance(value, bool) and value == value  # not NaN
  if isinstance(default, bool):
    fits, kind = isinstance(value, bool), "true or false"
  elif isinstance(default, int):
    fits, kind = number and float(value).is_integer(), "a whole number"
  elif isinstance(default, float):
    fits, kind = number, "a number"
  elif isinstance(default, str):
    fits, kind = isinstance(value, str), "text"
  else:
    fits, kind = isinstance(value, type(default)), "a list" if isinstance(default, list) else "a mapping"
  if not fits:
    raise _wrong_type(key, value, f"{kind}, as its default {format_value(default)} is")
  return type(default)(value) if isinstance(default, int | float) else value


def _wrong_type(key: str, value: Any, allowed: str) -> ConfigError:
  return ConfigError(f"{key}={format_value(value)} has the wrong type: it must be {allowed}.")


def _check_values(resolved: Mapping[str, Any]) -> None:
  """Checks what types cannot say: choices, ranges and sizes that must divide."""
  config = OmegaConf.create(dict(resolved))

  def get(key: str) -> Any:
    return OmegaConf.select(config, key)

  for key, allowed in _CHOICES.items():
    if get(key) is not None and get(key) not in allowed:
      near = nearest(str(get(key)), allowed)
      raise ConfigError(f"{key}={format_value(get(key))} is unknown: choose from {', '.join(allowed)}.{near}")
  for key in _PATHS:
    if get(key) is not None and not isinstance(get(key), str):
      raise _wrong_type(key, get(key), "text (put quotes around a number)")
  for what, holds, keys in _RANGES:
    for key in keys.split():
      value = get(key)
      if value is not None and (isinstance(value, str | bool) or not holds(value)):
        raise ConfigError(f"{key}={format_value(value)} must be a number {what}.")
  sizes = [get(f"agent.{key}") for key in ("num_envs", "batch_size", "num_minibatches")]
  if None not in sizes and (sizes[1] * sizes[2]) % sizes[0]:
    product = f"agent.batch_size * agent.num_minibatches = {sizes[1]} * {sizes[2]} = {sizes[1] * sizes[2]}"
    raise ConfigError(f"agent.num_envs={sizes[0]} does not divide {product}: choose sizes so that it does.")


# Small helpers


def _nearest_in(parent: str, name: str, known: Iterable[Any]) -> str:
  """As `nearest`, with the whole dotted key."""
  return nearest(name, map(str, known)).replace("'", f"'{parent}." if parent else "'", 1)


def _plain(config: Any) -> Any:
  """Plain dicts and lists, interpolations resolved."""
  config = config.to_dict() if isinstance(config, ConfigDict) else config
  return OmegaConf.to_container(config if isinstance(config, DictConfig) else OmegaConf.create(config), resolve=True)


def format_value(value: Any) -> str:
  """A value as one would write it on the command line."""
  if value is None or isinstance(value, bool):
    return {None: "null", True: "true", False: "false"}[value]
  if isinstance(value, Mapping):
    return "{" + ", ".join(f"{k}: {format_value(v)}" for k, v in value.items()) + "}"
  return f"[{', '.join(map(format_value, value))}]" if isinstance(value, list | tuple) else str(value)


def _first_line(error: Exception) -> str:
  return (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")
