"""`playground-bench`: measures speed and memory, reports the rows and checks ratios."""

import importlib
import signal
import sys
from collections.abc import Sequence

from playground import __version__
from playground.benchmark.arguments import help_of, parse
from playground.benchmark.commands import COMMANDS, run
from playground.console import lasting_stdout
from playground.errors import PlaygroundError, UnknownNameError, nearest, one_sentence

# Measurements are in one module; each other command is a module with `Options` and `run(options) -> exit code`.
OTHERS = {name: f"playground.benchmark.{name}" for name in ("golden", "record", "report", "gate")}


def main() -> None:
  """Runs a command and exits: 0 done, 1 failed, 2 an error that the user can act on, 3 time up with jobs left."""
  signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))  # SystemExit ends the child processes
  try:
    with lasting_stdout():
      code = _main(sys.argv[1:])
  except (PlaygroundError, OSError) as error:
    print(one_sentence(error), file=sys.stderr)
    code = 2
  except KeyboardInterrupt:
    code = 130
  sys.exit(code)


def _main(argv: Sequence[str]) -> int:
  name = argv[0] if argv else "--help"
  known = [*COMMANDS, *OTHERS]
  if name in ("-h", "--help", "help"):
    _print_help()
    return 0
  if name == "--version":
    print(f"playground-run {__version__}")
    return 0
  if name not in known:
    raise UnknownNameError(f"playground-bench has no command {name}: it has {', '.join(known)}.{nearest(name, known)}")
  module = importlib.import_module(OTHERS[name]) if name in OTHERS else None
  options = module.Options if module else COMMANDS[name]
  if any(text in ("-h", "--help", "help") for text in argv[1:]):
    print(f"playground-bench {name} [key=value ...]\n\n{options.__doc__}\n")
    print("\n".join(help_of(options)))
    return 0
  parsed = parse(name, options, argv[1:])
  return module.run(parsed) if module else run(parsed)


def _print_help() -> None:
  print("playground-bench <command> [key=value ...]; `playground-bench <command> --help` shows a command's keys.\n")
  docs = {name: command.__doc__ for name, command in COMMANDS.items()}
  docs |= {name: importlib.import_module(module).Options.__doc__ for name, module in OTHERS.items()}
  for name, doc in docs.items():
    print(f"  {name:12}{(doc or '').splitlines()[0]}")


if __name__ == "__main__":
  main()
