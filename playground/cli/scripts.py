"""The console scripts. They import their commands within a `try`: Ctrl+C ends a command quietly from the start."""

import functools
import importlib
import os
import sys


def _start(module: str) -> None:
  for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
    if getattr(sys, name) is None:  # closed, as by `>&-`
      setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode))
  try:
    importlib.import_module(module).main()
  except KeyboardInterrupt:
    sys.exit(130)  # the code of a shell for SIGINT
  except ImportError as error:  # as a module in C reports an interrupt of its imports
    if not isinstance(error.__cause__, KeyboardInterrupt):
      raise
    sys.exit(130)


run, main, bench = (functools.partial(_start, f"playground.cli.{name}") for name in ("run", "main", "bench"))
