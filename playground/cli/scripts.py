"""The console scripts. They import their commands within a `try`: Ctrl+C ends a command quietly from the start."""

import functools
import importlib
import sys


def _start(module: str) -> None:
  try:
    importlib.import_module(module).main()
  except KeyboardInterrupt:
    sys.exit(130)  # the code of a shell for SIGINT


run, main, bench = (functools.partial(_start, f"playground.cli.{name}") for name in ("run", "main", "bench"))
