"""One training run, from a resolved config to a finished run directory."""

import contextlib
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import jax

from playground import registry
from playground.envs.base import Env
from playground.envs.wrappers import ModelFields
from playground.hardware.distributed import ending_together, is_main, leave, noting_loss, preflight, share, wait_for_all
from playground.hardware.setup import Hardware, setup
from playground.learning.checkpoints import BEST
from playground.learning.evaluation import make_evaluator
from playground.learning.hyperparameters import AgentConfig
from playground.learning.loop import Loop, ScheduleEvent, compile_program, longest_stretch, schedule
from playground.learning.trainer import Trainer, TrainState
from playground.randomization import Randomizer
from playground.rendering.video import need_camera
from playground.rendering.visuals import drawn_model
from playground.runs.callbacks import NonMainCallbacks, RunCallbacks
from playground.runs.chain import train_chain
from playground.runs.interrupts import Interrupted, Interrupts, exit_code
from playground.runs.progress import Progress, format_return
from playground.runs.provenance import process_age_s
from playground.runs.restore_plan import RestorePlan
from playground.runs.run_dir import RunDirectory
from playground.runs.scaling import describe_division, scale_envs

if TYPE_CHECKING:
  from playground.config import RunConfig

ROWS = 100  # rows of metrics.csv that a run aims at: a call to the device is about a hundredth of it


def train(config: "RunConfig") -> int:
  """Runs the training that `config` describes, a single run or a chain of them.

  Returns:
    The exit code: 0 when finished, 130 or 143 when interrupted (and saved).

  Raises:
    PlaygroundError: what the user can act on; a run directory that exists by then says failed and why.
  """
  with ending_together(), Interrupts() as interrupts:
    try:
      if config.hardware.scale_envs:
        config, notice = scale_envs(config, setup(config.hardware).mesh.size)
        print(notice)
      return train_chain(config, interrupts, _train) if config.stages else _train(config, interrupts)
    except Interrupted as interrupt:
      print(f"Interrupted by {interrupt}.")
      code = exit_code(interrupt.signum)
      leave(code, f"was interrupted by {interrupt}")
      return code


def _train(config: "RunConfig", interrupts: Interrupts, began_s: float = 0.0) -> int:
  """One run; `began_s` is the age of the process by then, 0 for its first."""
  plan = RestorePlan.find(config, began_s)
  if not plan.finished:
    hardware = setup(config.hardware)
    with plan.locked(config) as plan:
      if not plan.finished:
        return _train_locked(config, interrupts, began_s, plan, hardware)
  print(f"{config.resume} is finished: nothing to resume (init_from={config.resume} trains on from its weights).")
  return 0


