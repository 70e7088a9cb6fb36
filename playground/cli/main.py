"""`playground`: the commands beside training. They parse, call and print."""

import argparse
import sys
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from playground import registry
from playground.config import RunConfig, compose, format_value
from playground.errors import ConfigError, PlaygroundError, UnknownNameError, nearest
from playground.rendering.gl import withhold_gl

if TYPE_CHECKING:
  from rich.console import RenderableType

  from playground.envs.base import Env


def main() -> None:
  """Runs a command and exits with its code; 2 for what the user can act on."""
  withhold_gl()
  args = _arguments()
  try:
    code = args.command(args)
  except PlaygroundError as error:
    print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
    code = 2
  except KeyboardInterrupt:
    code = 130  # as a shell counts it
  except BrokenPipeError:  # `playground list | head`
    sys.stderr.close()
    code = 0
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


def _parser() -> argparse.ArgumentParser:
  parser = argparse.ArgumentParser(prog="playground", description="Robot learning tasks; train with playground-run.")
  commands = parser.add_subparsers(required=True, metavar="command")

  def add(name: str, command: Any, what: str) -> argparse.ArgumentParser:
    sub = commands.add_parser(name, help=what, description=what)
    sub.set_defaults(command=command)
    return sub

  add("list", _list, "List tasks.").add_argument("word", nargs="?", help="only tasks whose name contains it")
  show = add("show", _show, "Show what a task observes, does, is paid for and is trained with.")
  show.add_argument("task", help="a task, or randomization=<name> for what that draws")
  show.add_argument("overrides", nargs="*", help="as for playground-run, such as robot=go1 or env.impl=jax")
  show.add_argument("--views", metavar="FILE", help="instead, a picture of what its camera sees on randomised models")
  show.add_argument("--num-views", type=int, default=16)
  add("doctor", _doctor, "Check this machine: backend, versions, rendering, caches, and what is missing.")
  evaluate = add("eval", _eval, "Evaluate a run's newest checkpoint, or the one given.")
  evaluate.add_argument("run", help="run directory or checkpoint")
  evaluate.add_argument("--episodes", type=int, help="by default the run's num_eval_envs")
  evaluate.add_argument("--seed", type=int, default=0)
  evaluate.add_argument("--deterministic", action="store_true", help="act on the distribution's mode")
  evaluate.add_argument("--video", metavar="FILE", help="also render an episode")
  evaluate.add_argument("--camera", metavar="NAME", help="of --video: one of the model's; by default one that looks on")
  export = add("export", _export, "Write a run's policy as ONNX, with the contract that a controller needs.")
  export.add_argument("run", help="run directory or checkpoint")
  export.add_argument("--out", metavar="FOLDER", help="by default export/ in the run's")
  play = add("play", _play, "Run a policy in plain C MuJoCo: measure it, film it or watch it.")
  play.add_argument("policy", help="run directory, checkpoint, or a policy.onnx beside its policy.yaml")
  play.add_argument("--episodes", type=int, default=10)
  play.add_argument("--seed", type=int, default=0)
  shown = play.add_mutually_exclusive_group()
  shown.add_argument("--video", metavar="FILE", help="also render an episode")
  shown.add_argument("--viewer", action="store_true", help="show it in MuJoCo's viewer instead")
  shown.add_argument("--web", action="store_true", help="show it in the browser instead")
  play.add_argument("--camera", metavar="NAME", help="of --video: one of the model's; by default one that looks on")
  play.add_argument("--host", default="127.0.0.1", help="of --web: the address to listen on; by default this machine's")
  play.add_argument("--port", type=int, default=8080, help="of --web")
  sweep = add("sweep", _sweep, "Look at a sweep, gather its result, or do what is missing of it.")
  sweep.add_argument("action", choices=("status", "collect", "retry", "stop"))
  sweep.add_argument("folder", help="the sweep's")
  sweep.add_argument("overrides", nargs="*", help="for retry, such as launcher=slurm or launcher.slots_per_gpu=2")
  tune = add("tune-buffers", _tune_buffers, "Measure how large Warp's buffers must be for a task.")
  tune.add_argument("task")
  tune.add_argument("overrides", nargs="*", help="as for playground-run, such as robot=go1 or agent.num_envs=4096")
  tune.add_argument("--run", help="a run or checkpoint whose policy acts, beside random actions")
  tune.add_argument("--envs", type=int, default=256)
  tune.add_argument("--steps", type=int, default=500, help="decisions in each environment")
  replay = add("replay", _replay, "Replay the step that was not finite.")
  replay.add_argument("dump", help="a run's nan_dump/step_*.npz")
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
    args.run,
    episodes=args.episodes,
    seed=args.seed,
    deterministic=args.deterministic,
    video=args.video,
    camera=args.camera,
  )


def _export(args: argparse.Namespace) -> int:
  from playground.deploy.export import export_run

  return export_run(args.run, out=args.out)


def _play(args: argparse.Namespace) -> int:
  from playground.deploy.play import play

  return play(
    args.policy,
    episodes=args.episodes,
    seed=args.seed,
    video=args.video,
    camera=args.camera,
    viewer=args.viewer,
    web=args.web,
    host=args.host,
    port=args.port,
  )


