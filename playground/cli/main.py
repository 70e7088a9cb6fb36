"""`playground`: all commands; `train` and `bench` are `playground-run` and `playground-bench`."""

import argparse
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from playground import __version__, registry
from playground.cli.completion import SHELLS, commands_of
from playground.console import lasting_stdout
from playground.errors import ConfigError, PlaygroundError, UnknownNameError, nearest, one_sentence
from playground.limits import SEED, count
from playground.pretrained import working_copy
from playground.rendering.gl import withhold_gl
from playground.runs.wandb_artifacts import local_path
from playground.trust import trust

# Limits of the options of all commands.
_NUMBERS = {
  "seed": SEED,
  "episodes": count(1, 100_000),
  "num_views": count(1, 1024),
  "envs": count(1),
  "steps": count(1),
  "port": count(0, 65535),
}


# Commands with their own parsers: module and help.
_PROGRAMS = {
  "train": ("playground.cli.run", "Train a policy, or sweep with -m; the same as playground-run."),
  "bench": ("playground.cli.bench", "Measure speed and memory; the same as playground-bench."),
}
_RUN = "run directory, checkpoint, a task for its pretrained policy, or wandb:<entity>/<project>/<run>"
_CAMERA = "camera of --video (default: video.camera of a run, else one that shows the whole scene)"
_TASK_VALUES = "other values of the task, such as terrain=stairs or env.episode_length=500"
Command = Callable[[argparse.Namespace], int]  # returns the exit code


def main() -> None:
  """Runs a command and exits with its code; 2 for errors that the user can act on."""
  if len(sys.argv) > 1 and sys.argv[1] in _PROGRAMS:
    importlib.import_module(_PROGRAMS[sys.argv.pop(1)][0]).main()
  withhold_gl()
  try:
    with lasting_stdout():
      args = _arguments()
      trust(*args.trust)
      _check_numbers(args)
      code = args.command(args)
  except KeyboardInterrupt:
    code = 130  # the code of a shell for SIGINT
  except (PlaygroundError, OSError) as error:
    print(one_sentence(error), file=sys.stderr)
    code = 2
  sys.exit(code)


def _arguments() -> argparse.Namespace:
  """Parses the command line; overrides may also follow options. Raises UnknownNameError for an unknown command."""
  parser, name = _parser(), next(iter(sys.argv[1:]), "-")
  if name not in (known := commands_of(parser)) and not name.startswith("-"):
    raise UnknownNameError(f"playground {name} does not exist: choose from {', '.join(known)}.{nearest(name, known)}")
  args, rest = parser.parse_known_args()
  unknown = [text for text in rest if text.startswith("-") or "=" not in text or "overrides" not in args]
  if unknown:
    parser.error(f"unrecognized arguments: {' '.join(unknown)}")
  if rest:
    args.overrides += rest
  return args


def _check_numbers(args: argparse.Namespace) -> None:
  for name, limit in _NUMBERS.items():
    value = getattr(args, name, None)
    if value is not None and not limit.allows(value):
      raise ConfigError(f"--{name.replace('_', '-')}={value} must be {limit}.")


