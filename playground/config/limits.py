"""Checks values against their definitions (choices, texts, limits), and values against each other."""

import operator
import re
from collections.abc import Iterable, Mapping

from playground.config.definitions import chosen_names, definition
from playground.config.schema import is_of_terms
from playground.envs.options import CubeKeys, PdKeys, TargetRangeKeys, uses_vision
from playground.errors import ConfigError
from playground.limits import Limit
from playground.settings import Plain, Section, build, check_value, nodes
from playground.text import format_value, wrong_type

_OF_A_ROBOT = {"pd": PdKeys, "target_range": TargetRangeKeys, "cube": CubeKeys}  # mappings that have no other keys
_XLA_SWITCH = re.compile(r"--xla_\w+(=(true|false|-?\d+(\.\d+)?))?")
_XLA_PLACES = ("dir", "path", "file", "dump", "load", "cache", "option", "override", "_to", "_from")  # in flags' names


def check_limits(resolved: Section) -> None:
  """Checks all values of a configuration, which may lack sections; null is checked in `env.robot` alone.

  Raises:
    ConfigError: the first invalid value.
  """
  names = chosen_names(resolved)
  for key, value in nodes(resolved):
    is_leaf = value is not None and not (isinstance(value, Mapping) and value)
    if is_leaf and not is_of_terms(key):
      _check(key, value, names)
  _check_xla_flags(resolved.get("hardware", {}).get("xla_flags"))
  env = resolved.get("env", {})
  if "robot" in env:
    _check_robot(env["robot"])
  _check_order(env, "env")
  contacts, convex = env.get("naconmax_per_env"), env.get("naccdmax_per_env")
  if contacts is not None and convex is not None and convex > contacts:
    raise ConfigError(f"env.naccdmax_per_env={convex} must not be above env.naconmax_per_env={contacts}.")


def _check(key: str, value: object, names: Mapping[str, object]) -> None:
  setting = definition(key, names)
  if setting is not None:
    check_value(key, value, setting)
  if (setting is None or setting.limit is None) and _numbers(value) and not Limit().each.allows(value):
    raise ConfigError(f"{key}={format_value(value)} must be {Limit().each}.")


def _check_robot(robot: Plain) -> None:
  """Checks `env.robot`, all of which is of a robot's file: no default says which values are mappings, lists or null."""
  for key, value in nodes({"env.robot": robot}):
    if (setting := definition(key, {})) is None or (value is None and setting.nullable):
      continue
    if setting.mapping and not isinstance(value, Mapping):
      raise wrong_type(key, value, "a mapping, such as {name: value}")
    check_value(key, value, setting)
  for name, cls in _OF_A_ROBOT.items():
    if robot.get(name):
      build(cls, robot[name], f"env.robot.{name}")


def _check_order(node: Section, key: str) -> None:
  """Raises ConfigError where a key with `min` or `lower` is above that with `max` or `upper`."""
  for name, low in node.items():
    other = str(name).replace("min", "max").replace("lower", "upper")
    if isinstance(low, Mapping):
      _check_order(low, f"{key}.{name}")
    elif other != name and any(map(operator.gt, _numbers(low), _numbers(node.get(other)))):
      high = format_value(node[other])
      raise ConfigError(f"{key}.{name}={format_value(low)} must not be above {key}.{other}={high}.")


def check_vision(keys: Iterable[str], resolved: Section) -> None:
  """Raises ConfigError where `keys` of a command line set `env.vision` of a task without vision."""
  unused = [key for key in keys if key.startswith("env.vision.") and key != "env.vision.enable"]
  if unused and not uses_vision(resolved["env"]):
    raise ConfigError(f"{unused[0]}: this task has no images. Add env.vision.enable=true env.vision.camera=<name>.")


def _check_xla_flags(flags: object) -> None:
  """Allows only switches and numbers: other flags may write files, or name a folder of programs to start."""
  for flag in flags.split() if isinstance(flags, str) else []:
    if not _XLA_SWITCH.fullmatch(flag) or any(word in flag for word in _XLA_PLACES):
      what = "must be switches and numbers, such as --xla_gpu_deterministic_ops=true"
      raise ConfigError(f"hardware.xla_flags={flag} is refused: they {what}; export others in XLA_FLAGS.")


def _numbers(value: object) -> list[float]:
  """Returns the numbers in a value, a number or a list."""
  if isinstance(value, list):
    return [number for entry in value for number in _numbers(entry)]
  return [value] if isinstance(value, int | float) and not isinstance(value, bool) else []
