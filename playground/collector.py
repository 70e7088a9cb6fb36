"""Python's garbage collector, kept out of where it only costs time."""

import contextlib
import functools
import gc
from collections.abc import Iterator


@contextlib.contextmanager
def uncollected(stays: bool = False) -> Iterator[None]:
  """Makes objects without the collector, which looks through all there are again and again: a quarter of an import.

  Args:
    stays: what is there at the end stays until the process ends (modules), so it is never looked through again.
  """
  collecting = gc.isenabled()
  gc.disable()
  try:
    yield
  finally:
    if stays:
      _freeze()
    if collecting:
      gc.enable()


@functools.cache  # once in a process: a second time would keep what should go, too
def _freeze() -> None:
  gc.freeze()
