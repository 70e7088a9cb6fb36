"""The typed definition of each key: the settings class of each section, and their registration with Hydra.

A section's class lies beside the component that reads it. Options that a class defines have no file: `hardware=auto`,
`agent=ppo` and the other options below are registered with Hydra, and files hold the differences.
"""

import dataclasses
import fnmatch
import functools
import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Annotated

from hydra.core.config_store import ConfigStore

from playground.config.run_options import (
  CheckpointConfig,
  CurriculumConfig,
  NonfiniteConfig,
  ProfileConfig,
  TrackingConfig,
  VideoConfig,
)
from playground.config.sweep_options import LAUNCHERS, SEARCHES, SweepConfig
from playground.envs.options import EnvConfig, TaskKeys, TermsConfig
from playground.errors import PlaygroundError
from playground.hardware.options import HardwareConfig
from playground.learning.hyperparameters import agent_names, config_class
from playground.limits import SEED
from playground.settings import Plain, Section, Setting, defaults, settings


@dataclasses.dataclass(frozen=True)
class RunSettings:
  """Settings of a run that no group chooses."""

  seed: Annotated[int, SEED, "of the whole run"] = 1
  run_dir: Annotated[str | None, "the run's folder; null is results/<experiment or task>/<date_time>"] = None
  resume: Annotated[str | None, "a run directory: continue exactly that run, or train it longer"] = None
  init_from: Annotated[str | None, "a run directory or checkpoint: a new run from its weights"] = None
  checkpoint: CheckpointConfig = dataclasses.field(default_factory=CheckpointConfig)
  video: VideoConfig = dataclasses.field(default_factory=VideoConfig)
  env: EnvConfig = dataclasses.field(default_factory=EnvConfig)
  on_nonfinite: NonfiniteConfig = dataclasses.field(default_factory=NonfiniteConfig)
  profile: ProfileConfig = dataclasses.field(default_factory=ProfileConfig)


def agents() -> dict[str, type]:
  """Returns the settings class of each `agent.name`; an entry point that is broken is skipped with a warning."""
  found: dict[str, type] = {}
  for name in agent_names():
    try:
      found[name] = config_class(name)
    except PlaygroundError as error:
      warnings.warn(str(error), stacklevel=2)
  return found


@functools.cache
def defined() -> dict[str, dict[str, type]]:
  """Returns, by group, the options that a class defines, each with its class."""
  return {
    "agent": agents(),
    "curriculum": {"none": CurriculumConfig},
    "hardware": {"auto": HardwareConfig},
    "tracking": {"csv": TrackingConfig},
    "launcher": dict(LAUNCHERS),
    "search": SEARCHES,
  }


def base_agents(name: str) -> list[str]:
  """Returns the agents whose settings class that of `agent.name` inherits from, nearest first."""
  named = {cls: agent for agent, cls in defined()["agent"].items()}
  return [named[cls] for cls in config_class(name).__mro__[1:] if cls in named]


def register(group: str, names: Iterable[str]) -> None:
  """Registers with Hydra the options of a group that classes define and no file."""
  _replace(group, {name: functools.partial(_node, group, name) for name in names}, package=group)


@functools.cache
def register_sections() -> None:
  """Registers with Hydra the sections that no group chooses."""
  ConfigStore.instance().store("run_settings", defaults(RunSettings))
  ConfigStore.instance().store("sweep_settings", defaults(SweepConfig))


def register_experiments(tasks: Mapping[str, str]) -> None:
  """Registers with Hydra the experiments that only choose a task, given as {experiment: task}."""
  choose = lambda task: {"defaults": [{"override /env": task}]}
  _replace("experiment", {name: functools.partial(choose, tasks[name]) for name in tasks}, package="_global_")


def _node(group: str, name: str) -> dict[str, Plain]:
  named = {"name": name} if group in ("agent", "launcher", "search") else {}
  return {**named, **defaults(defined()[group][name])}


def _replace(group: str, nodes: Mapping[str, Callable[[], Plain]], package: str) -> None:
  """Replaces the registered options of a group; Hydra refuses an option that also has a file."""
  store = ConfigStore.instance()
  if set(store.repo.get(group, {})) != {f"{name}.yaml" for name in nodes}:
    store.repo[group] = {}
    for name, node in nodes.items():
      store.store(name, node(), group=group, package=package)


def definition(key: str, names: Mapping[str, object]) -> Setting | None:
  """Returns the definition of a dotted key; None for a key of a file alone, as of another package's task.

  Args:
    key: such as agent.learning_rate.
    names: name of the chosen option of `agent`, `launcher` and `search`.
  """
  section, _, rest = key.partition(".")
  if section == "agent":
    return _look_up(config_class(str(names["agent"])), rest) if "agent" in names else None
  if section in ("launcher", "search"):
    cls = defined()[section].get(str(names.get(section)))
    return _look_up(cls, rest) if cls else None
  if section in ("curriculum", "hardware", "tracking"):
    return _look_up(next(iter(defined()[section].values())), rest)
  if section == "env":
    found = (_look_up(cls, rest) for cls in (EnvConfig, TermsConfig, TaskKeys))
    return next(filter(None, found), None)
  return _look_up(RunSettings, key) or _look_up(SweepConfig, key)


def chosen_names(resolved: Section) -> dict[str, Plain]:
  """Returns the `names` of `definition` for a configuration, which may lack these sections."""
  sections = {section: resolved.get(section) for section in ("agent", "launcher", "search")}
  return {section: value.get("name") for section, value in sections.items() if isinstance(value, Mapping)}


def _look_up(cls: type, name: str) -> Setting | None:
  found = settings(cls)
  if name in found:
    return found[name]
  return next((found[key] for key in found if "*" in key and fnmatch.fnmatchcase(name, key)), None)
