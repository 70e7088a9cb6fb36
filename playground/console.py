"""Consoles on standard output."""

import errno
import os
import sys
from collections.abc import Callable
from typing import TextIO

from rich.console import Console


def lasting_console(columns: int | None = None) -> Console:
  """Returns a console whose user goes on, without output, once the terminal or the reader of the pipe is gone."""
  return Console(file=_Lasting(sys.stdout), width=columns)  # pyright: ignore[reportArgumentType]


def wide_console(columns: int = 240) -> Console:
  """Returns a console for tables: as wide as the terminal, or of so many columns where there is none."""
  console = lasting_console()
  return console if console.is_terminal else lasting_console(columns)


class _Lasting:
  """A stream that goes to /dev/null once nobody reads it: SIGHUP follows a lost terminal, and nothing a lost reader."""

  def __init__(self, stream: TextIO):
    self._stream = stream

  def write(self, text: str) -> None:
    self._unless_gone(self._stream.write, text)

  def flush(self) -> None:
    self._unless_gone(self._stream.flush)

  def __getattr__(self, name: str) -> object:
    return getattr(self._stream, name)

  def _unless_gone(self, call: Callable[..., object], *args: str) -> None:
    try:
      call(*args)
    except OSError as error:
      if error.errno not in (errno.EIO, errno.EPIPE):
        raise
      nowhere = os.open(os.devnull, os.O_WRONLY)
      os.dup2(nowhere, self._stream.fileno())  # for `print`, for child processes and for what is still buffered
      os.close(nowhere)
