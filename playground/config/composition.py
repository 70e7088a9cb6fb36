"""Composes a configuration: Hydra composes the files, the command line wins over them, everything is checked."""

import contextlib
import copy
import dataclasses
import functools
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from hydra.types import RunMode
from ml_collections import ConfigDict
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from playground.config.chains import (
  SINGLE_RUN,
  budget,
  check_chain,
  in_stage,
  resets_per_eval,
  stage_folders,
  stage_overrides,
)
from playground.config.definitions import (
  RunSettings,
  base_agents,
  chosen_names,
  defined,
  register,
  register_experiments,
  register_sections,
)
from playground.config.files import (
  DELTAS,
  Delta,
  config_roots,
  delta,
  find_file,
  groups,
  lineage,
  options,
  read,
  search_path_override,
  task_experiments,
)
from playground.config.limits import check_limits, check_vision
from playground.config.overrides import (
  Override,
  canonical,
  group_overrides,
  is_hydras,
  is_of_sweep,
  parse,
  with_default_experiment,
)
from playground.config.run_config import SCALARS, SECTIONS, RunConfig, from_dict, load
from playground.config.schema import check_key, check_removed, fit, is_term, is_terms, unknown_term
from playground.config.sweep_options import GridConfig, SlurmConfig, SweepSettings
from playground.envs.options import TermsConfig
from playground.errors import ConfigError, PlaygroundError, nearest
from playground.hardware.options import HardwareConfig
from playground.learning.hyperparameters import MOST_EVALS, config_class
from playground.mdp.options import is_model_field
from playground.pretrained import locate
from playground.settings import Plain, Section, build, defaults, nodes, select
from playground.text import first_line, format_value, join, wrong_type

_RESUMABLE = ("hardware", "tracking", "video")  # sections that may differ in a resumed run
_NUMERICS = ("matmul_precision", "network_precision", "xla_flags")  # of `hardware`: results depend on them
_BUDGET = "agent.num_timesteps"  # may be larger in one
_DEFAULTING = ("robot", "agent", "hardware", "tracking", "env")  # groups that define the keys, in this order
_SWEEP_SECTIONS = ("launcher", "search")
_HARDWARE = defaults(HardwareConfig)
CHOSEN_BY_GROUP = ("agent.name", "launcher.name", "search.name", "env.robot.name")
_PACKAGES = {"randomization": "env.events", "tuned": "_global_", "debug": "_global_", "experiment": "_global_"}
_REMEDIES = {  # of mistakes in files, by what Hydra says of them
  r"In '([^']+)': Could not override '\w+@(?!env\.)": r"the first line of \1.yaml must be `# @package _global_`",
  r"In '([^']+)': Could not override 'robot@env\.": r"in \1.yaml write `override /robot@_global_.robot: <name>`",
  r"Could not find 'debug/sizes/_([^']+)'": r"debug=fast needs configs/debug/sizes/_\1.yaml in the package of agent=\1",
}
_NO_DELTAS = [f"~{group}" for group in DELTAS]


def compose(overrides: Sequence[str] = (), config_dir: Path | None = None) -> RunConfig:
  """Composes the configuration of a run and, if that is a chain, of each of its stages.

  Args:
    overrides: as on the command line, `env=CartpoleBalance`, `agent.num_envs=1024`.
    config_dir: the folder that holds config.yaml, by default the one we ship.

  Raises:
    ConfigError: an invalid value, in one sentence.
    UnknownNameError: a group, option or key that does not exist.
  """
  if isinstance(overrides, str):
    raise ConfigError(f"compose takes a list of overrides: compose([{overrides!r}]).")
  return compose_all([overrides], config_dir)[0]


