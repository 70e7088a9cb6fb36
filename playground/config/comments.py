"""Comments of YAML files: what they add to the help of keys, which settings classes define."""

import itertools
from collections.abc import Iterator

import yaml

from playground.settings import Setting


def keys_and_comments(text: str) -> Iterator[tuple[str, str, str]]:
  """Yields dotted key, value and comment of each entry of a YAML file.

  A section has no value, and is left out if it has no comment. Comments at the head of the file belong to no key.
  """
  lines = text.splitlines()
  head = len(list(itertools.takewhile(lambda line: line.startswith("#"), lines)))
  return _keys(yaml.compose(text), [""] * head + lines[head:])


def meaning(setting: Setting | None, comment: str) -> str:
  """Returns the help of a key and what the comment of a file adds to it."""
  text = setting.help if setting else ""
  if text in comment or comment in text:
    return max(text, comment, key=len)
  return f"{text} ({comment})"


def flow(value: object) -> str:
  """Formats a value on one line, as on a command line."""
  text = yaml.safe_dump(value, default_flow_style=True, width=10_000, sort_keys=False).strip()
  return text.removesuffix("...").strip()


def _keys(node: yaml.Node | None, lines: list[str], prefix: str = "") -> Iterator[tuple[str, str, str]]:
  if not isinstance(node, yaml.MappingNode):
    return
  for key, value in node.value:
    name = f"{prefix}{key.value}"
    section = isinstance(value, yaml.MappingNode) and not value.flow_style
    in_block = not section and not value.end_mark.column  # a list over several lines ends where the next key begins
    beside = _beside(lines, key.end_mark if section or in_block else value.end_mark)
    comment = " ".join([*_above(lines, key.start_mark), *beside])
    if section:
      yield from [(name, "", comment)] if comment else []
      yield from _keys(value, lines, f"{name}.")
    else:
      yield name, flow(yaml.safe_load(yaml.serialize(value))), comment


def _above(lines: list[str], key: yaml.Mark) -> list[str]:
  """Returns the comment lines directly above a key, with its indentation."""
  begin = " " * key.column + "#"
  above = list(itertools.takewhile(lambda line: line.startswith(begin), reversed(lines[: key.line])))
  return [line[len(begin) :].strip() for line in reversed(above)]


def _beside(lines: list[str], end: yaml.Mark) -> list[str]:
  """Returns the comment after a position in a line, with its continuation lines."""
  before, mark, comment = lines[end.line][end.column :].partition("#")
  if not mark or before.strip(" :"):
    return []
  column = len(lines[end.line]) - len(comment) - 1
  below = itertools.takewhile(lambda line: line[:column].isspace() and line[column] == "#", lines[end.line + 1 :])
  return [comment.strip(), *(line[column + 1 :].strip() for line in below)]
