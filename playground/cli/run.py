"""`playground-run`: composes a run's configuration, checks it, trains.

Our check comes first, so that a mistake is one sentence; the rest is a Hydra app, with its flags (`--cfg job`,
`--help`, `--info`, `-m`).
"""

import os
import signal
import sys
import threading
from collections.abc import Sequence

import hydra
from hydra._internal.utils import get_args_parser  # Hydra has no public name for its own flags
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException

from playground.config import (
  RunConfig,
  compose,
  config_roots,
  expand,
  first_job,
  is_hydras,
  search_path_override,
  to_yaml,
  tree,
  with_default_experiment,
)
from playground.errors import PlaygroundError
from playground.rendering.gl import withhold_gl


def main() -> None:
  """Runs the command and exits: 0 done, 2 for what the user can act on, 130 or 143 when interrupted."""
  withhold_gl()
  os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # what is not a PlaygroundError is a bug: show all of it
  try:
    code = _main(sys.argv[1:])
  except (PlaygroundError, HydraException) as error:
    code = _report(error)
  except BrokenPipeError:  # `playground-run --help | head`
    sys.stderr.close()
    code = 0
  except KeyboardInterrupt:  # before training listens for signals
    code = 128 + signal.SIGINT
  if any(thread.name.startswith("compiler") for thread in threading.enumerate()):
    # Interrupted while compiling: a normal exit would wait for the compiler, minutes perhaps.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
  sys.exit(code)


def _main(argv: Sequence[str]) -> int:
  args, others = get_args_parser().parse_known_args(argv)
  overrides = [*args.overrides, *(other for other in others if not other.startswith("-"))]
  flags = [arg for arg in argv if arg not in overrides]
  config = None
  if args.help:
    overrides = with_default_experiment(overrides)
  elif args.multirun:
    overrides = with_default_experiment(expand(overrides))
    compose(first_job(overrides))  # what is wrong with it is mostly wrong with all; the others are checked as they come
  elif not (args.hydra_help or args.info or args.shell_completion):
    config = compose(overrides)
    overrides = [*config.overrides, *filter(is_hydras, overrides)]
    if args.cfg == "job" and config.resume:  # the run's own, which Hydra cannot compose
      print(to_yaml(config))
      return 0

  codes = []

  def job(_: object) -> None:
    codes.append(_train(config, list(HydraConfig.get().overrides.task)))

  roots = config_roots()
  sys.argv[1:] = [*flags, *overrides, *search_path_override(roots)]
  hydra.main(config_path=str(roots[0]), config_name="config", version_base="1.3")(job)()
  return next((code for code in codes if code), 0)


def _train(config: RunConfig | None, overrides: Sequence[str]) -> int:
  try:
    config = config or compose(overrides)
    from rich.console import Console

    Console().print(tree(config))
    from playground.runs.train import train  # imports JAX

    return train(config)
  except PlaygroundError as error:
    return _report(error)


def _report(error: Exception) -> int:
  sys.stdout.flush()
  print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
  return 2
