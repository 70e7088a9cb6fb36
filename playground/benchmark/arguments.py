"""Parses a command's arguments: `key=value` for the fields of a settings class, and overrides of the run's config."""

from collections.abc import Sequence
from typing import TypeVar

from playground.errors import ConfigError, UnknownNameError, nearest
from playground.limits import Limit
from playground.settings import Setting, check, settings
from playground.text import format_value

T = TypeVar("T")
GROUPS = ("hardware", "debug", "randomization", "robot", "terrain")  # allowed overrides without a dot
OVERRIDES = "overrides"  # the field that takes overrides, where a command has one


def parse(command: str, options: type[T], arguments: Sequence[str]) -> T:
  """Reads a command's arguments.

  Args:
    command: name of the command, for messages.
    options: a settings class; a field `overrides` takes overrides of the run's configuration.
    arguments: `key=value` each.

  Raises:
    ConfigError: an argument is not `key=value`, a key is repeated, or a value has another type.
    UnknownNameError: a key does not exist.
  """
  known = dict(settings(options))
  takes_overrides = known.pop(OVERRIDES, None) is not None
  values: dict[str, object] = {}
  overrides: list[str] = []
  for text in arguments:
    key, equals, value = text.partition("=")
    if not equals:
      raise ConfigError(f"{text!r} is not an argument of `playground-bench {command}`: write key=value.")
    if takes_overrides and ("." in key or key.lstrip("+") in GROUPS):
      overrides.append(text)
    elif key not in known:
      what = f"{key} is no key of `playground-bench {command}`: it takes {', '.join(known)}"
      what += " and overrides of the run such as agent.num_envs=1024" * takes_overrides
      raise UnknownNameError(f"{what}.{nearest(key, known)}")
    elif key in values:
      raise ConfigError(f"{key} is given twice.")
    else:
      values[key] = _read(known[key], value)
  if overrides:
    values[OVERRIDES] = tuple(overrides)
  return options(**values)


def check_limits(options: object) -> None:
  """Raises ConfigError for numbers outside their limits, and for empty lists."""
  if empty := [name for name, one in settings(type(options)).items() if one.default and getattr(options, name) == ()]:
    raise ConfigError(f"{empty[0]}= is empty: name at least one, or leave it away.")
  check(options)


def help_of(options: type) -> list[str]:
  """Returns a line for each key: default and help."""
  shown = {name: setting for name, setting in settings(options).items() if name != OVERRIDES}
  keys = {name: f"{name}={format_value(setting.default)}" for name, setting in shown.items()}
  width = max(map(len, keys.values()), default=0) + 2
  return [f"  {keys[name]:{width}}{setting.help}" for name, setting in shown.items()]


def _read(setting: Setting, text: str) -> object:
  """Parses the value of a key: text, true or false, a number, or a tuple of unique texts or numbers."""
  if text == "null" and setting.nullable:
    return None
  if setting.text_depth == 0:
    return text
  parts = [part.strip(" '\"") for part in text.strip("[]()").split(",") if part.strip()]
  if setting.text_depth == 1:
    return tuple(dict.fromkeys(parts))  # none is measured twice
  if setting.limit is None:
    if text.lower() not in ("true", "false"):  # as Hydra reads them
      raise ConfigError(f"{setting.name}={text} must be true or false.")
    return text.lower() == "true"
  numbers = [_number(part, setting.limit) for part in parts]
  listed = setting.limit.form == "list"
  if None in numbers or not (listed or len(numbers) == 1):
    raise ConfigError(f"{setting.name}={text} must be {setting.limit}.")
  return tuple(dict.fromkeys(numbers)) if listed else numbers[0]


def _number(text: str, limit: Limit) -> float | None:
  try:
    number = float(text)
  except ValueError:
    return None
  if limit.whole:
    return int(number) if number.is_integer() else None
  return number