def compose_all(runs: Iterable[Sequence[str]], config_dir: Path | None = None) -> list[RunConfig]:
  """Composes many runs as `compose` does one; files that several of them choose are composed once.

  Raises:
    ConfigError: as `compose`, for the first invalid run; of several runs the message names it.
  """
  roots, runs = config_roots(config_dir), list(runs)
  files = functools.cache(functools.partial(_compose_files, roots))
  configs = []
  for run in runs:
    try:
      configs.append(_compose(with_default_experiment(run, config_dir), files, roots))
    except PlaygroundError as error:
      raise error if len(runs) == 1 else type(error)(f"Job {' '.join(run)}: {error}") from error
  return configs


def compose_settings(overrides: Sequence[str]) -> SweepSettings:
  """Composes the settings of a sweep: `sweep_dir`, `on_error`, and the sections `launcher` and `search`.

  Raises:
    ConfigError: as `compose`.
  """
  roots = config_roots()
  parsed = [parse(text, roots) for text in overrides]
  config, _ = _hydra(group_overrides(parsed), roots, "sweep")
  resolved = _apply(copy.deepcopy(config), [o for o in parsed if not o.is_group], _plain(config))
  check_limits(resolved)
  chosen = {key: resolved[key] for key in _SWEEP_SECTIONS}
  sections = {key: build(defined()[key][section["name"]], section) for key, section in chosen.items()}
  launcher, search = sections["launcher"], sections["search"]
  if isinstance(launcher, SlurmConfig) and not launcher.wait and not isinstance(search, GridConfig):
    raise ConfigError("launcher.wait=false submits all jobs at once, but a search draws them one after another.")
  return SweepSettings(**resolved | sections, resolved=resolved)


def _compose(overrides: Sequence[str], files: "Callable[..., _Files]", roots: Sequence[Path]) -> RunConfig:
  parsed = [parse(text, roots) for text in overrides if not is_hydras(text)]
  if about := [o.text for o in parsed if is_of_sweep(o.key)]:
    what = "stands for many runs" if about[0].startswith("sweep=") else "is about a sweep"
    raise ConfigError(f"{about[0]} {what}: add -m, as in `playground-run -m {about[0]}`.")
  given: dict[str, Plain] = {o.key: o.value for o in parsed}
  for key in ("resume", "init_from"):
    if given.get(key) is not None:
      given[key] = _resolve(key, given[key])
      _check_path(key, given[key])
  if given.get("resume") is not None:
    return _compose_resumed(Path(os.path.expanduser(str(given["resume"]))), parsed, roots)
  config = _compose_new(parsed, files, roots)
  stages = stage_overrides(config.curriculum, parsed, roots)
  composed = tuple(_compose_stage(config, name, theirs, files, roots) for name, theirs in stages)
  run_dir = config.run_dir or f"results/{config.name}/{datetime.now():%Y-%m-%d_%H-%M-%S}"
  return dataclasses.replace(config, run_dir=run_dir, stages=composed)


def register_options(roots: Sequence[Path] | None = None) -> None:
  """Registers with Hydra the options that have no file: those of classes, and an experiment for each task."""
  roots = config_roots() if roots is None else roots
  register_sections()
  register_experiments(task_experiments(roots))
  for group, classes in defined().items():
    register(group, [name for name in classes if find_file(group, name, roots) is None])


def override_section(section: str, default: Section | ConfigDict, overrides: Section) -> dict[str, Plain]:
  """Returns a section, e.g. env, with values replaced by dotted key (`action_scale`), checked as in `compose`."""
  given = {f"{section}.{key}": value for key, value in overrides.items()}
  return _replaced(section, default, [Override(k, v, False, f"{k}={format_value(v)}") for k, v in given.items()])


