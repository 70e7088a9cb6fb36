"""Chains of runs: composes each stage of a `curriculum`.

```yaml
stages:
  flat:
    num_timesteps: 100_000_000   # null is the task's own budget
    overrides:                   # as on the command line; they hold for the later stages, too
      - env.commands.velocity.params.max=[1.5, 0.8, 1.2]
  rough: {num_timesteps: 100_000_000, overrides: [terrain=rough]}
```

A stage is composed like a run of its own: the chain's options and files, then the stage's overrides, then the values of
the command line, which therefore hold for all stages.
"""

import contextlib
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from playground.config.files import options
from playground.config.overrides import Override, parse
from playground.config.run_options import CurriculumConfig
from playground.errors import ConfigError, PlaygroundError, UnknownNameError, nearest
from playground.settings import Section, defaults
from playground.text import format_value, wrong_type

_FIELDS = ("num_timesteps", "overrides")
_SETTABLE = ("env", "robot", "agent", "tuned", "randomization", "seed")  # groups and sections that a stage may set
_STAGE_NAME = re.compile(r"[\w-]*[^\W_][\w-]*")
SINGLE_RUN = defaults(CurriculumConfig)  # curriculum=none


def stage_folders(curriculum: CurriculumConfig) -> dict[str, str]:
  """Returns the stages that a chain runs, from `start_at` on, with their folders in the chain's.

  Raises:
    ConfigError: a stage's name is no folder's.
    UnknownNameError: `start_at` is no stage.
  """
  names, start_at = list(curriculum.stages), curriculum.start_at
  for name in names:  # a saved chain may be another user's, whose path would lead out of its folder
    if not _STAGE_NAME.fullmatch(str(name)):
      raise ConfigError(f"curriculum.stages.{name}: a stage's name is that of a folder, letters, digits, - and _ only.")
  _need_stage(start_at, names)
  first = 0 if start_at is None else names.index(start_at)
  return {name: f"{number}_{name}" for number, name in enumerate(names[first:], first + 1)}


def _need_stage(start_at: str | None, names: list[str]) -> None:
  if start_at is not None and start_at not in names:
    near = nearest(str(start_at), names)
    raise UnknownNameError(
      f"curriculum.start_at={start_at} does not exist: choose from {', '.join(names) or 'none'}.{near}"
    )


def check_chain(resolved: Section, parsed: Sequence[Override], roots: Sequence[Path]) -> None:
  """Checks the stages of a configuration's chain, and the keys of the command line that concern the chain.

  Raises:
    ConfigError: an invalid field of a stage, or a key that does not fit the chain.
    UnknownNameError: no such stage or field.
  """
  curriculum = resolved["curriculum"]
  if missing := [key for key in SINGLE_RUN if key not in curriculum]:
    raise ConfigError(f"curriculum.{missing[0]} is missing: write defaults: [none, _self_] in the curriculum's file.")
  stages, start_at = curriculum["stages"], curriculum["start_at"]
  given = {override.key: override for override in parsed if not override.is_group}
  if not stages:
    if about := [override.text for key, override in given.items() if key.startswith("curriculum.")]:
      chains = ", ".join(name for name in options("curriculum", roots) if name != "none")
      raise ConfigError(f"{about[0]} needs a chain: add curriculum=<name>, one of {chains}.")
    return
  for name, stage in stages.items():
    _check_stage(f"curriculum.stages.{name}", stage)
  _need_stage(start_at, list(stages))
  if start_at not in (None, next(iter(stages))) and resolved["init_from"] is None:
    what = "is not the first stage, so it needs weights to start from"
    raise ConfigError(f"curriculum.start_at={start_at} {what}: add init_from=<run or checkpoint>.")
  if curriculum["scale"] and "agent.num_timesteps" in given:
    raise ConfigError(
      f"{given['agent.num_timesteps'].text} is not for a chain, whose stages have budgets of their own: "
      "curriculum.scale=0.1 shortens them all, curriculum.stages.<name>.num_timesteps=<steps> sets one."
    )


def stage_overrides(
  curriculum: CurriculumConfig, parsed: Sequence[Override], roots: Sequence[Path]
) -> Iterator[tuple[str, list[Override]]]:
  """Yields the name and the overrides of each stage that the chain runs.

  Args:
    curriculum: the chain's section, checked.
    parsed: the command line that chose the chain.
    roots: folders that hold groups.

  Raises:
    ConfigError: an override that a stage cannot have; the message names the stage.
  """
  groups = [override for override in parsed if override.is_group]
  values = [override for override in parsed if not override.is_group]
  folders, own = stage_folders(curriculum), []
  for name, stage in curriculum.stages.items():
    with in_stage(name):
      own = [*own, *(_parse(text, roots) for text in stage["overrides"])]
    if name in folders:
      yield name, [*groups, *own, *values]


def budget(curriculum: CurriculumConfig, stage: str, default: int) -> int:
  """Returns a stage's `agent.num_timesteps`: its own or the task's, times the scale; with a scale of 0 the task's."""
  own, scale = curriculum.stages[stage]["num_timesteps"], curriculum.scale
  return max(1, round(scale * (default if own is None else own))) if scale else default


def resets_per_eval(curriculum: CurriculumConfig, parsed: Sequence[Override], default: int) -> int:
  """Returns `agent.num_resets_per_eval` of a stage: fewer in a shortened chain, to cover as much of an episode.

  Args:
    curriculum: the chain's section.
    parsed: the overrides of the stage, which win.
    default: the value of the task.
  """
  scale = curriculum.scale
  if not 0 < scale < 1 or any(override.key == "agent.num_resets_per_eval" for override in parsed):
    return default
  return min(default, max(1, round(scale * default)))


@contextlib.contextmanager
def in_stage(name: str) -> Iterator[None]:
  """Adds the name of the stage to a PlaygroundError."""
  try:
    yield
  except PlaygroundError as error:
    raise type(error)(f"Stage {name} of the chain: {error}") from error


def _check_stage(key: str, stage: object) -> None:
  if not isinstance(stage, Mapping):
    raise wrong_type(key, stage, f"a mapping with the keys {', '.join(_FIELDS)}")
  for field in stage:
    if field not in _FIELDS:
      near = nearest(str(field), _FIELDS)
      raise UnknownNameError(f"{key}.{field} does not exist: a stage has {', '.join(_FIELDS)}.{near}")
  for field in _FIELDS:
    if field not in stage:
      raise ConfigError(f"{key}.{field} is missing.")
  steps, overrides = stage["num_timesteps"], stage["overrides"]
  if isinstance(steps, float) and not steps.is_integer():
    raise ConfigError(f"{key}.num_timesteps={format_value(steps)} must be a whole number, or null.")
  if not isinstance(overrides, list) or not all(isinstance(text, str) for text in overrides):
    raise wrong_type(f"{key}.overrides", overrides, "a list of key=value, as on the command line")


def _parse(text: str, roots: Sequence[Path]) -> Override:
  """Parses an override of a stage."""
  override = parse(text, roots)
  if override.key.split(".")[0] not in _SETTABLE:
    raise ConfigError(f"{text} cannot be set by a stage, which takes only {', '.join(_SETTABLE)}.")
  if override.key == "agent.num_timesteps":
    raise ConfigError(f"{text}: a stage's budget is its num_timesteps.")
  return override
