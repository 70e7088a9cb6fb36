"""Parses the command line, one `key=value` or `group=option` at a time."""

import contextlib
import re
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override as HydraOverride
from hydra.errors import HydraException

from playground.config.files import DELTAS, config_roots, groups, listed_options, options
from playground.config.schema import is_of_terms
from playground.errors import ConfigError, UnknownNameError, nearest
from playground.learning.hyperparameters import ELSEWHERE
from playground.settings import Section, select
from playground.text import format_value, quoted

DEFAULT_EXPERIMENT = "quickstart"
# With any of these on the command line, the default experiment is not added.
_CHOOSES_A_RUN = {"experiment", "env", "agent", "robot", "curriculum", "resume"}
SHORT_KEYS = {
  "terrain": "env.scene.terrain",
  "visuals": "video.visuals",
}  # written without their section

_OF_SWEEPS = {"sweep", "sweep_dir", "on_error", "launcher", "search"}

_PATHS = ("run_dir", "resume", "init_from", "sweep_dir")
_OF_COMMANDS = ("trust", "hardware.cache_dir", "hardware.distributed")


class Override(NamedTuple):
  """One `key=value` of the command line; the value of a group that is switched off is None."""

  key: str
  value: object
  is_group: bool
  text: str


def with_default_experiment(overrides: Sequence[str], config_dir: Path | None = None) -> list[str]:
  """Adds the default experiment if the command line chooses no run of its own."""
  chosen = {re.split(r"[=@]", text.lstrip("+~"))[0] for text in overrides}
  available = (config_roots(config_dir)[0] / "experiment" / f"{DEFAULT_EXPERIMENT}.yaml").is_file()
  return [f"experiment={DEFAULT_EXPERIMENT}"] * (available and not chosen & _CHOOSES_A_RUN) + list(overrides)


def is_hydras(text: str) -> bool:
  """Whether an override is about Hydra itself, such as hydra.verbose=true."""
  return text.lstrip("+~").startswith(("hydra.", "hydra/"))


def is_of_sweep(key: str) -> bool:
  """Whether a key or group is a setting of the sweep, not of its jobs."""
  return key.split(".")[0] in _OF_SWEEPS


def is_of_command(text: str) -> bool:
  """Whether only a command line may set an override, not a saved run or sweep.

  These are Hydra's own keys, which name Python objects; packages to trust; the folder of compiled programs, which are
  executed unchecked; and the address of the coordinator of a distributed training.
  """
  key = parse_with_hydra(text).key_or_group
  return is_hydras(text) or any(f"{key}.".startswith(f"{own}.") for own in _OF_COMMANDS)


def of_task(task: str, overrides: Sequence[str]) -> list[str]:
  """Returns the overrides of a command that names its task first, as `CartpoleBalance` or `env=CartpoleBalance`.

  Raises:
    ConfigError: an override names a task, too.
  """
  if others := [text for text in overrides if text.startswith("env=")]:
    raise ConfigError(f"{others[-1]} is a second task: the command is about {task.removeprefix('env=')}.")
  return [task if "=" in task else f"env={task}", *overrides]


def parse_with_hydra(text: str) -> HydraOverride:
  """Reads one override as Hydra does; raises ConfigError if it is none.

  Values of folder keys are text, whatever characters they have: a value that Hydra does not parse as text is quoted
  first.
  """
  key, _, value = text.partition("=")
  try:
    parsed = OverridesParser.create().parse_override(text)
    if key and (key not in _PATHS or parsed.is_sweep_override() or not isinstance(parsed.value(), list | dict)):
      return parsed
  except ValueError:  # of Python
    most = sys.get_int_max_str_digits()
    raise ConfigError(f"{key} cannot be a whole number of more than {most} digits: write a smaller one.") from None
  except HydraException:
    pass
  if key in _PATHS:
    with contextlib.suppress(HydraException):
      return OverridesParser.create().parse_override(f"{key}={quoted(value)}")
  if group := next((group for group in ("env", "experiment") if text in options(group)), None):
    raise ConfigError(f"{text!r} is not an override: write {group}={text}.")
  if re.fullmatch(r"[\w.@/+~]+", key) and value:
    forms = "its value does not parse; a list is [1, 2], a mapping {a: 1, b: 2}, other text stands in quotes"
    how = forms if set(value) & set("[]{}()'\"") else f"quote its value, in a shell '{key}=\"{value}\"'"
    raise ConfigError(f"{text!r} is not an override: {how}.")
  example = "such as env=CartpoleBalance or agent.num_envs=1024"
  raise ConfigError(f"{text!r} is not an override: write key=value, {example}.")


def parse(text: str, roots: Sequence[Path]) -> Override:
  """Reads one override and checks that the option it chooses, if any, exists.

  Raises:
    ConfigError: not an override, several values, or a key to remove.
    UnknownNameError: no such option.
  """
  name, equals, value = text.partition("=")
  bare = name.lstrip("+")
  text = name.removesuffix(bare) + SHORT_KEYS.get(bare, bare) + equals + value
  parsed = parse_with_hydra(text)
  text, key = parsed.input_line or text, parsed.key_or_group
  if parsed.is_sweep_override():
    otherwise = "a list is [1, 2], text with a comma stands in quotes"
    raise ConfigError(f"{text} names several values, which is a sweep: add -m ({otherwise}).")
  is_group = key in groups(roots) and parsed.package is None
  value = parsed.value()
  if parsed.is_delete():
    if not is_group:
      instead = f"{key}=null removes the term" if is_of_terms(key) else "set another value"
      raise ConfigError(f"{text}: a key cannot be removed, {instead}.")
    value = None
  if is_group and (value is not None or key not in ("robot", *DELTAS)):
    for option in value if isinstance(value, list) and key in DELTAS else [value]:
      _check_option(key, option, roots)
  return Override(key if parsed.package is None else f"{key}@{parsed.package}", value, is_group, text.lstrip("+"))


def group_overrides(overrides: Iterable[Override]) -> list[str]:
  """Returns the choices of groups for Hydra, which has no group=null: the group is removed instead."""
  return [f"~{o.key}" if o.value is None else f"{o.key}={format_value(o.value)}" for o in overrides if o.is_group]


def canonical(overrides: Iterable[Override], resolved: Section) -> list[str]:
  """Returns overrides in Hydra's form, for disabled groups and for numbers."""
  lines = []
  for override in overrides:
    adds = "++" if is_of_terms(override.key) else ""  # Hydra refuses a term that no file has
    if override.is_group:
      lines += group_overrides([override])
    elif isinstance(override.value, int | float):
      lines.append(f"{adds}{override.key}={format_value(select(resolved, override.key))}")
    else:
      lines.append(f"{adds}{override.text.lstrip('+')}")
  return lines


def _check_option(group: str, option: object, roots: Sequence[Path]) -> None:
  known = options(group, roots)
  if option in known:
    return
  shown = listed_options(group, roots)
  command = "playground list" if group == "env" else f"playground keys {group}"
  allowed = ", ".join(shown) if len(shown) <= 12 else f"the {len(shown)} that `{command}` shows"
  allowed += ", or install the package that has it" * (group == "env")
  elsewhere = [f"{other}={option}" for other in ("experiment", "env", "robot") if option in options(other, roots)]
  alike = known if "/" in str(option) else shown  # v020/<Task> is not listed
  near = f" Did you mean {elsewhere[0]}?" if elsewhere else nearest(str(option), alike)
  near = (ELSEWHERE.get(str(option)) if group == "agent" else None) or near
  raise UnknownNameError(f"{group}={format_value(option)} does not exist: choose from {allowed}.{near}")