def _train_locked(
  config: "RunConfig", interrupts: Interrupts, began_s: float, plan: RestorePlan, hardware: Hardware
) -> int:
  """One run, new or to resume, that no other process writes."""
  preflight(config.hardware, [config.resolved["env"], config.resolved["agent"], config.seed])
  agent = config.agent
  agent.check(hardware.mesh.size)
  env = registry.load(config.choices["env"], config=config.env)
  drawn = drawn_model(env, config.video.visuals)
  need_camera(drawn, config.video.camera, "video.camera")
  draw = partial(model_sampler(env, config, agent.num_envs, agent.num_eval_envs), config.seed)
  trainer = Trainer(env, agent, hardware.mesh, hardware.network_precision)
  plan.notices += trainer.notices()
  if hardware.mesh.size > 1:
    plan.notices.append(describe_division(agent, hardware.mesh.size))
  plan.restore(trainer, config.agent_name, draw)
  preflight(config.hardware, [plan.step, plan.weights and plan.weights.step], "checkpoint")  # one may see it damaged

  num_updates = math.ceil(agent.num_timesteps / trainer.steps_per_update)
  events = schedule(num_updates, agent.num_evals, agent.num_resets_per_eval, math.ceil(num_updates / ROWS))
  plan.notices += cut_short(agent, env.episode_length, events, trainer.steps_per_update)
  num_recorded = min(config.video.episodes, agent.num_eval_envs // hardware.mesh.size) * config.video.enable
  other_acts = trainer.algorithm.other_acts()
  evaluate = make_evaluator(env, trainer.act, agent.num_eval_envs, hardware.mesh, num_recorded, other_acts)
  if not is_main():
    with noting_loss(RunDirectory(share()).note_loss):
      program = compile_program(trainer, evaluate, draw, plan.policy)
      callbacks = NonMainCallbacks(config, env, interrupts, plan.step)
      loop = Loop(trainer, program, events, config.seed, callbacks)
      _, completed = _run(loop, plan, interrupts)
    return 0 if interrupts.signum is None or completed else exit_code(interrupts.signum)
  run_dir = plan.run_dir or RunDirectory.create(
    str(config.run_dir), config.resolved, config.overrides, numbered=config.resolved["run_dir"] is None
  )
  share(str(run_dir.path.absolute()))
  with run_dir.recorded(), noting_loss(run_dir.note_loss), Progress(num_updates * trainer.steps_per_update) as progress:
    run_dir.write_manifest(seed=config.seed, task=config.choices["env"], impl=env.impl, **hardware.facts)
    for notice in plan.notices:
      progress.print(notice)
    progress.phase(f"compiling for {hardware.mesh.size} x {hardware.facts['device']}")
    program = compile_program(trainer, evaluate, draw, plan.policy)
    if program.notice:
      progress.print(program.notice)
    to_compiled_s = process_age_s() - began_s
    timings = {"start_to_compiled_s": to_compiled_s, "trace_s": program.trace_s, "compile_s": program.compile_s}
    run_dir.update_manifest(timings=timings)

    callbacks = RunCallbacks(config, run_dir, env, trainer, progress, interrupts, plan, drawn)
    with contextlib.closing(callbacks):
      loop = Loop(trainer, program, events, config.seed, callbacks)
      state, completed = _run(loop, plan, interrupts)
      callbacks.finish(loop, state, completed)
  _say_where(run_dir)
  return 0 if interrupts.signum is None or completed else exit_code(interrupts.signum)


def cut_short(
  agent: AgentConfig, episode_length: int, events: Sequence[ScheduleEvent], steps_per_update: int
) -> list[str]:
  """A sentence for the user where fresh starts of all environments leave no time for a whole episode.

  They come closer with fewer steps to train: a trial of a tenth of the steps sees a tenth as much of an episode, and
  what comes later (the next command, the second push) finds the policy unprepared.

  Args:
    agent: the algorithm's settings.
    episode_length: of the task, control steps.
    events: of the run.
    steps_per_update: control steps of one training step, over all environments.
  """
  seen = longest_stretch(events) * steps_per_update // agent.num_envs
  if seen >= episode_length or not any(event.reset for event in events):
    return []
  return [
    f"Training sees the first {seen} of an episode's {episode_length} control steps: then all environments start "
    f"afresh (agent.num_resets_per_eval={agent.num_resets_per_eval}; fewer, or more steps, let episodes go on)."
  ]


def _run(loop: Loop, plan: RestorePlan, interrupts: Interrupts) -> tuple[TrainState, bool]:
  """Trains from where the run begins; returns the last state, and whether the schedule was completed."""
  wait_for_all()  # a first exchange waits for half a minute on CPUs: not all compile equally fast
  interrupts.start_saving()
  state = loop.init(plan.policy) if plan.state is None else plan.state
  return loop.run(state, plan.update)


def model_sampler(
  env: Env, config: "RunConfig", num_envs: int, num_eval_envs: int
) -> Callable[[int], tuple[ModelFields, ModelFields]]:
  """What draws a run's randomised models.

  Returns:
    A function of the run's seed: model fields of the training environments, each [num_envs, ...], and of the evaluation
    environments; empty without terms.

  Raises:
    PlaygroundError: a term that does not go with the model.
  """
  randomizer = Randomizer(env.mj_model, config.env.events)
  sample = jax.jit(randomizer.sample_batch)

  def draw(seed: int) -> tuple[ModelFields, ModelFields]:
    if not randomizer.fields:
      return {}, {}
    train_key, eval_key = jax.random.split(jax.random.fold_in(jax.random.PRNGKey(seed), 1))
    return sample(jax.random.split(train_key, num_envs)), sample(jax.random.split(eval_key, num_eval_envs))

  return draw


def _say_where(run_dir: RunDirectory) -> None:
  """The last lines of a run: what lies where."""
  summary = run_dir.summary
  print(f"{summary['status']}: return {format_return(summary['final_return'])}, {summary['steps']:,} steps")
  places: dict[str, object] = {
    "metrics": run_dir.metrics_csv,
    "plots": run_dir.plots,
    "checkpoints": run_dir.checkpoints,
  }
  if (best := run_dir.checkpoints / BEST).is_dir():
    places["best"] = f"{best} (return {format_return(summary['best_return'])} after {summary['best_step']:,} steps)"
  for name, path in places.items():
    print(f"  {name:12}{path}")
  videos = sorted(run_dir.videos.glob("*.mp4"))
  print(f"  {'video':12}{videos[-1] if videos else 'none'}")
