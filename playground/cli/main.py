"""`playground`: the commands beside training. They parse, call and print."""

import argparse
import sys
from typing import Any

from playground import __version__, registry
from playground.errors import ConfigError, PlaygroundError, UnknownNameError, nearest, one_sentence
from playground.limits import SEED, count
from playground.pretrained import working_copy
from playground.rendering.gl import withhold_gl
from playground.trust import trust

# Of all commands' options.
_NUMBERS = {
  "seed": SEED,
  "episodes": count(1, 100_000),
  "num_views": count(1, 1024),
  "envs": count(1),
  "steps": count(1),
  "port": count(0, 65535),
}


_RUN = "run directory, checkpoint, or a task, which stands for its pretrained policy"


def main() -> None:
  """Runs a command and exits with its code; 2 for what the user can act on."""
  withhold_gl()
  args = _arguments()
  try:
    trust(*args.trust)
    _check_numbers(args)
    code = args.command(args)
  except KeyboardInterrupt:
    code = 130  # as a shell counts it
  except BrokenPipeError:  # `playground list | head`
    sys.stderr.close()
    code = 0
  except (PlaygroundError, OSError) as error:
    print(one_sentence(error), file=sys.stderr)
    code = 2
  sys.exit(code)


def _arguments() -> argparse.Namespace:
  """What the command line says; overrides may stand after options, too."""
  parser = _parser()
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
  parser = argparse.ArgumentParser(prog="playground", description="Robot learning tasks; train with playground-run.")
  parser.add_argument("--version", action="version", version=f"playground-run {__version__}")
  commands = parser.add_subparsers(required=True, metavar="command")

  def add(name: str, command: Any, what: str) -> argparse.ArgumentParser:
    sub = commands.add_parser(name, help=what, description=what)
    sub.set_defaults(command=command, trust=[])
    return sub

  add("list", _list, "List tasks.").add_argument("word", nargs="?", help="only tasks whose name contains it")
  show = add("show", _show, "Show what a task observes, does, is paid for and is trained with.")
  show.add_argument("task", help="a task, or randomization=<name> for what that draws")
  show.add_argument("overrides", nargs="*", help="as for playground-run, such as robot=go1 or env.impl=jax")
  show.add_argument("--views", metavar="FILE", help="instead, a picture of what its camera sees on randomised models")
  show.add_argument("--num-views", type=int, default=16)
  add("doctor", _doctor, "Check this machine: backend, versions, rendering, caches, and what is missing.")
  evaluate = add("eval", _eval, "Evaluate a run's newest checkpoint, or the one given.")
  evaluate.add_argument("run", help=_RUN)
  evaluate.add_argument("--episodes", type=int, help="by default the run's num_eval_envs")
  evaluate.add_argument("--seed", type=int, default=0)
  evaluate.add_argument("--deterministic", action="store_true", help="act on the distribution's mode")
  evaluate.add_argument("--video", metavar="FILE", help="also render an episode")
  evaluate.add_argument("--camera", metavar="NAME", help="of --video: one of the model's; by default one that looks on")
  export = add("export", _export, "Write a run's policy as ONNX, with the contract that a controller needs.")
  export.add_argument("run", help=_RUN)
  export.add_argument("--out", metavar="FOLDER", help="by default export/ in the run's")
  play = add("play", _play, "Run a policy in plain C MuJoCo: measure it, film it or watch it.")
  play.add_argument("policy", help=f"{_RUN}, or a policy.onnx beside its policy.yaml")
  play.add_argument("--episodes", type=int, default=10)
  play.add_argument("--seed", type=int, default=0)
  shown = play.add_mutually_exclusive_group()
  shown.add_argument("--video", metavar="FILE", help="also render an episode")
  shown.add_argument("--viewer", action="store_true", help="show it in MuJoCo's viewer instead")
  shown.add_argument("--web", action="store_true", help="show it in the browser instead")
  play.add_argument("--camera", metavar="NAME", help="of --video: one of the model's; by default one that looks on")
  play.add_argument("--host", default="127.0.0.1", help="of --web: the address to listen on; by default this machine's")
  play.add_argument("--port", type=int, default=8080, help="of --web")
  pretrained = add("pretrained", _pretrained, "List the policies that come with the package, or add a run's.")
  pretrained.add_argument("--add", metavar="RUN", help="measure a run's policy in C MuJoCo and put it into the package")
  sweep = add("sweep", _sweep, "Look at a sweep, gather its result, or do what is missing of it.")
  sweep.add_argument("action", choices=("status", "collect", "retry", "stop"))
  sweep.add_argument("folder", help="the sweep's")
  sweep.add_argument("overrides", nargs="*", help="for retry, such as launcher=slurm or launcher.slots_per_gpu=2")
  tune = add("tune-buffers", _tune_buffers, "Measure how large Warp's buffers must be for a task.")
  tune.add_argument("task")
  tune.add_argument("overrides", nargs="*", help="as for playground-run, such as robot=go1 or agent.num_envs=4096")
  tune.add_argument("--run", help="a run or checkpoint whose policy acts, beside random actions")
  tune.add_argument("--envs", type=int, default=256)
  tune.add_argument("--steps", type=int, default=500, help="policy steps in each environment")
  replay = add("replay", _replay, "Replay the step that was not finite.")
  replay.add_argument("dump", help="a run's nan_dump/step_*.npz")
  for builds_tasks in (show, evaluate, export, play, sweep, tune, replay):
    builds_tasks.add_argument(
      "--trust", action="append", metavar="PACKAGE", help="let the configuration name task classes of this package, too"
    )
  return parser


