"""Errors a user can act on. Commands print them as one sentence and exit with code 2."""

import difflib
import errno
from collections.abc import Iterable, Mapping
from typing import TypeVar

T = TypeVar("T")
_MANY = 20  # names, of which only the nearest is named
_ALIKE, _LISTED = 3, 5  # letters that begin alike, and names listed that do


class PlaygroundError(ValueError):
  """Base of every error whose cause is the user's input or machine, not a bug."""


class ConfigError(PlaygroundError):
  """A key, value or combination in the configuration that cannot work."""


class UnknownNameError(ConfigError):
  """A task, experiment, group option or key that does not exist."""


class CheckpointError(PlaygroundError):
  """A checkpoint or run directory that is missing, foreign or damaged."""


class HardwareError(PlaygroundError):
  """More, or other, hardware asked for than this machine has."""


# Errors of the operating system about a path, a disk or a limit of the machine, never caused by a bug of ours.
_OF_THE_MACHINE = {errno.EACCES, errno.EPERM, errno.EROFS, errno.ENAMETOOLONG, errno.ENOTDIR, errno.ELOOP}
_OF_THE_MACHINE |= {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EMFILE, errno.ENFILE, errno.EIO, errno.ESTALE}


def one_sentence(error: Exception) -> str:
  """What a command prints of an error that the user can act on; raises any other again."""
  if not isinstance(error, OSError):
    return f"error: {' '.join(str(error).split())}"
  if error.errno not in _OF_THE_MACHINE:
    raise error
  where = f"{error.filename}: " if error.filename else ""
  return f"error: {where}{error.strerror}."


def nearest(name: str, known: Iterable[str]) -> str:
  """Returns ' Did you mean X?' for a name that begins so, else for the closest, else those that begin alike.

  Of names that are close, one that shares the first three quarters of the letters comes first.
  """
  lowered = {k.lower(): k for k in known}
  begun = [k for k in lowered if len(name) > 3 and k.startswith(name.lower())]
  alike = [k for k in lowered if len(name) > 3 and k.startswith(name[: 3 * len(name) // 4].lower())]
  close = lambda names: difflib.get_close_matches(name.lower(), names, n=1, cutoff=0.5)
  match = begun or close(alike) or close(lowered)
  if match:
    return f" Did you mean {lowered[match[0]]!r}?"
  alike = [lowered[k] for k in lowered if len(name) > _ALIKE and k.startswith(name[:_ALIKE].lower())]
  return f" These begin alike: {', '.join(sorted(alike)[:_LISTED])}." if alike else ""


def lookup(table: Mapping[str, T], name: str, key: str) -> T:
  """Returns `table[name]`, where `key` is the configuration key that holds the name.

  Raises:
    UnknownNameError: the table has no such name; the message gives the nearest.
  """
  if name not in table:
    known = f"choose from {', '.join(table)}" if table else "there are none"
    has = f"; {known}" if len(table) <= _MANY else ""
    raise UnknownNameError(f"{key}: {name!r} is unknown{has}.{nearest(str(name), table)}")
  return table[name]