def override_task(env: Section | ConfigDict, overrides: Sequence[str]) -> dict[str, Plain]:
  """Returns a section env with values replaced by a command line (`env.action_scale=0.3`, `terrain=stairs`).

  `randomization=<name>` replaces all events that draw fields of the model.

  Raises:
    ConfigError: an invalid value, or an override of another group or section.
  """
  roots = config_roots()
  parsed, values = [parse(text, roots) for text in overrides], _plain(env)
  for override in parsed:
    if override.is_group and override.key == "randomization" and override.value is not None:
      drawn = _plain(_hydra(group_overrides([override]), roots)[0])["env"]["events"]
      own = {name: event for name, event in values.get("events", {}).items() if not is_model_field(name, event)}
      values["events"] = drawn | own
    elif override.is_group or not override.key.startswith("env."):
      raise ConfigError(
        f"{override.text}: a trained policy takes other values of `env` only, such as env.episode_length=500, and "
        "randomization=<name>."
      )
  return _replaced("env", values, [override for override in parsed if not override.is_group])


def _replaced(section: str, default: Section | ConfigDict, overrides: Sequence[Override]) -> dict[str, Plain]:
  schema = {section: _plain(default)}
  resolved = _apply(_literal(schema), overrides, schema)
  check_limits(resolved)
  return resolved[section]


def from_saved(resolved: Section) -> RunConfig:
  """Rebuilds the configuration of a run that an earlier version may have saved: keys it lacks get today's defaults.

  Terms of the task (rewards, observations, noise) stay as saved. Settings of the machine that only a command line can
  set get today's defaults.

  Raises:
    ConfigError: a section is missing, or a value is invalid or has another type than its default.
  """
  saved = from_dict(resolved)
  roots = config_roots()
  chosen = [
    f"{group}={saved.choices[group]}"
    for group in _DEFAULTING
    if saved.choices.get(group) in options(group, roots)  # an option that is gone has no defaults
  ]
  today = _plain(_hydra(chosen, roots)[0])
  filled = {
    section: _fit_saved(saved.resolved[section], today[section], section, chosen_names(today)) for section in SECTIONS
  }
  check_limits(filled)
  hardware = filled["hardware"]  # keys that only a command line sets, see `is_of_command`
  hardware["cache_dir"] = today["hardware"]["cache_dir"]
  hardware["distributed"] = {**hardware["distributed"], "coordinator": today["hardware"]["distributed"]["coordinator"]}
  return from_dict({**saved.resolved, **filled}, saved.overrides)


def saved_section(section: str, saved: Section, default: Section) -> dict[str, Plain]:
  """Returns a saved section, e.g. env: missing keys get today's defaults, present keys are checked.

  Raises:
    ConfigError: an invalid value, or one of another type than its default.
  """
  fitted = _fit_saved(saved, default, section, {})
  check_limits({section: fitted})
  return fitted


def _fit_saved(saved: Plain, default: Plain, key: str, names: Mapping[str, object]) -> Plain:
  """As `fit`, but missing keys are taken from the default, and unknown keys stay as they are."""
  if not (isinstance(default, Mapping) and default and isinstance(saved, Mapping)) or is_terms(key):
    return fit(saved, default, names, key)
  fitted = {
    name: _fit_saved(saved[name], value, join(key, name), names) if name in saved else value
    for name, value in default.items()
  }
  return {**saved, **fitted}


class _Files(NamedTuple):
  """The result of the files for a choice of groups: values, option of each group, existing keys."""

  config: DictConfig
  choices: dict[str, str | None]
  schema: dict[str, Plain]
  added: tuple[Override, ...]  # our own choice