def _list(args: argparse.Namespace) -> int:
  found = registry.names(args.word)
  if not found:
    near = nearest(args.word, registry.names())
    raise UnknownNameError(f"No task's name contains {args.word!r}: `playground list` shows all.{near}")
  print("\n".join(found))
  return 0


def _doctor(args: argparse.Namespace) -> int:
  from playground.cli.doctor import doctor

  return doctor()


def _eval(args: argparse.Namespace) -> int:
  from playground.cli.eval import evaluate_run

  return evaluate_run(
    working_copy(args.run, registry.names()),
    episodes=args.episodes,
    seed=args.seed,
    deterministic=args.deterministic,
    video=args.video,
    camera=args.camera,
  )


def _export(args: argparse.Namespace) -> int:
  from playground.deploy.export import export_run

  return export_run(working_copy(args.run, registry.names()), out=args.out)


def _play(args: argparse.Namespace) -> int:
  from playground.deploy.play import play

  return play(
    working_copy(args.policy, registry.names()),
    episodes=args.episodes,
    seed=args.seed,
    video=args.video,
    camera=args.camera,
    viewer=args.viewer,
    web=args.web,
    host=args.host,
    port=args.port,
  )


def _pretrained(args: argparse.Namespace) -> int:
  from playground.cli import pretrained

  return pretrained.add_policy(args.add) if args.add else pretrained.show_policies()


def _sweep(args: argparse.Namespace) -> int:
  from playground.cli import sweep

  if args.overrides and args.action != "retry":
    raise ConfigError(f"{args.overrides[0]}: only `playground sweep retry` takes overrides.")
  if args.action == "retry":
    return sweep.retry(args.folder, *args.overrides, trust=args.trust)
  return getattr(sweep, args.action)(args.folder)


def _tune_buffers(args: argparse.Namespace) -> int:
  from playground.cli.tune_buffers import tune_buffers

  return tune_buffers(args.task, args.overrides, run=args.run, envs=args.envs, steps=args.steps)


def _replay(args: argparse.Namespace) -> int:
  from playground.cli.replay import replay

  return replay(args.dump)


def _show(args: argparse.Namespace) -> int:
  from playground.cli.show import show

  return show(args.task, args.overrides, views=args.views, num_views=args.num_views)


if __name__ == "__main__":
  main()
