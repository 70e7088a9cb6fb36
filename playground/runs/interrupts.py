"""Handles SIGINT, SIGTERM and SIGHUP: finish the current step, save, exit."""

import contextlib
import os
import signal
import stat
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Self


class Interrupted(BaseException):
  """The process got a signal while it had nothing to save yet, or a second signal."""

  def __init__(self, signum: int):
    super().__init__(signal.Signals(signum).name)
    self.signum = signum


@contextlib.contextmanager
def on_signals(handle: Callable[[int, FrameType | None], object]) -> Iterator[None]:
  """Handles SIGINT, SIGTERM and (unless `nohup` ignores it) SIGHUP by `handle` in the block; main thread only."""

  def hang_up(signum: int, frame: FrameType | None) -> None:
    _leave_terminal()
    handle(signum, frame)

  handlers = {signal.SIGINT: handle, signal.SIGTERM: handle}
  if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
    handlers[signal.SIGHUP] = hang_up
  before = {signum: signal.signal(signum, handler) for signum, handler in handlers.items()}
  try:
    yield
  finally:
    for signum, handler in before.items():
      signal.signal(signum, handler)


@contextlib.contextmanager
def noted_signals() -> Iterator[threading.Event]:
  """Yields an event that the signals of `on_signals` set, for callbacks of C code, which swallow exceptions."""
  received = threading.Event()
  with on_signals(lambda *_: received.set()):
    yield received


class Interrupts:
  """Turns the first signal into a flag while `saving` is on, and into `Interrupted` otherwise."""

  def __init__(self) -> None:
    self.signum: int | None = None
    self.saving = False
    self._handlers = contextlib.ExitStack()

  def __enter__(self) -> Self:
    self._handlers.enter_context(on_signals(self._handle))
    return self

  def __exit__(self, *exc: object) -> None:
    self._handlers.close()

  def start_saving(self) -> None:
    """Makes the next signal set a flag. Raises `Interrupted` if there was a signal already.

    Destructors and callbacks of C code, of which compilation has many, swallow the exception that a signal raises in
    them.
    """
    self.saving = True
    if self.signum is not None:
      raise Interrupted(self.signum)

  def stop_saving(self) -> None:
    """Ends saving; a flag that is set stays set."""
    self.saving = False

  def exit_code(self, completed: bool) -> int:
    """Returns 0, or the signal's exit code if there was one before the work was completed.

    In a training of several processes another one may have got the signal: then it is SIGTERM's.
    """
    from playground.hardware.distributed import is_multiprocess  # imports JAX, which a sweep goes without

    signum = signal.SIGTERM if self.signum is None and is_multiprocess() else self.signum
    return 0 if signum is None or completed else exit_code(signum)

  def _handle(self, signum: int, frame: FrameType | None) -> None:
    again, self.signum = self.signum is not None, signum
    if not self.saving or again:
      raise Interrupted(signum)


def exit_code(signum: int) -> int:
  """Returns the exit code of a process that the signal ended: 130 for SIGINT, 143 for SIGTERM, 129 for SIGHUP."""
  return 128 + signum


def _leave_terminal() -> None:
  """Discards output to a terminal that is gone: writing to it raises."""
  for stream in (1, 2):
    if stat.S_ISCHR(os.fstat(stream).st_mode) and not os.isatty(stream):
      nowhere = os.open(os.devnull, os.O_WRONLY)
      os.dup2(nowhere, stream)
      os.close(nowhere)
