"""`playground play <run|policy.onnx>`: measures, films or shows the exported policy in plain C MuJoCo."""

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from playground import config as configs
from playground import registry
from playground.cli.eval import described, render, save
from playground.cli.header import of_events_that_are_off
from playground.deploy.contract import Contract
from playground.deploy.menu import Menu
from playground.deploy.policy import ActingPolicy, ExportedPolicy
from playground.deploy.scores import measure, result_name, result_of
from playground.deploy.scripted import ScriptedPolicy
from playground.deploy.session import LATEST, Session
from playground.deploy.trained import draw_models, export_policy, load_exact, load_on_c_physics, set_fields
from playground.envs.base import Env, observation_groups
from playground.errors import CheckpointError, PlaygroundError
from playground.extras import need
from playground.hardware.mesh import make_mesh
from playground.hardware.setup import setup, this_machine
from playground.learning.checkpoints import of_a_better_one
from playground.learning.evaluation import make_evaluator
from playground.randomization import Randomizer
from playground.rendering.video import need_camera, need_place
from playground.runs.csv_tracker import OTHER_RETURNS
from playground.runs.loaded_policy import LoadedPolicy
from playground.text import first_line

_BACKENDS = {"jax": "MJX ", "warp": "MJX-Warp "}  # by the manifest's `impl`; older exports have none


def play(
  path: str,
  *,
  agent: str | None = None,
  overrides: Sequence[str] = (),
  randomize: bool = False,
  interval_events: bool = True,
  episodes: int = 10,
  seed: int = 0,
  video: str | None = None,
  camera: str | None = None,
  viewer: bool = False,
  web: bool = False,
  host: str = "127.0.0.1",
  port: int = 8080,
) -> int:
  """Runs a policy with ONNX Runtime in C MuJoCo, with the task's rate, noise, pushes and delays.

  Args:
    path: a run directory, one of its checkpoints, or a `policy.onnx` with its `policy.yaml` beside it, or their folder;
      with `agent` a task.
    agent: zero or random actions in place of a policy; None is the policy of `path`.
    overrides: of the task, such as `terrain=stairs`; with `agent`: as for playground-run.
    randomize: whether the task's startup events draw the model, a new one for each episode that is measured; False is
      the nominal model.
    interval_events: whether pushes and other interval events act.
    episodes: number of episodes to measure.
    seed: of the episodes.
    video: the .mp4 to render the first episode to.
    camera: of the video, see `render_video`; None is the `video.camera` of a run.
    viewer: whether to show the policy in MuJoCo's viewer instead of measuring it.
    web: whether to show it in the browser instead.
    host: address that the page in the browser is served at.
    port: port of that address.

  Returns:
    The exit code, 0.

  Raises:
    PlaygroundError: no such run, policy or camera, no display for the viewer, no port for the browser, or a task
      without startup events to randomise by.
  """
  film = need_place(video, camera)
  if viewer:
    from playground.deploy.viewer import need_display

    need_display()
  if web:
    need("web", "viser", "mjviser")
    from playground.deploy.web.gate import need_port

    need_port(host, port)
  model_seed = seed if randomize and (viewer or web) else None
  if agent is None:
    opened = open_policy(path, overrides, interval_events, model_seed)
    if not randomize and (drawn := [text for text in overrides if text.startswith("randomization=")]):
      what = "the model is the nominal one, so that only events of mode reset act; --randomize draws it."
      print(f"{drawn[-1]}: {what}")
  else:
    _set_up_cpu()
    config = configs.compose(configs.of_task(path, overrides))
    task = config.choices["env"]
    env = load_on_c_physics(task, config.env, interval_events=interval_events, model_seed=model_seed)
    opened = Opened(ScriptedPolicy(agent, task, env, seed), env)
  exported, env = opened.exported, opened.env
  better = of_a_better_one(path, opened.trained.checkpoint) if opened.trained else ()
  events = env.config.get("events")
  unlike = [] if randomize else Randomizer(env.mj_model, events, impl=env.impl, in_c=True).without_nominal()
  unlike = [f"{sentence} --randomize plays on models like those of training." for sentence in unlike]
  for sentence in (*better, *of_events_that_are_off(env.config, overrides), *unlike):
    print(sentence)
  need_camera(env.mj_model, camera, "--camera")
  if film and camera is None and opened.trained:
    camera = opened.trained.config.video.camera
    need_camera(env.mj_model, camera, "video.camera")
  if viewer:
    from playground.deploy.viewer import view

    view(env, exported, seed)
    return 0
  if web:
    from playground.deploy.web.server import watch

    given = Path(path).expanduser().absolute()
    menu = _menu(given, opened.trained) if opened.trained else None
    following = None if given.parent.name == "checkpoints" else LATEST
    watch(Session(env, exported, seed, menu, following, model_seed), host, port)
    return 0
  models = draw_models(env, exported.contract["task"], episodes, seed) if randomize else {}
  scores, recording = measure(exported, env, episodes, seed, 1 if film else 0, models)
  Console().print(_table(exported.contract, agent, episodes, scores, overrides, randomize))
  if opened.folder is not None:
    steps = exported.contract["origin"]["steps"]
    out = opened.folder / result_name(steps, seed, episodes, interval_events, overrides, randomize)
    result = result_of(exported, scores, episodes, seed, interval_events, overrides, randomize)
    run = opened.trained.run_dir.path if opened.trained else None
    save(out, result, run)
  if film:
    filmed = copy.copy(env.mj_model)
    set_fields(filmed, {name: values[0] for name, values in models.items()})
    render(film, filmed, env, camera, recording)
  return 0


