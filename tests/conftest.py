"""For all tests: what compiling leaves behind costs neither time nor memory that is not there."""

import ctypes
import functools
import gc
import logging
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import pytest

from playground.config import composition, config_roots

EMPTY = 1e9  # bytes that a worker holds with everything imported
MEMORY = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
GROWTH = max(1.5e9, MEMORY / 8)  # bytes by which it may grow before JAX forgets what it has traced and compiled

# JAX makes millions of objects that stay: at Python's own thresholds, looking through them again and again is a tenth
# of all the time.
gc.set_threshold(50_000, 50, 50)

# A shell starts background jobs (`make test &`) with SIGINT ignored, and Python leaves it so.
signal.signal(signal.SIGINT, signal.default_int_handler)


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
def trusted_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
  """`trust=my_package` holds for a process."""
  monkeypatch.setattr("playground.trust._named", set())


@pytest.fixture(autouse=True)
def nothing_stored(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
  """A stored program is found by the code in files, which is not what runs where a test replaces some of it.

  Tests that are marked `stored_programs` replace nothing that is traced: what one of them compiled, others load.
  """
  if not request.node.get_closest_marker("stored_programs"):
    monkeypatch.setattr("playground.runs.train.stored_program", lambda *_, **__: None)


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


@pytest.fixture(scope="session", autouse=True)
def composed_once() -> Iterator[None]:
  """Hydra reads the shipped files for a choice of groups once a worker: they do not change under the tests."""
  shipped, compose_files = tuple(config_roots()), composition._compose_files
  once = functools.cache(compose_files)

  def read(roots: Sequence[Path], *groups: str) -> Any:
    return once(shipped, *groups) if tuple(roots) == shipped else compose_files(roots, *groups)

  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(composition, "_compose_files", read)
    yield
