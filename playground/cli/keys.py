"""`playground keys <prefix>`: prints value, allowed values and meaning of every key below a dotted prefix."""

import inspect
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table
from rich.text import Text

from playground.config import RunConfig, compose, compose_settings, config_roots, format_value, is_of_sweep
from playground.config.comments import keys_and_comments, meaning
from playground.config.definitions import chosen_names, definition
from playground.config.files import find_file, groups, lineage, listed_options
from playground.config.overrides import SHORT_KEYS
from playground.config.schema import check_key, is_of_terms
from playground.console import wide_console
from playground.errors import UnknownNameError, nearest
from playground.mdp.options import OPTIONS
from playground.settings import Plain, Section, Setting
from playground.text import first_docstring_line, join

if TYPE_CHECKING:
  from playground.mdp.terms import Term

_SECTIONS = {"robot": "env.robot", "randomization": "env.events"}  # group -> section of env that it sets
_FILES = ("env", "robot", "curriculum")  # groups whose files explain keys in comments


def show_keys(prefix: str, overrides: Sequence[str]) -> int:
  """Prints the options of a group and a table of keys.

  Args:
    prefix: a section (agent), a key (agent.learning_rate), a term (env.rewards.action_rate_l2) or a group.
    overrides: as for playground-run.

  Returns:
    The exit code, 0.

  Raises:
    PlaygroundError: no such key, or overrides that do not compose.
  """
  config = compose([text for text in overrides if not is_of_sweep(text.partition("=")[0])])
  sweeps = compose_settings([text for text in overrides if is_of_sweep(text.partition("=")[0])])
  values = {**config.resolved, **sweeps.resolved}
  roots = config_roots()
  console = wide_console(160)
  prefix = SHORT_KEYS.get(prefix.strip("."), prefix.strip("."))
  if not prefix:
    raise UnknownNameError(f"A section, a key or a group is missing: choose from {', '.join(values)}, or one in them.")
  if prefix in groups(roots):
    names = [name for name in listed_options(prefix, roots) if not name.split("/")[-1].startswith("_")]
    console.print(Text(f"{prefix}=<option>", style="bold"), Text(f"one of {', '.join(names)}"), sep=": ")
    parent, _, name = _SECTIONS.get(prefix, prefix).rpartition(".")
    if name not in (values[parent] if parent else values):
      return 0
  prefix = _SECTIONS.get(prefix, prefix)
  _print_terms_help(prefix, console)
  console.print(_table(_rows(prefix, _at(prefix, values), config, chosen_names(values))))
  if prefix.startswith("env"):
    console.print(f"Values are those of {config.choices['env']}; env=<task> behind the prefix shows another's.")
  return 0


def _at(prefix: str, values: Section) -> Plain:
  """Returns the value or section at a dotted key; raises UnknownNameError if there is none."""
  node: Plain = values
  for part in prefix.split("."):
    if not isinstance(node, Mapping) or part not in node:
      check_key(prefix, values)
      why, near = f"a key before {part} holds a value", ""
      if isinstance(node, Mapping):
        why, near = "its term is not one of the task's", nearest(part, node)
      raise UnknownNameError(f"{prefix} does not exist in this configuration: {why}.{near}")
    node = node[part]
  return node


def _rows(prefix: str, node: Plain, config: RunConfig, names: Section) -> Iterator[tuple[str, str, str, str]]:
  """Yields key, value, allowed values and help."""
  comments, parameters = _comments(config), _parameters(prefix, config.resolved)

  def walk(key: str, value: Plain) -> Iterator[tuple[str, str, str, str]]:
    setting = definition(key, names)
    help = meaning(setting, comments.get(key, "")) or parameters.get(key, ("", ""))[1]
    if _is_term(key, value):
      what, help = _term(key, value)
      yield key, what, "", help
      if key != prefix:
        return
    if not isinstance(value, Mapping) or not value:
      yield key, format_value(value), _allowed(setting), help
    for name, inner in value.items() if isinstance(value, Mapping) else ():
      yield from walk(join(key, name), inner)

  yield from walk(prefix, node)
  for key, (default, help) in parameters.items():
    inner = key.removeprefix(f"{prefix}.").removeprefix("params.")
    given = node.get("params", node) if isinstance(node, Mapping) else {}
    if "." not in inner and inner not in given:
      yield key, f"({default})", "", help