def _compose_files(roots: Sequence[Path], *groups: str) -> _Files:
  """Composes the files."""
  (config, choices), added = _hydra(groups, roots), ()
  agents, tasks = (lineage(group, str(choices[group]), roots) for group in ("agent", "env"))
  agents += base_agents(str(config.agent.name))
  sets = [f"{agent}/{task}" for agent in agents for task in tasks]
  named = any(text.lstrip("~").partition("=")[0] == "tuned" for text in groups)
  if not named and choices["tuned"] is None and (there := [name for name in sets if name in options("tuned", roots)]):
    added = (parse(f"tuned={there[0]}", roots),)  # ppo_v020 without a set of its own takes ppo_paper's, then ppo's
    config, choices = _hydra([*groups, *group_overrides(added)], roots)
  for group, package in _PACKAGES.items():
    if group in config:  # where Hydra puts a file that does not say otherwise
      chosen = choices.get(group) or "<name>"
      raise ConfigError(f"{group}={chosen}: the first line of each of its files must be `# @package {package}`.")
  changes = _changes(groups, choices, roots)
  if "robot" in changes.groups or not changes.is_known or any(text.startswith("robot=") for text in groups):
    _check_robot(choices, roots)
  if OmegaConf.is_missing(config.env, "robot"):
    if robot := choices.get("robot"):
      raise ConfigError(f"robot={robot}: the first line of its file must be `# @package env.robot`.")
    raise ConfigError(
      f"env={choices['env']} needs a robot: add robot=<name>, one of {', '.join(options('robot', roots))}."
    )
  _check_removed_in_files(config, str(choices["env"]), [*groups, *group_overrides(added)], roots)
  return _Files(config, choices, _schema(config, choices, changes, roots), added)


def _check_removed_in_files(config: DictConfig, task: str, overrides: Sequence[str], roots: Sequence[Path]) -> None:
  """Raises UnknownNameError if a file removes a term, or a group of observations, that no file has."""
  terms = {key: value for key, value in nodes({"env": OmegaConf.to_container(config.env)}) if is_term(key)}
  left = [key for key, value in terms.items() if value is None]

  def files() -> Iterator[tuple[str, Section]]:
    """Yields package and content of the task's files, which mostly suffice, then of all files."""
    yield from (("env", read("env", name, roots)) for name in lineage("env", task, roots))
    with _initialized(roots):
      lines = [*overrides, *search_path_override(roots)]
      listed = GlobalHydra.instance().config_loader().compute_defaults_list("config", lines, RunMode.RUN).defaults
    for default in listed:
      group, _, option = str(default.config_path).partition("/")
      yield default.package, read(group, option, roots)

  for package, content in files() if left else ():
    inside = lambda key, package=package: key.removeprefix(f"{package}." if package else "")
    left = [key for key in left if select(content, inside(key)) is None]
    if not left:
      return
  if left:
    parent = left[0].rpartition(".")[0]
    beside = [key for key in terms if key.rpartition(".")[0] == parent and key not in left]
    raise unknown_term(left[0], [key.removeprefix(f"{parent}.") for key in beside])


def _changes(groups: Iterable[str], choices: Mapping[str, str | None], roots: Sequence[Path]) -> Delta:
  """Returns the changes of the chosen options of `DELTAS`; unknown for several options of a group (`debug=[a,b]`)."""
  found = Delta(is_known=not any("=[" in text for text in groups))
  for group in DELTAS:
    if option := choices.get(group):
      found |= delta(group, option, roots)
  return found


def _schema(
  config: DictConfig, choices: Mapping[str, str | None], changes: Delta, roots: Sequence[Path]
) -> dict[str, Plain]:
  """Returns the existing keys, with values that fix their types.

  Most sections have a class. The others are as composed, but without the changes of `DELTAS`.
  """
  agent = str(config.agent.name)
  values = defaults(RunSettings) | {"agent": {"name": agent, **defaults(config_class(agent))}}
  values |= {group: defaults(defined()[group][name]) for group, name in (("hardware", "auto"), ("tracking", "csv"))}
  del values["env"]
  if not changes.is_known or not changes.sections <= set(values):
    without = [f"{group}={option}" for group, option in choices.items() if option and group not in DELTAS]
    config, _ = _hydra([*without, *_NO_DELTAS], roots)
  return {key: values.get(str(key), value) for key, value in _plain(config).items()}


