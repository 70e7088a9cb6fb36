"""For all tests: what compiling leaves behind costs neither time nor memory that is not there."""

import ctypes
import gc
import logging
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest

EMPTY = 1e9  # bytes that a worker holds with everything imported
GROWTH = 1.5e9  # bytes by which it may grow before JAX forgets what it has traced and compiled

# JAX makes millions of objects that stay: at Python's own thresholds, looking through them again and again is a tenth
# of all the time.
gc.set_threshold(50_000, 50, 50)


def resident_bytes() -> int:
  pages = Path("/proc/self/statm").read_text().split()[1]
  return int(pages) * os.sysconf("SC_PAGE_SIZE")


@pytest.fixture(scope="session")
def allowed() -> list[float]:
  """The size (bytes) at which this worker is emptied next."""
  return [EMPTY + GROWTH]


@pytest.fixture(autouse=True)
def bounded_memory(allowed: list[float]) -> Iterator[None]:
  yield
  if sys.platform == "linux" and resident_bytes() > allowed[0]:
    jax.clear_caches()
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # the heap's free pages go back
    allowed[0] = max(EMPTY, resident_bytes()) + GROWTH  # above what stays, else every test would empty it


@pytest.fixture(autouse=True)
def logging_as_before() -> Iterator[None]:
  """Hydra's `--info` and hydra.verbose=true give the root logger a level, and a handler on what pytest closes."""
  root = logging.getLogger()
  level, handlers = root.level, list(root.handlers)
  yield
  root.setLevel(level)
  for handler in root.handlers[:]:
    if handler not in handlers:
      root.removeHandler(handler)