@dataclasses.dataclass(frozen=True)
class Opened:
  """A policy to play.

  Attributes:
    exported: the policy, or a script.
    env: the policy's task on C MuJoCo.
    folder: folder of the results; None writes no results.
    trained: the policy's checkpoint; None without a run.
  """

  exported: ActingPolicy
  env: Env
  folder: Path | None = None
  trained: LoadedPolicy | None = None


def open_policy(
  path: str, overrides: Sequence[str] = (), interval_events: bool = True, model_seed: int | None = None
) -> Opened:
  """Reads a run's policy, or an exported one, and builds its task; `load_on_c_physics` has the last two arguments.

  Raises:
    PlaygroundError: no such run or policy, or an invalid override.
  """
  if (exported_to := Path(path).expanduser() / "policy.onnx").is_file():
    path = str(exported_to)
  if Path(path).suffix == ".onnx":
    exported = ExportedPolicy.load(path)
    _set_up_cpu()
    env = _task_of(exported, path, overrides, interval_events, model_seed)
    return Opened(exported, env, Path(path).expanduser().parent)
  trained = load_exact(path, overrides, interval_events, model_seed)
  return Opened(export_policy(trained), trained.env, trained.run_dir.path / "export", trained)


def _set_up_cpu() -> None:
  setup(this_machine(configs.compose(["hardware=cpu"]).hardware))


def _task_of(
  exported: ExportedPolicy, path: str, overrides: Sequence[str], interval_events: bool, model_seed: int | None
) -> Env:
  """Builds the task of a policy's contract on C MuJoCo, and traces it so that invalid values raise here.

  Raises:
    PlaygroundError: an invalid value, or a task that the policy does not fit.
  """
  contract = exported.contract
  task, config, policy = contract["task"], contract["env"], contract["policy"]
  if task in registry.names():  # another task has no defaults without its robot
    default = registry.config(task).to_dict()
    default.pop("robot", None)  # another robot's section may hold other types
    config = configs.saved_section("env", config, default)
  if overrides:
    config = configs.override_task(config, overrides)
  try:
    env = load_on_c_physics(task, config, interval_events=interval_events, model_seed=model_seed)
    entries = observation_groups(jax.eval_shape(env.reset, jax.random.PRNGKey(0)).obs)
    theirs = {row["entry"]: (tuple(row["shape"][1:]), row["type"]) for row in policy["inputs"]}
    ours = {name: (entry.shape, entry.dtype.name) for name, entry in entries.items() if name in theirs}
    if theirs != ours or policy["action_size"] != env.action_size:
      raise CheckpointError(
        f"{path} does not fit the task that its contract describes: the policy reads {theirs} and gives "
        f"{policy['action_size']} actions, the task has {ours} and takes {env.action_size}."
      )
    jax.eval_shape(make_evaluator(env, exported.act, 1, make_mesh(1)), {}, jax.random.PRNGKey(0), {}, {})
  except PlaygroundError:
    raise
  except Exception as error:  # of any type: the file may hold anything
    reason = f"{type(error).__name__}: {first_line(error)}"
    raise CheckpointError(f"{path}: the `env` of its contract describes no valid task ({reason}).") from error
  return env


def _menu(given: Path, trained: LoadedPolicy) -> Menu:
  """Returns the checkpoints of the run at or above `given`, or of all stages of a chain."""
  run = trained.run_dir.path
  return Menu(given if given == run.parent else run, trained, lambda message: print(message, flush=True))


def _table(
  contract: Contract, agent: str | None, episodes: int, scores: Mapping[str, float], overrides: Sequence[str],
  randomized: bool,
) -> Table:  # fmt: skip
  """Builds a table of scores, beside those of the last evaluation in training, the mode's first."""
  origin = contract["origin"]
  trained = origin["evaluation"]
  title = f"{contract['task']}, {origin['steps']:,} steps trained{described(overrides)}"
  table = Table("per episode", title=escape(title))
  table.add_column("C MuJoCo", justify="right")
  model = "randomised models" if randomized else "nominal model"
  acts = f"{agent} actions" if agent else "mode of the policy"
  table.caption = f"C MuJoCo: mean of {episodes} episode{'s' * (episodes != 1)}, {model}, {acts}."
  kinds = {}  # of actions in training: what their scores' names begin with
  if trained:
    other = {name.partition("/")[0] for name in trained} & {*OTHER_RETURNS}
    kinds = {kind: f"{kind}/" if kind in other else "" for kind in OTHER_RETURNS} if other else {"": ""}
    for kind in kinds:
      table.add_column("training" + f", {kind}" * bool(kind), justify="right")
    backend = _BACKENDS.get(origin.get("impl"), "")
    table.caption += f"\nTraining: {backend}at {trained['steps']:,} steps, as configured."
  for name, value in scores.items():
    beside = [f"{trained[begin + name]:.4g}" if begin + name in trained else "" for begin in kinds.values()]
    table.add_row(name.removeprefix("episode_"), f"{value:.4g}", *beside)
  return table
