"""`playground-run`: composes a run's configuration, checks it, trains.

The flags are Hydra's, except `--help`, `--verbose`, `--version` and `-m`. `--cfg job` and training share one
composition; `--hydra-help`, `--info`, `--shell-completion` and `hydra.` keys go to Hydra's app. `-m` starts a sweep,
whose jobs run in separate processes (`playground.sweep`).
"""

import argparse
import faulthandler
import itertools
import os
import re
import signal
import sys
import threading
from collections.abc import Sequence
from typing import NoReturn

import hydra
from hydra._internal.utils import get_args_parser  # Hydra has no public name for its own flags
from hydra.errors import HydraException

from playground import __version__
from playground.cli.header import header
from playground.config import (
  RunConfig,
  command_lines,
  compose,
  compose_all,
  config_roots,
  is_hydras,
  parse_with_hydra,
  register_options,
  search_path_override,
  to_yaml,
  tree,
  values_to_yaml,
)
from playground.console import lasting_stdout
from playground.errors import ConfigError, PlaygroundError, UnknownNameError, one_sentence
from playground.gc_pause import gc_paused
from playground.rendering.gl import withhold_gl
from playground.runs.wandb_artifacts import local_path
from playground.settings import nodes
from playground.trust import trust

_COMPLETION = re.compile("(install|uninstall|query)=(bash|fish|zsh)")


def main() -> None:
  """Runs the command and exits: 0 done, 2 an error that the user can act on, 128 plus a signal's number after it."""
  if not faulthandler.is_enabled():
    faulthandler.enable()  # a crash in a driver or a compiler prints where
  withhold_gl()
  os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # any other error is a bug: show the traceback
  try:
    with lasting_stdout():
      code = _main(sys.argv[1:])
  except (PlaygroundError, HydraException, OSError) as error:
    code = _report(error)
  except KeyboardInterrupt:  # before training listens for signals
    code = 128 + signal.SIGINT
  if any(thread.name.startswith(("compiler", "preflight")) for thread in threading.enumerate()):
    # Interrupted while compiling, or other machines did not answer: a normal exit might wait for minutes.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
  sys.exit(code)


def _main(argv: Sequence[str]) -> int:
  if "--version" in argv:  # Hydra's option of this name prints Hydra's version
    print(f"playground-run {__version__}")
    return 0
  first, *others = [[*run] for apart, run in itertools.groupby(argv, "--".__eq__) if not apart] or [[]]
  if others:
    return _together(first, others)
  verbose, argv = "--verbose" in argv, [arg for arg in argv if arg != "--verbose"]
  parser = get_args_parser()
  parser.error = _refuse
  args, others = parser.parse_known_args(argv)
  if unknown := [other for other in others if other.startswith("-")]:
    raise ConfigError(f"{unknown[0]} is no option: `playground-run --help` shows them, and the keys.")
  overrides = [*args.overrides, *others]
  flags = [arg for arg in argv if arg not in overrides]
  _check_flags(args, overrides)
  words = [text for text in overrides if args.help and "=" not in text]
  overrides, trusted = _trusted([text for text in overrides if text not in words])
  trust(*trusted)
  if args.hydra_help or args.info or args.shell_completion:
    return _hydra_app(flags, overrides)
  if args.help:
    return _help(words, overrides)
  overrides = [_downloaded(text) for text in overrides]
  if args.multirun:
    return _sweep(overrides, args.cfg, args.package, trusted)
  config = compose(overrides)
  if args.cfg == "job":
    print(_shown(config, args.package), end="")
    return 0
  hydras = [text for text in overrides if is_hydras(text)]
  if args.cfg or hydras:
    return _hydra_app(flags, [*config.overrides, *hydras], config, verbose)
  return _train(config, verbose)


def _together(overrides: Sequence[str], others: Sequence[Sequence[str]]) -> int:
  """Trains several runs in one program (`playground.runs.together`); `--` separates their overrides.

  `--exploit-every` and `--explore` before the first run's overrides make the runs a population. Overrides of the whole
  command (`trust`, `hardware.cache_dir`) are among the first run's.
  """
  parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
  parser.add_argument("--exploit-every", type=int, default=0)
  parser.add_argument("--explore", action="append", default=[])
  population, overrides = parser.parse_known_args(overrides)
  overrides, trusted = _trusted(overrides)
  trust(*trusted)
  common = command_lines(overrides)
  configs = compose_all([overrides, *([*common, *run] for run in others)])
  from playground.envs.options import impl_on_gpu
  from playground.physics.warp_kernels import prestart

  prestart(impl_on_gpu(configs[0].env), configs[0].hardware.platform)
  print("\n".join([*header(configs[0]), f"  {'together':<10} {len(configs)} agents in one program"]), flush=True)
  with gc_paused(stays=True):
    from playground.runs.together import train_together

  return train_together(configs, population.exploit_every, population.explore)


