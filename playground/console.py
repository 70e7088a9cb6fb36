"""Standard output: what commands print to."""

import contextlib
import errno
import os
import sys
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
  from rich.console import Console


def wide_console(columns: int = 240) -> "Console":
  """Returns a console for tables: as wide as the terminal, or of so many columns where there is none."""
  from rich.console import Console

  console = Console()
  return console if console.is_terminal else Console(width=columns)


@contextlib.contextmanager
def lasting_stdout() -> Iterator[None]:
  """Lets a command go on, without output, once its terminal or the reader of its pipe is gone (`| head`)."""
  stream = _Lasting(sys.stdout)
  with contextlib.redirect_stdout(stream):  # pyright: ignore[reportArgumentType]
    try:
      yield
    finally:
      stream.flush()


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
