"""Names in a configuration that stand for functions."""

from collections.abc import Mapping
from typing import TypeVar

from playground.errors import UnknownNameError, nearest

T = TypeVar("T")


def lookup(table: Mapping[str, T], name: str, key: str) -> T:
  """Returns `table[name]`, where `key` is the configuration key that holds the name.

  Raises:
    UnknownNameError: the table has no such name; the message gives the nearest.
  """
  if name not in table:
    raise UnknownNameError(f"{key}: {name!r} is unknown; choose from {', '.join(table)}.{nearest(name, table)}")
  return table[name]