def _downloaded(override: str) -> str:
  """Downloads a policy from W&B and returns the override with its path: a configuration never names W&B."""
  key, equals, value = override.partition("=")
  return f"{key}={local_path(value)}" if key == "init_from" and equals else override


def _help(keys: Sequence[str], overrides: Sequence[str]) -> int:
  """Prints the page of `print_help`, or explains a key."""
  if not keys:
    from playground.cli.help import print_help  # imports rich

    print_help()
    return 0
  if len(keys) > 1:
    raise ConfigError(f"--help {' '.join(keys)}: one key at a time.")
  from playground.cli.keys import show_keys

  return show_keys(keys[0], overrides)


def _hydra_app(
  flags: Sequence[str], overrides: Sequence[str], config: RunConfig | None = None, verbose: bool = False
) -> int:
  """Runs Hydra's app, which shows Hydra's configuration, or trains with settings of `hydra.` keys."""
  codes = []

  def job(_: object) -> None:
    assert config is not None, "composed unless Hydra only shows something"
    try:
      codes.append(_train(config, verbose))
    except PlaygroundError as error:  # Hydra would print a line of its own
      codes.append(_report(error))

  register_options()
  roots = config_roots()
  sys.argv[1:] = [*overrides, *search_path_override(roots), *flags]  # last, since --info may stand alone
  hydra.main(config_path=str(roots[0]), config_name="config", version_base="1.3")(job)()
  return next(iter(codes), 0)


def _shown(config: RunConfig, package: str | None) -> str:
  """Returns the configuration, or its section at a dotted key, as YAML."""
  if package is None:
    return to_yaml(config)
  known = dict(nodes(config.resolved))
  if package not in known:
    raise UnknownNameError(f"--package {package}: the configuration has no such key.")
  return values_to_yaml(known[package])


def _refuse(message: str) -> NoReturn:
  raise ConfigError(f"{message}: `playground-run --help` shows the options, and the keys.")


def _check_flags(args: argparse.Namespace, overrides: Sequence[str]) -> None:
  """Raises ConfigError for flags of Hydra that have no effect here, or that need another flag."""
  for name in ("config_path", "config_name", "config_dir", "experimental_rerun"):
    if getattr(args, name) is not None:
      _refuse(f"--{name.replace('_', '-')} is no option")
  if (args.resolve or args.package) and not args.cfg:
    _refuse(f"--{'resolve' if args.resolve else 'package'} goes with --cfg job")
  if args.shell_completion and not (len(overrides) == 1 and _COMPLETION.fullmatch(overrides[0])):
    _refuse("--shell-completion takes install=<shell>, uninstall=<shell> or query=<shell>, of bash, fish and zsh")


def _train(config: RunConfig, verbose: bool) -> int:
  from rich.console import Console

  from playground.envs.options import impl_on_gpu
  from playground.physics.warp_kernels import prestart

  prestart(impl_on_gpu(config.env), config.hardware.platform)
  print("\n".join(header(config)), flush=True)
  if verbose:
    Console().print(tree(config))
  with gc_paused(stays=True):
    from playground.runs.train import train  # imports JAX

  return train(config)


def _trusted(overrides: Sequence[str]) -> tuple[list[str], list[str]]:
  """Splits off `trust=<package>` and `trust=[<package>, ...]`: returns the other overrides, and the packages."""
  others, packages = [], []
  for text in overrides:
    override = parse_with_hydra(text)
    if override.key_or_group != "trust":
      others.append(text)
    elif override.is_sweep_override():
      raise ConfigError(f"{text}: write trust=[{text.partition('=')[2]}] for several packages.")
    else:
      value = override.value()
      packages += value if isinstance(value, list) else [value]
  return others, packages


def _sweep(overrides: Sequence[str], show: str | None, package: str | None, trusted: Sequence[str]) -> int:
  if show is not None:
    from playground.sweep.plan import compose_jobs

    if show != "job":
      raise ConfigError(f"--cfg {show} shows one run: leave -m out; --cfg job shows all jobs of a sweep.")
    print(
      "---\n".join(f"# {' '.join(config.overrides)}\n{_shown(config, package)}" for config in compose_jobs(overrides))
    )
    return 0
  with gc_paused():  # JAX's callback of the collector would swallow a Ctrl+C
    from playground.sweep.plan import plan
    from playground.sweep.runner import run_sweep
    from playground.sweep.worker import job_command

    planned = plan(overrides)
  return run_sweep(*planned, job_command(trusted, command_lines(overrides)))


def _report(error: Exception) -> int:
  sys.stdout.flush()
  print(one_sentence(error), file=sys.stderr)
  return 2


if __name__ == "__main__":
  main()