def _parser() -> argparse.ArgumentParser:
  parser = argparse.ArgumentParser(prog="playground", description="Robot learning on GPU-batched MuJoCo.")
  version = f"playground-run {__version__}"
  parser.add_argument("--version", action="version", version=version, help="print the version")
  commands = parser.add_subparsers(required=True, metavar="command")

  def add(name: str, command: Command | str, what: str) -> argparse.ArgumentParser:
    sub = commands.add_parser(name, help=what, description=what)
    sub.add_argument("--version", action="version", version=version, help=argparse.SUPPRESS)
    sub.set_defaults(command=_call(command) if isinstance(command, str) else command, trust=[])
    return sub

  for name, (_, what) in _PROGRAMS.items():
    commands.add_parser(name, help=what)

  tasks = add("list", _list, "List tasks: sizes, budget, and how far the reference run got.")
  tasks.add_argument("word", nargs="?", help="only tasks whose name contains it")
  for name in ("suite", "robot", "status", "backend"):
    tasks.add_argument(f"--{name}", metavar="NAME", help=f"only tasks of this {name}")
  tasks.add_argument("--json", action="store_true", help="print JSON instead of a table")
  show = add("show", "cli.show:show", "Show a task's observations, rewards, terminations, events and hyperparameters.")
  show.add_argument("task", help="a task, or randomization=<name> for its events")
  show.add_argument("overrides", nargs="*", help="as for playground-run, such as robot=go1 or env.impl=jax")
  show.add_argument("--views", metavar="FILE", help="write images of its camera on randomised models instead")
  show.add_argument("--num-views", type=int, help="randomised models of --views (default: 16)")
  keys = add("keys", "cli.keys:show_keys", "Explain a section's or group's keys: value, allowed values and meaning.")
  keys.add_argument("prefix", help="such as agent, env.rewards, hardware.platform or tracking")
  keys.add_argument("overrides", nargs="*", help="as for playground-run, such as env=Go1Getup or agent=sac")
  completion = add("completion", _completion, "Print a script that completes our commands in a shell.")
  completion.add_argument("shell", choices=(*SHELLS, "query"), help="eval it in the shell's start file")
  completion.add_argument("line", nargs="?", default="", help=argparse.SUPPRESS)  # of query, which the scripts call
  add("doctor", "cli.doctor:doctor", "Check this machine: backend, versions, rendering, caches, missing packages.")
  evaluate = add("eval", "cli.eval:evaluate_run", "Evaluate a run's newest checkpoint, or the one given.")
  evaluate.add_argument("path", metavar="run", help=_RUN)
  evaluate.add_argument("overrides", nargs="*", help=_TASK_VALUES)
  evaluate.add_argument("--episodes", type=int, help="episodes to run (default: the run's agent.num_eval_envs)")
  evaluate.add_argument("--seed", type=int, default=0, help="seed of the episodes (default: %(default)s)")
  evaluate.add_argument(
    "--deterministic", action="store_true", help="act on the distribution's mode (default: agent.deterministic_eval)"
  )
  evaluate.add_argument("--video", metavar="FILE", help="also render an episode to this .mp4")
  evaluate.add_argument("--camera", metavar="NAME", help=_CAMERA)
  export = add(
    "export", "deploy.export:export_run", "Write a policy as ONNX, with joint order, gains and rates in policy.yaml."
  )
  export.add_argument("path", metavar="run", help=_RUN)
  export.add_argument("--out", metavar="FOLDER", help="folder to write to (default: <run>/export)")
  play = add("play", _play, "Run a policy in plain C MuJoCo: measure it, film it or watch it.")
  play.add_argument("policy", help=f"{_RUN}, or a policy.onnx beside its policy.yaml, or their folder")
  play.add_argument("overrides", nargs="*", help=_TASK_VALUES)
  play.add_argument(
    "--agent", choices=("zero", "random"), help="zero or random actions on a task, in place of a policy"
  )
  play.add_argument("--episodes", type=int, help="episodes to measure (default: 10)")
  play.add_argument("--seed", type=int, default=0, help="seed of the episodes (default: %(default)s)")
  shown = _add_places(play, "also render an episode to this .mp4")
  shown.add_argument("--web", action="store_true", help="show it in the browser instead")
  view = add("view", _view, "Show a task in the browser, without a policy.")
  view.add_argument("task", help="a task of `playground list`")
  view.add_argument("overrides", nargs="*", help="as for playground-run, such as terrain=stairs")
  view.add_argument(
    "--agent", choices=("zero", "random"), default="zero", help="zero or random actions (default: %(default)s)"
  )
  view.add_argument("--seed", type=int, default=0, help="seed of episodes and model (default: %(default)s)")
  _add_places(view, "render an episode to this .mp4 instead")
  pretrained = add("pretrained", _pretrained, "List the policies that come with the package, or add a run's.")
  pretrained.add_argument("--add", metavar="RUN", help="measure a run's policy in C MuJoCo and put it into the package")
  pretrained.add_argument(
    "--note",
    default="",
    metavar="TEXT",
    help="with --add: a remark on the training, for its card; 'solved: <why>' sets its status",
  )
  pretrained.add_argument("--replace", action="store_true", help="with --add: replace the policy of the same task")
  sweep = add("sweep", _sweep, "Show a sweep, collect its results, or run its missing jobs.")
  sweep.add_argument(
    "action",
    choices=("status", "collect", "retry", "stop"),
    help="status: show all jobs; collect: write tables and plots; retry: run what is missing; stop: save and end jobs",
  )
  sweep.add_argument("folder", help="folder of the sweep")
  sweep.add_argument("overrides", nargs="*", help="for retry, such as launcher=slurm or launcher.slots_per_gpu=2")
  tune = add("tune-buffers", "cli.tune_buffers:tune_buffers", "Measure how large Warp's buffers must be for a task.")
  tune.add_argument("task", help="a task of `playground list`")
  tune.add_argument("overrides", nargs="*", help="as for playground-run, such as robot=go1 or agent.num_envs=4096")
  tune.add_argument("--run", help="a run or checkpoint whose policy acts, beside random actions")
  tune.add_argument("--envs", type=int, default=256, help="environments (default: %(default)s)")
  tune.add_argument("--steps", type=int, default=500, help="policy steps in each environment (default: %(default)s)")
  replay = add("replay", "cli.replay:replay", "Repeat a run's step that was NaN, infinite or too large.")
  replay.add_argument("file", metavar="dump", help="a run's nan_dump/step_*.npz")
  for builds_tasks in (show, keys, evaluate, export, play, view, sweep, tune, replay):
    builds_tasks.add_argument(
      "--trust", action="append", metavar="PACKAGE", help="let the configuration name task classes of this package, too"
    )
  return parser


