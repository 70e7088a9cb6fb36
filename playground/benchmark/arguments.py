"""A command's arguments: `key=value` for the fields of a dataclass, and overrides of the run's configuration."""

import dataclasses
import math
import types
import typing
from collections.abc import Sequence
from typing import Any, TypeVar

import yaml

from playground.errors import ConfigError, UnknownNameError, nearest
from playground.text import format_value

T = TypeVar("T")
GROUPS = ("hardware", "debug", "randomization", "robot", "terrain")  # overrides without a dot that may be given, too
OVERRIDES = "overrides"  # the field that takes overrides, where a command has one


def option(default: T, what: str) -> T:
  """A field with a default and a line of help."""
  return dataclasses.field(default=default, metadata={"help": what})


def parse(command: str, options: type[T], arguments: Sequence[str]) -> T:
  """Reads a command's arguments.

  Args:
    command: its name, for messages.
    options: a dataclass of `option` fields; one named `overrides` takes what is for the run's configuration.
    arguments: `key=value` each.

  Raises:
    ConfigError: not of that form, given twice, or a value of another type.
    UnknownNameError: no such key.
  """
  kinds = typing.get_type_hints(options)
  values: dict[str, Any] = {}
  overrides: list[str] = []
  for text in arguments:
    key, equals, value = text.partition("=")
    if not equals:
      raise ConfigError(f"{text!r} is not an argument of `playground-bench {command}`: write key=value.")
    if OVERRIDES in kinds and ("." in key or key in GROUPS):
      overrides.append(text)
    elif key not in kinds or key == OVERRIDES:
      known = [name for name in kinds if name != OVERRIDES]
      what = f"{key} is no key of `playground-bench {command}`: it takes {', '.join(known)}"
      what += " and overrides of the run such as agent.num_envs=1024" * (OVERRIDES in kinds)
      raise UnknownNameError(f"{what}.{nearest(key, known)}")
    elif key in values:
      raise ConfigError(f"{key} is given twice.")
    else:
      values[key] = _read(key, value, kinds[key])
  if overrides:
    values[OVERRIDES] = tuple(overrides)
  return options(**values)


def check_amounts(options: object) -> None:
  """Raises ConfigError for amounts that cannot be, by the names that all commands have for them."""
  given = vars(options)
  for name in ("seconds", "minutes"):
    if (value := given.get(name)) is not None and not 0 < value < math.inf:
      raise ConfigError(f"{name}={value:g} must be a number above 0.")
  for name in ("workers", "seeds", "repeats", "num_timesteps"):
    if (value := given.get(name)) is not None and value < 1:
      raise ConfigError(f"{name}={value} must be at least 1.")
  for name in ("sizes", "num_envs", "devices"):
    if min(values := given.get(name, ()), default=1) < 1:
      raise ConfigError(f"{name}={list(values)} must be numbers above 0.")
  if min(gpus := given.get("gpus", ()), default=0) < 0:
    raise ConfigError(f"gpus={list(gpus)} must be numbers of GPUs, the first is 0.")
  for name in ("sizes", "num_envs", "hyperparameters", "backends"):
    if given.get(name) == ():
      raise ConfigError(f"{name}= is empty: name at least one, or leave it away.")


def help_of(options: type) -> list[str]:
  """A line for each key: its default and what it does."""
  fields = [field for field in dataclasses.fields(options) if field.name != OVERRIDES]
  shown = {field.name: f"{field.name}={format_value(field.default)}" for field in fields}
  width = max(map(len, shown.values()), default=0) + 2
  return [f"  {shown[field.name]:{width}}{field.metadata['help']}" for field in fields]


def _read(key: str, text: str, kind: Any) -> object:
  """The value of a key; `kind` is a type, one or None, or a tuple of one kind of item."""
  choices = typing.get_args(kind) if isinstance(kind, types.UnionType) else (kind,)
  if type(None) in choices and text == "null":
    return None
  (kind,) = (choice for choice in choices if choice is not type(None))
  if typing.get_origin(kind) is tuple:
    item = typing.get_args(kind)[0]
    parts = (part.strip() for part in text.strip("[]()").split(","))
    return tuple(dict.fromkeys(_item(key, part, item) for part in parts if part))  # each once: none is measured twice
  return _item(key, text, kind)


def _item(key: str, text: str, kind: type) -> object:
  words = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}
  try:
    value = text if kind is str else yaml.safe_load(text)
  except yaml.YAMLError:
    value = None
  if kind in (int, float) and isinstance(value, str):  # YAML takes 1e6 for text
    value = _number(value)
  if kind is int and isinstance(value, float) and value.is_integer():
    value = int(value)
  if kind is float and isinstance(value, int) and not isinstance(value, bool):
    value = float(value)
  if type(value) is not kind:
    raise ConfigError(f"{key}={text} must be {words[kind]}.")
  return value


def _number(text: str) -> float | None:
  try:
    return float(text)
  except ValueError:
    return None