def _parameters(prefix: str, values: Section) -> dict[str, tuple[str, str]]:
  """Returns default and meaning of each parameter, by key, of the term at a key or above it; {} without one."""
  parts = prefix.split(".")
  keys = [".".join(parts[:end]) for end in range(3, len(parts) + 1)]
  key = next((key for key in keys if _is_term(key, _at(key, values))), None)
  if key is None:
    return {}
  func = _bound(key, _at(key, values)).func
  docs = "\n".join(inspect.getdoc(each) or "" for each in (func.__mro__ if inspect.isclass(func) else [func]))
  said = {name: " ".join(text.split()) for name, text in re.findall(r"^  (\w+): (.*(?:\n    .*)*)", docs, re.M)}
  arguments = inspect.signature(func).parameters.values()
  defaults = {each.name: format_value(each.default) for each in arguments if each.default is not each.empty}
  return {f"{key}.params.{name}": (defaults.get(name, ""), said.get(name, "")) for name in {**said, **defaults}}


def _is_term(key: str, value: Plain) -> bool:
  """Whether this is a term, not a group of observations, nor the group `state` as an entry of another one."""
  depth = 3 if key.startswith("env.observations.") else 2
  return isinstance(value, Mapping) and is_of_terms(key) and key.count(".") == depth and not key.endswith(".state")


def _term(key: str, entry: Section) -> tuple[str, str]:
  """Returns the fields of a term, and the first line of its function's docstring."""
  term = _bound(key, entry)
  func = "" if term.func.__name__ == term.name else f"{term.func.__name__} "
  fields = {name: value for name, value in entry.items() if name != "func" and value not in (None, {})}
  return f"{func}{format_value(fields)}", first_docstring_line(term.func)


def _bound(key: str, entry: Section) -> "Term":
  from playground.mdp.terms import bind_one  # imports JAX, which keys other than terms do without

  return bind_one(key.split(".")[1], key, key.split(".")[-1], entry)


def _print_terms_help(prefix: str, console: Console) -> None:
  """Prints the fields of a term, for a prefix such as env.rewards."""
  kind = prefix.removeprefix("env.")
  if prefix != kind and kind in OPTIONS:
    console.print(Text(inspect.getdoc(OPTIONS[kind]) or ""))
    console.print(f"Set a field with {prefix}.<term>.<field>=<value>; a term that is null is removed.\n", markup=False)


def _allowed(setting: Setting | None) -> str:
  if setting is None:
    return ""
  allowed = ", ".join(setting.choices) if setting.choices else str(setting.limit or "")
  return allowed + (" or null" if setting.nullable and allowed else "")


def _comments(config: RunConfig) -> dict[str, str]:
  """Returns the comments of the chosen files by dotted key; a file wins over the file that it is built on."""
  roots, found = config_roots(), {}
  for group in _FILES:
    option = config.choices.get(group)
    for name in lineage(group, option, roots) if option else ():
      if (file := find_file(group, name, roots)) is not None:
        for key, _, comment in keys_and_comments(file.read_text(encoding="utf-8")):
          found.setdefault(join(_SECTIONS.get(group, group), key), comment)
  return found


def _table(rows: Iterator[tuple[str, str, str, str]]) -> Table:
  table = Table(box=None, padding=(0, 2, 0, 0))
  for name, ratio in (("key", 4), ("value", 4), ("allowed", 3), ("meaning", 5)):
    table.add_column(name, overflow="fold", ratio=ratio, style="cyan" if name == "key" else None)
  for row in rows:
    table.add_row(*map(Text, row))
  return table