def _sweep(args: argparse.Namespace) -> int:
  from playground.cli import sweep

  if args.overrides and args.action != "retry":
    raise ConfigError(f"{args.overrides[0]}: only `playground sweep retry` takes overrides.")
  return getattr(sweep, args.action)(args.folder, *args.overrides)


def _tune_buffers(args: argparse.Namespace) -> int:
  from playground.cli.tune_buffers import tune_buffers

  return tune_buffers(args.task, args.overrides, run=args.run, envs=args.envs, steps=args.steps)


def _replay(args: argparse.Namespace) -> int:
  from playground.cli.replay import replay

  return replay(args.dump)


def _show(args: argparse.Namespace) -> int:
  from rich.console import Console

  console = Console()
  if args.task.startswith("randomization=") and not args.overrides:
    if args.views:
      raise ConfigError("--views shows a task: playground show <task> randomization=<name> --views <file>.")
    console.print(describe_randomization(compose([args.task])))
    return 0
  config = compose([args.task if "=" in args.task else f"env={args.task}", *args.overrides])
  env = registry.build(config.env)
  if args.views:
    from playground.rendering.views import save_views

    terms = config.resolved["randomization"]["terms"]
    console.print(f"wrote {save_views(env, terms, args.views, args.num_views, config.seed)}")
    return 0
  for part in describe(config, env):
    console.print(part)
  return 0


def describe(config: RunConfig, env: "Env") -> "Iterable[RenderableType]":
  """Tables about a task: facts, observation, reward terms, randomisation, hyperparameters."""
  import jax

  from playground.randomization import Randomizer

  section, choices = config.resolved["env"], config.choices
  Randomizer(env.mj_model, config.resolved["randomization"]["terms"])  # a term without a target is said before anything
  state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
  ctrl = [f"[{low:g}, {high:g}]" for low, high in dict.fromkeys(map(tuple, env.mj_model.actuator_ctrlrange))]
  renders = section.get("vision", {}).get("enable")
  auto = "auto: warp, to render" if renders else f"auto: jax on CPU, {section['cuda_impl']} on an NVIDIA GPU"
  facts = {
    "class": section["task"],
    "robot": choices.get("robot") or "its own",
    "action": f"{env.action_size} in [-1, 1]",
    "actuators": f"{env.mj_model.nu}, ctrl in {', '.join(ctrl)}",
    "control": f"{1 / env.dt:g} Hz ({env.dt:g} s), each action applied {env.action_repeat} x",
    "physics": f"{1 / env.sim_dt:g} Hz ({env.sim_dt:g} s), {env.n_substeps} per control step",
    "episode": f"{env.episode_length} control steps ({env.episode_length * env.dt:g} s)",
    "backend": auto if section["impl"] == "auto" else section["impl"],
  }
  yield _table(f"{choices['env']}", facts.items())
  yield _table("observation", _observation(env, state.obs))
  scales = section.get("reward", {}).get("scales", {})
  terms = [name.removeprefix("reward/") for name in state.metrics if name.startswith("reward/")]
  yield _table("reward terms and weights", ((t, scales.get(t, "")) for t in dict.fromkeys([*scales, *terms])))
  yield describe_randomization(config)
  origin = f"tuned/{choices['tuned']}.yaml" if choices.get("tuned") else "defaults, not tuned for this task"
  yield _table(f"{config.agent.name} ({origin})", _flat(config.resolved["agent"]))


def describe_randomization(config: RunConfig) -> "RenderableType":
  """A table of what is drawn from what."""
  from playground.randomization import parse_terms

  rows = [term.describe() for term in parse_terms(config.resolved["randomization"]["terms"])]
  drawn = [(row["field"], f"{row['target']}: {row['operation']} {row['draw']}") for row in rows]
  return _table(f"randomization: {config.choices['randomization']}", drawn)


def _observation(env: "Env", obs: Any) -> Iterable[tuple[str, Any]]:
  """Rows of the observation: each entry's size, below it its parts with theirs."""
  parts = env.observation_parts
  entries = obs if isinstance(obs, Mapping) else {"state": obs}
  for group in [g for g in parts if g in entries] + [g for g in entries if g not in parts]:
    yield group, " x ".join(map(str, entries[group].shape))
    yield from ((f"  {part}", size) for part, size in parts.get(group, {}).items())


def _flat(node: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
  for key, value in node.items():
    if isinstance(value, Mapping):
      yield from _flat(value, f"{prefix}{key}.")
    else:
      yield f"{prefix}{key}", value


def _table(title: str, rows: Iterable[tuple[str, Any]]) -> "RenderableType":
  from rich.console import Group
  from rich.table import Table
  from rich.text import Text

  table = Table(show_header=False, box=None, padding=(0, 2))
  for key, value in list(rows) or [("none", "")]:
    table.add_row(Text(key, style="cyan"), Text(format_value(value)))
  return Group(Text(title, style="bold"), table)


if __name__ == "__main__":
  main()
