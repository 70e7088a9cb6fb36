"""Values and errors in the words of the command line."""

import hashlib
import re
import sys
import traceback
from collections.abc import Iterable, Sequence
from pathlib import Path

import yaml

from playground.errors import ConfigError, nearest

_MOST_BITS = 10_000  # of a number in decimals: Python refuses to write more than 4300 digits


def format_value(value: object) -> str:
  """A value as one would write it on the command line."""
  if value is None or isinstance(value, bool):
    return {None: "null", True: "true", False: "false"}[value]
  if items := getattr(value, "items", None):  # of a ConfigDict, too, which is no Mapping
    return "{" + ", ".join(f"{k}: {format_value(v)}" for k, v in items()) + "}"
  if isinstance(value, list | tuple):
    return f"[{', '.join(map(format_value, value))}]"
  return hex(value) if isinstance(value, int) and value.bit_length() > _MOST_BITS else str(value)


def millions(steps: float) -> str:
  """Formats a number of steps in millions, with three digits or all before the point."""
  return f"{steps / 1e6:.3g}" if steps < 1e9 else f"{steps / 1e6:,.0f}"


def suffix(overrides: Sequence[str]) -> str:
  """Returns what distinguishes the file names of results with overrides, "" without any."""
  return f"_{hashlib.sha256(' '.join(overrides).encode()).hexdigest()[:8]}" if overrides else ""


def quoted(value: object) -> str:
  """A value for Hydra's command line, whatever characters it has.

  Hydra takes a backslash for one unless a quote follows; an interpolation has to be escaped even inside quotes.
  """
  text = re.sub(r"(\\*)('|$)", lambda match: match[1] * 2 + match[2].replace("'", "\\'"), str(value))
  return "'" + text.replace("${", "\\${") + "'"


def wrong_type(key: str, value: object, allowed: str) -> ConfigError:
  """Returns the error for a value of a wrong type."""
  shown = quoted(value) if isinstance(value, str) and _is_number(value) else format_value(value)
  return ConfigError(f"{key}={shown} has the wrong type: it must be {allowed}.")


def _is_number(text: str) -> bool:
  try:
    float(text)
  except ValueError:
    return False
  return True


class _Dumper(yaml.SafeDumper):
  """Quotes text that OmegaConf would read as a number, such as 1e3, which PyYAML alone leaves bare."""


def _represent_text(dumper: _Dumper, text: str) -> yaml.ScalarNode:
  if _is_number(text):
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style="'")
  return dumper.represent_str(text)


_Dumper.add_representer(str, _represent_text)


def dump_yaml(values: object) -> str:
  """Returns plain dicts, lists and scalars as YAML, which reads back the same."""
  return yaml.dump(values, Dumper=_Dumper, sort_keys=False, allow_unicode=True)


def line_of(error: Exception, module: str) -> str:
  """Returns 'file:line: ' of the innermost call in a module that an error went through, '' without one."""
  file = getattr(sys.modules.get(module), "__file__", None)
  lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
  return f"{Path(file).name}:{lines[-1]}: " if file and lines else ""


def first_line(error: BaseException) -> str:
  """Returns the first line of an error, to be put into a sentence; of YAML's the problem and its place."""
  if isinstance(error, yaml.MarkedYAMLError) and (mark := error.problem_mark):
    return f"{error.problem} in {mark.name}, line {mark.line + 1}"
  return (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")


def first_docstring_line(thing: object) -> str:
  """The first line of a function's or class's docstring; "" if it has none."""
  return next(iter((thing.__doc__ or "").strip().splitlines()), "")


def join(parent: str, name: object) -> str:
  """The dotted key of something in `parent`, which is '' at the top."""
  return f"{parent}.{name}" if parent else str(name)


def nearest_in(parent: str, name: str, known: Iterable[object]) -> str:
  """As `nearest`, with the whole dotted key."""
  return nearest(name, map(str, known)).replace("'", f"'{join(parent, '')}", 1)
