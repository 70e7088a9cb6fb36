"""Consoles on standard output."""

import errno
import os
import sys
from collections.abc import Callable
from typing import TextIO

from rich.console import Console


def lasting_console() -> Console:
  """Returns a console whose user goes on, without output, once the terminal or the reader of the pipe is gone."""
  return Console(file=_Lasting(sys.stdout))  # pyright: ignore[reportArgumentType]


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