def _compose_new(parsed: Sequence[Override], files: Callable[..., _Files], roots: Sequence[Path]) -> RunConfig:
  """Composes the configuration of a command line."""
  config, choices, schema, added = files(*group_overrides(parsed))
  resolved = _apply(copy.deepcopy(config), [o for o in parsed if not o.is_group], schema)
  if resolved["resume"] is not None:
    raise ConfigError(f"resume={resolved['resume']} is for the command line alone: a file cannot set it.")
  check_limits(resolved)
  check_vision([override.key for override in parsed], resolved)
  check_chain(resolved, parsed, roots)
  head = {"name": choices.get("experiment") or choices["env"], "choices": dict(choices)}
  ordered = {key: resolved[key] for key in (*SCALARS, *SECTIONS) if key in resolved}
  run = from_dict({**head, **ordered, **resolved}, canonical([*parsed, *added], resolved))
  run.agent.check(num_devices=1)
  return run


def _compose_stage(
  chain: RunConfig, name: str, parsed: Sequence[Override], files: Callable[..., _Files], roots: Sequence[Path]
) -> RunConfig:
  """Composes the configuration of a stage, a single run without run_dir and init_from."""
  with in_stage(name):
    stage = _compose_new(parsed, files, roots)
  lengths = {
    "num_timesteps": budget(chain.curriculum, name, stage.agent.num_timesteps),
    "num_resets_per_eval": resets_per_eval(chain.curriculum, parsed, stage.agent.num_resets_per_eval),
  }
  own = {"name": f"{chain.name}/{name}", "choices": {**stage.choices, "curriculum": "none"}, "curriculum": SINGLE_RUN}
  own |= {"agent": {**stage.resolved["agent"], **lengths}, "run_dir": None, "init_from": None}
  return from_dict({**stage.resolved, **own}, stage.overrides)


@contextlib.contextmanager
def _initialized(roots: Sequence[Path]) -> Iterator[None]:
  """Initialises Hydra during the block."""
  outer = GlobalHydra.instance().hydra  # the app's instance, if this is called within it: Hydra allows one at a time
  GlobalHydra.instance().clear()
  register_options(roots)
  try:
    with hydra.initialize_config_dir(str(roots[0]), version_base="1.3"):
      yield
  finally:
    GlobalHydra.instance().hydra = outer


def _hydra(
  overrides: Sequence[str], roots: Sequence[Path], name: str = "config"
) -> tuple[DictConfig, dict[str, str | None]]:
  """Returns Hydra's composition of `<name>.yaml`, and the option of each group."""
  try:
    with _initialized(roots):
      lines = [*overrides, *search_path_override(roots)]
      config = hydra.compose(name, overrides=lines, return_hydra_config=True)
      chosen = dict(config.hydra.runtime.choices)
  except (HydraException, YAMLError, OmegaConfBaseException, ValueError, OSError, RecursionError) as error:
    files = " ".join(o for o in overrides if not o.startswith("~"))
    raise ConfigError(f"The files of {files or f'{name}.yaml'} do not compose: {_why(error)}.") from None
  OmegaConf.set_struct(config, False)
  del config["hydra"]
  for section in (key for key in (*SECTIONS, *_SWEEP_SECTIONS) if key in config):
    if not isinstance(config[section], DictConfig):
      raise wrong_type(section, config[section], "a mapping, also in the files that are chosen")
  if "observations" in (env := config.get("env") or {}):
    env.update({key: value for key, value in defaults(TermsConfig).items() if key not in env})
  choices = {group: chosen.get(group) for group in groups(roots)}
  if choices.get("tuned") not in options("tuned", roots):  # optional, and this pair has none
    choices["tuned"] = None
  return config, choices


def _why(error: Exception) -> str:
  """Returns why files do not compose: the remedy of a common mistake, else Hydra's reason."""
  text = first_line(error)
  for pattern, remedy in _REMEDIES.items():
    if found := re.search(pattern, text):
      return found.expand(remedy)
  head, _, reason = str(error).partition("composing config:\n")  # Hydra's text, and OmegaConf's
  return f"{' '.join(head.split()[:2])} {reason.splitlines()[0]}" if reason else text