def _add_places(parser: argparse.ArgumentParser, video: str) -> argparse._MutuallyExclusiveGroup:
  """Adds the options that choose how and where to show a policy or a task; returns the group of the exclusive ones."""
  shown = parser.add_mutually_exclusive_group()
  shown.add_argument("--video", metavar="FILE", help=video)
  shown.add_argument("--viewer", action="store_true", help="show it in MuJoCo's viewer instead")
  parser.add_argument("--camera", metavar="NAME", help=_CAMERA)
  parser.add_argument(
    "--no-events", dest="interval_events", action="store_false", help="switch pushes and other interval events off"
  )
  parser.add_argument(
    "--randomize", action="store_true", help="draw the model by the task's startup events, one for each episode"
  )
  parser.add_argument("--host", help="address that the page listens on (default: 127.0.0.1)")
  parser.add_argument("--port", type=int, help="port of the page (default: 8080)")
  return shown


def _call(place: str) -> Command:
  """Returns a command that calls `module:function` with the arguments by name."""
  module, _, function = place.partition(":")

  def command(args: argparse.Namespace) -> int:
    values = _named(args)
    if "path" in values:
      values["path"] = _run_path(values["path"])
    return getattr(importlib.import_module(f"playground.{module}"), function)(**values)

  return command


def _named(args: argparse.Namespace, *others: str) -> dict[str, Any]:
  """Returns the arguments by name, without `others` and those that every command has."""
  return {name: value for name, value in vars(args).items() if name not in ("command", "trust", *others)}


def _list(args: argparse.Namespace) -> int:
  from playground.cli.list_tasks import FILTERS, list_tasks

  found = registry.names(args.word)
  if not found:
    near = nearest(args.word, registry.names())
    raise UnknownNameError(f"No task's name contains {args.word!r}: `playground list` shows all.{near}")
  return list_tasks(found, {name: getattr(args, name) for name in FILTERS}, args.json)


def _run_path(name: str) -> str:
  """Returns the path of a run that a command line names: a path, a pretrained policy or a run on W&B."""
  tasks = registry.names()
  if name.isidentifier() and name not in tasks and not Path(name).exists():
    raise UnknownNameError(f"{name} is no run directory, checkpoint or task.{nearest(name, tasks)}")
  return working_copy(local_path(name), tasks)


def _play(args: argparse.Namespace) -> int:
  from playground.cli.play import play
  from playground.config import options

  if args.agent and args.policy.removeprefix("env=") not in options("env"):
    near = nearest(args.policy, registry.names())
    raise UnknownNameError(f"--agent={args.agent} acts on a task, and {args.policy} is none.{near}")
  if args.episodes is not None and (args.web or args.viewer):
    raise ConfigError(
      f"--episodes={args.episodes} are measured, and --{'web' if args.web else 'viewer'} measures none."
    )
  _need_page(args, args.web)
  return play(args.policy if args.agent else _run_path(args.policy), **_given(args, "policy"))


def _view(args: argparse.Namespace) -> int:
  from playground.cli.play import play

  web = not (args.video or args.viewer)
  _need_page(args, web)
  return play(args.task, episodes=1, web=web, **_given(args, "task"))


def _need_page(args: argparse.Namespace, web: bool) -> None:
  """Raises ConfigError for options of the page in the browser where there is none."""
  for name in ("host", "port"):
    if (value := getattr(args, name)) is not None and not web:
      raise ConfigError(f"--{name}={value} is of the page in the browser, which this command does not show.")


def _given(args: argparse.Namespace, *others: str) -> dict[str, Any]:
  """Returns the arguments as `_named`, without those that were not given."""
  return {name: value for name, value in _named(args, *others).items() if value is not None}


def _pretrained(args: argparse.Namespace) -> int:
  from playground.cli import pretrained

  if not args.add and (args.note or args.replace):
    raise ConfigError(f"{'--replace' if args.replace else '--note'} needs --add=<run>.")
  return pretrained.add_policy(args.add, args.note, args.replace) if args.add else pretrained.show_policies()


def _sweep(args: argparse.Namespace) -> int:
  from playground.cli import sweep

  if args.overrides and args.action != "retry":
    raise ConfigError(f"{args.overrides[0]}: only `playground sweep retry` takes overrides.")
  if args.action == "retry":
    return sweep.retry(args.folder, *args.overrides, trust=args.trust)
  return getattr(sweep, args.action)(args.folder)


def _completion(args: argparse.Namespace) -> int:
  from playground.cli.completion import candidates, script

  print("\n".join(candidates(args.line, _parser())) if args.shell == "query" else script(args.shell), end="")
  return 0


if __name__ == "__main__":
  main()
