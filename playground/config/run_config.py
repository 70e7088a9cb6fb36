"""A run's typed configuration, and functions that save, read and show it."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, get_type_hints

from ml_collections import ConfigDict
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from playground.config.run_options import (
  CheckpointConfig,
  CurriculumConfig,
  NonfiniteConfig,
  ProfileConfig,
  TrackingConfig,
  VideoConfig,
)
from playground.envs.options import EnvConfig
from playground.errors import ConfigError
from playground.files import check_aliases
from playground.hardware.options import HardwareConfig
from playground.learning.hyperparameters import AgentConfig, read_config
from playground.settings import Plain, Section, build, config_dict
from playground.text import dump_yaml, first_line, format_value

if TYPE_CHECKING:
  from rich.tree import Tree

  class TaskConfig(EnvConfig, Mapping[str, Plain], ConfigDict):  # pyright: ignore[reportIncompatibleMethodOverride]
    """The section of a task: the settings of every task (`EnvConfig`), and those of its own class."""

    def __getattr__(self, name: str) -> Plain: ...
else:
  TaskConfig = ConfigDict


@dataclasses.dataclass(frozen=True)
class RunConfig:
  """A run's whole configuration, checked. The sections are those of `configs/`, every value resolved.

  Attributes:
    name: the experiment, or the task if there is none.
    env: the task's section, whose keys are those of its class.
    agent: the algorithm's settings, of the class of its name (`PPOConfig`, ...).
    run_dir: where the run lives; without `run_dir` or `resume` a name from the time of composing, which `resolved`
      leaves null, and which the run numbers (`_2`) if another has it by then.
    choices: the option of each group, None where none is chosen.
    overrides: the command line in Hydra's form, numbers in their final type, the default experiment included.
    resolved: the whole configuration as plain dicts, lists and scalars; what `config.yaml` in the run directory holds.
    stages: the runs of a chain, in order; empty for a single run.
  """

  name: str
  env: TaskConfig
  agent: AgentConfig
  curriculum: CurriculumConfig
  hardware: HardwareConfig
  tracking: TrackingConfig
  video: VideoConfig
  checkpoint: CheckpointConfig
  on_nonfinite: NonfiniteConfig
  profile: ProfileConfig
  seed: int
  run_dir: str | None
  resume: str | None
  init_from: str | None
  choices: dict[str, Plain]
  overrides: tuple[str, ...]
  resolved: dict[str, Plain]
  stages: tuple["RunConfig", ...] = ()

  @property
  def agent_name(self) -> str:
    """The algorithm's name, `agent.name`; several options of the group `agent` may choose one."""
    return self.resolved["agent"]["name"]


_FIELDS = [field.name for field in dataclasses.fields(RunConfig)]
SECTIONS = tuple(_FIELDS[_FIELDS.index("env") : _FIELDS.index("seed")])
SCALARS = tuple(_FIELDS[_FIELDS.index("seed") : _FIELDS.index("choices")])
_UNTYPED = ("env", "agent")  # whose keys, or class, the configuration itself chooses
_CLASSES = {name: cls for name, cls in get_type_hints(RunConfig).items() if name in SECTIONS and name not in _UNTYPED}


def in_order_of(first: object, values: object) -> Plain:
  """Returns `values`, and the mappings inside as dicts, with the keys of `first` first and in the order of `first`."""
  if not isinstance(values, Mapping | ConfigDict):
    return values
  known = first if isinstance(first, Mapping | ConfigDict) else {}
  names = [*(name for name in known if name in values), *(name for name in values if name not in known)]
  return {name: in_order_of(known.get(name), values[name]) for name in names}


def from_dict(resolved: Section, overrides: Sequence[str] = ()) -> RunConfig:
  """Rebuilds a configuration from its `resolved` dict, e.g. a run directory's config.yaml.

  Raises:
    ConfigError: a part is missing or no such part, so this is not a run's configuration.
  """
  resolved = dict(resolved)
  if "randomization" in resolved:
    raise ConfigError(
      "This configuration is of version 0.1, whose tasks had env.reward and randomization.terms: use that version, or "
      "train again."
    )
  if missing := [key for key in ("name", "choices", *SECTIONS, *SCALARS) if key not in resolved]:
    raise ConfigError(f"This is not the configuration of a run: it lacks {', '.join(missing)}.")
  kinds = {"name": str, **dict.fromkeys(("choices", *SECTIONS), Mapping)}
  wrong = [key for key, kind in kinds.items() if not isinstance(resolved[key], kind)]
  texts = () if wrong else (("choices", "env"), ("agent", "name"))
  wrong += [f"{section}.{key}" for section, key in texts if not isinstance(resolved[section].get(key), str)]
  if wrong:
    raise ConfigError(f"This is not the configuration of a run: its {wrong[0]} has the wrong type.")
  return RunConfig(
    name=resolved["name"],
    env=config_dict(resolved["env"]),
    agent=read_config(resolved["agent"]),
    **{key: build(cls, resolved[key]) for key, cls in _CLASSES.items()},  # pyright: ignore[reportArgumentType]
    **{key: resolved[key] for key in SCALARS},
    choices=dict(resolved["choices"]),
    overrides=tuple(overrides),
    resolved=resolved,
  )


def load(path: Path) -> RunConfig:
  """Reads a saved config.yaml; raises ConfigError if it is not one."""
  if path.exists() and not path.is_file():  # a read of a named pipe would wait for ever
    raise ConfigError(f"{path} is not a file.")
  try:
    check_aliases(path)
    resolved = OmegaConf.to_container(OmegaConf.load(path))
  except (OSError, ValueError, YAMLError, OmegaConfBaseException, RecursionError) as error:
    raise ConfigError(f"{path} cannot be read: {first_line(error)}.") from None
  if not isinstance(resolved, dict):
    raise ConfigError(f"{path} is not the configuration of a run.")
  try:
    return from_dict(resolved)  # pyright: ignore[reportArgumentType]
  except ConfigError as error:
    raise type(error)(f"{path}: {error}") from None


def to_yaml(config: RunConfig) -> str:
  """The resolved configuration as YAML, which `load` reads."""
  return dump_yaml(config.resolved)


def values_to_yaml(values: object) -> str:
  """A section or a single value of a configuration as YAML."""
  return dump_yaml(values) if isinstance(values, Mapping) else format_value(values) + "\n"


def tree(config: RunConfig) -> "Tree":
  """The configuration as a tree for printing with rich."""
  from rich.text import Text
  from rich.tree import Tree

  def grow(branch: Tree, node: Section) -> Tree:
    for key, value in node.items():
      if isinstance(value, Mapping) and value:
        grow(branch.add(Text(str(key), style="bold")), value)
      else:
        branch.add(Text.assemble((f"{key}: ", "cyan"), format_value(value)))
    return branch

  return grow(Tree(Text(config.name, style="bold")), {k: v for k, v in config.resolved.items() if k != "name"})