def _apply(config: DictConfig, overrides: Iterable[Override], schema: Section) -> dict[str, Plain]:
  """Sets values, resolves, and checks the whole against the schema."""
  try:
    for override in overrides:
      check_key(override.key, schema)
      if override.value is None:
        check_removed(override.key, config)
      if override.key in CHOSEN_BY_GROUP:
        group = override.key.partition(".")[0]
        raise ConfigError(f"{override.text} cannot be set: {group}=<name> chooses it, with the keys that it has.")
      try:
        OmegaConf.update(config, override.key, override.value, merge=isinstance(override.value, Mapping))
      except OmegaConfBaseException as error:
        raise ConfigError(f"{override.text}: {first_line(error)}.") from None
      except ValueError:  # of OmegaConf, for a name below a list
        where = f"{override.text}: {override.key.rpartition('.')[0]}"
        raise ConfigError(f"{where} is a list, whose entries have numbers as keys.") from None
    if missing := OmegaConf.missing_keys(config):
      raise ConfigError(f"{min(missing)} has no value: set {min(missing)}=<value>.")
    return fit(OmegaConf.to_container(config, resolve=True), schema, chosen_names(schema))
  except OmegaConfBaseException as error:
    raise ConfigError(f"{error.full_key}: {first_line(error)}.") from None


def _plain(config: object) -> Plain:
  """Returns plain dicts and lists, with the interpolations of files resolved."""
  try:
    return OmegaConf.to_container(config if isinstance(config, DictConfig) else _literal(config), resolve=True)
  except OmegaConfBaseException as error:
    raise ConfigError(f"{error.full_key}: {first_line(error)}.") from None


def _literal(values: object) -> DictConfig:
  """Returns values as they are: saved files are resolved, so `${oc.env:HOME}` in them is text."""

  def escape(node: Plain) -> Plain:
    if isinstance(node, Mapping):
      return {key: escape(value) for key, value in node.items()}
    if isinstance(node, list | tuple):
      return [escape(value) for value in node]
    return re.sub(r"(\\*)\$\{", r"\1\1\\${", node) if isinstance(node, str) else node

  plain: dict[str, Plain] = escape(values.to_dict() if isinstance(values, ConfigDict) else values)
  return OmegaConf.create(plain)


def _compose_resumed(run: Path, parsed: Sequence[Override], roots: Sequence[Path]) -> RunConfig:
  """Composes the configuration of a resumed run: the saved one, except for its budget and sections that may differ."""
  _check_resumable(run, parsed)
  whole = from_saved(load(run / "config.yaml").resolved)
  saved, folders = whole.resolved, [run / folder for folder in stage_folders(whole.curriculum).values()]
  fresh, choices = _hydra(group_overrides(parsed), roots)
  schema = _plain(fresh)
  chosen = {o.key for o in parsed if o.is_group}
  sections = {s: schema[s] if s in chosen else saved[s] for s in _RESUMABLE}
  if "hardware" in chosen:  # what the group does not set stays the run's
    group, before = schema["hardware"], saved["hardware"]
    kept = {key: before[key] for key in _NUMERICS if key in before and group[key] == _HARDWARE[key]}
    sections["hardware"] = {**group, **kept}
  values = [o for o in parsed if not o.is_group and o.key not in ("resume", _BUDGET)]
  changed = _apply(_literal(sections), values, {s: schema[s] for s in sections})
  for longer in (o for o in parsed if o.key == _BUDGET):
    if folders:
      last = f"resume={folders[-1]} {longer.text}"
      raise ConfigError(f"{longer.text} is not for a chain: {last} trains its last stage longer.")
    changed["agent"] = _trained_longer(saved["agent"], longer, run)
  resolved = {**saved, **changed, "resume": str(run), "run_dir": str(run), "init_from": None}
  resolved["choices"] = {**saved["choices"], **{group: choices[group] for group in chosen}}
  check_limits(resolved)
  stages = [_compose_resumed(folder, parsed, roots) for folder in folders]
  return dataclasses.replace(from_dict(resolved, canonical(parsed, resolved)), stages=tuple(stages))


def _trained_longer(agent: Section, longer: Override, run: Path) -> dict[str, Plain]:
  """Returns an agent's section with a larger budget and, up to the limit, evaluations as far apart as before."""
  new = _apply(_literal({"agent": agent}), [longer], {"agent": agent})["agent"]
  before, steps = agent["num_timesteps"], new["num_timesteps"]
  if steps < before:
    raise ConfigError(f"{longer.text}: {run} trains {before:,} steps, and can only train longer.")
  return {**new, "num_evals": min(MOST_EVALS, 1 + round((agent["num_evals"] - 1) * steps / before))}


def _check_resumable(run: Path, parsed: Iterable[Override]) -> None:
  """Raises ConfigError for changes that affect numbers: a resumed run goes on as if it had never stopped."""
  for override in parsed:
    if override.key == "init_from":
      what = "resume continues a run exactly, init_from starts a new one from its weights"
      raise ConfigError(f"{override.text} and resume={run} exclude each other: {what}.")
    if override.key.split(".")[0] not in ("resume", *_RESUMABLE) and override.key != _BUDGET:
      what = f"which continues exactly that run and takes only {', '.join(_RESUMABLE)} and a larger {_BUDGET}"
      instead = f"init_from={run} starts a new run from its weights"
      raise ConfigError(f"{override.text} cannot be given with resume, {what}; {instead}.")


def _resolve(key: str, value: object) -> Plain:
  """Returns a key's value with interpolations such as ${oc.env:SCRATCH} resolved; escaped ones become text."""
  try:
    return OmegaConf.create({key: value})[key]
  except OmegaConfBaseException as error:
    raise ConfigError(f"{error.full_key}: {first_line(error)}.") from None


def _check_path(key: str, value: object) -> None:
  """Raises an error if a path of `resume` or `init_from` does not exist."""
  if key == "init_from":
    value = locate(str(value))
  path = Path(os.path.expanduser(str(value)))
  wanted, what = (path / "config.yaml", "run directory") if key == "resume" else (path, "run directory or checkpoint")
  if not os.path.lexists(wanted):  # `find_checkpoints` reports a broken link
    if key == "resume":
      if (path / "sweep.yaml").is_file():
        how = f"`playground sweep retry {value}` continues it, resume={path / 'jobs' / '<job>'} one of its runs"
        raise ConfigError(f"resume={value} is the folder of a sweep: {how}.")
      if runs := sorted(run for run in path.glob("*/") if (run / "config.yaml").is_file()):
        raise ConfigError(f"resume={value} is a folder of runs: name one, such as the newest, resume={runs[-1]}.")
      if run := next((p for p in path.resolve().parents if (p / "status.json").is_file()), None):
        raise ConfigError(f"resume={value} is a part of a run: resume={run} continues it from its newest checkpoint.")
    siblings = [p.name for p in path.parent.glob("*/") if p.name != path.name]
    raise ConfigError(f"{key}={value} is no {what}: {wanted} does not exist.{nearest(path.name, siblings)}")


def _check_robot(choices: Mapping[str, str | None], roots: Sequence[Path]) -> None:
  """Raises ConfigError for a robot whose task takes none."""
  env, robot = choices["env"], choices.get("robot")
  if robot is not None:
    own, chosen = _hydra([f"env={env}", *_NO_DELTAS], roots)
    # `in` would be false for a mandatory robot that is not set
    if not chosen.get("robot") and "robot" not in list(own.env):
      raise ConfigError(f"robot={robot}: env={env} takes no robot, leave robot= out.")
