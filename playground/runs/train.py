"""Trains one run, from a resolved config to a finished run directory."""

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence

import jax
import mujoco
from jax.stages import Wrapped

from playground import registry
from playground.config import RunConfig
from playground.envs.base import Env
from playground.envs.wrappers import ModelFields
from playground.errors import CheckpointError, HardwareError
from playground.hardware.distributed import ending_together, is_main, leave, noting_loss, preflight, share, wait_for_all
from playground.hardware.setup import Hardware, setup
from playground.learning.algorithm import Policy, other_acts
from playground.learning.checkpoints import BEST
from playground.learning.evaluation import make_evaluator
from playground.learning.hyperparameters import SCHEDULE, AgentConfig
from playground.learning.loop import (
  CompiledFunctions,
  Draw,
  Loop,
  ScheduleEvent,
  compile_program,
  longest_stretch,
  schedule,
)
from playground.learning.stored_program import StoredProgram
from playground.learning.trainer import Trainer, TrainState, trainer_settings
from playground.randomization import Randomizer
from playground.rendering.video import need_camera
from playground.rendering.visuals import drawn_model
from playground.runs.callbacks import NonMainCallbacks, RunCallbacks
from playground.runs.chain import train_chain
from playground.runs.interrupts import Interrupted, Interrupts, exit_code
from playground.runs.programs import stored_program
from playground.runs.progress import Progress, format_return
from playground.runs.provenance import process_age_s
from playground.runs.restore_plan import RestorePlan
from playground.runs.run_dir import RunDirectory
from playground.runs.scaling import describe_division, scale_envs
from playground.text import first_line

ROWS = 100  # approximate rows of metrics.csv in a run


def train(config: RunConfig) -> int:
  """Runs the training that `config` describes, a single run or a chain of them.

  Returns:
    The exit code: 0 when finished, 128 plus the signal's number when interrupted (and saved).

  Raises:
    PlaygroundError: an error that the user can act on; the run directory, if made already, records it.
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


def _train(config: RunConfig, interrupts: Interrupts, began_s: float = 0.0) -> int:
  """Trains one run; `began_s` is the age of the process at its start, 0 for the first run."""
  plan = RestorePlan.find(config, began_s)
  if not plan.finished:
    hardware = setup(config.hardware)
    with plan.locked(config) as plan:
      if not plan.finished:
        return _train_locked(config, interrupts, began_s, plan, hardware)
  print(f"{config.resume} is finished: nothing to resume (agent.num_timesteps=<more> trains it longer).")
  return 0


@contextlib.contextmanager
def _memory_errors() -> Iterator[None]:
  """Raises HardwareError where memory does not suffice for the block."""
  try:
    yield
  except jax.errors.JaxRuntimeError as error:
    text = first_line(error)
    if "RESOURCE_EXHAUSTED" not in text and "Out of memory" not in text:
      raise
    raise HardwareError(
      f"This machine has too little memory for the training: lower agent.num_envs, batch or replay buffer ({text})."
    ) from error


@dataclasses.dataclass
class Training:
  """Compiles and runs the training of a process: one run, or several runs that share a program.

  Attributes:
    env: the task.
    drawn: the model in videos.
    trainer: of the task and the algorithm.
    events: the schedule.
    evaluate: see `evaluation.make_evaluator`.
    draw, stored: see `loop.compile_program`.
  """

  env: Env
  drawn: mujoco.MjModel
  trainer: Trainer
  events: list[ScheduleEvent]
  evaluate: Wrapped
  draw: Draw
  stored: StoredProgram | None

  @property
  def steps(self) -> int:
    """Returns the environment steps of each agent."""
    return self.events[-1].update * self.trainer.steps_per_update

  @_memory_errors()
  def compile(self, plans: Sequence[RestorePlan]) -> CompiledFunctions:
    """Compiles the functions; `plans` hold the initial weights of each agent."""
    resets = any(event.reset for event in self.events)
    return compile_program(self.trainer, self.evaluate, self.draw, self._policies(plans), self.stored, resets)

  @_memory_errors()
  def run(self, loop: Loop, plans: Sequence[RestorePlan], interrupts: Interrupts) -> tuple[TrainState, bool]:
    """Trains from the start of the plans; returns the last state, and whether the schedule was completed."""
    wait_for_all()  # processes compile at different speeds, and the first collective on CPUs waits only half a minute
    interrupts.start_saving()
    if plans[0].state is None:
      return loop.run(loop.init(self._policies(plans)))
    state = self.trainer.place(self.trainer.join([plan.state for plan in plans]))
    return loop.run(state, plans[0].update)

  def _policies(self, plans: Sequence[RestorePlan]) -> Policy | None:
    return None if plans[0].policy is None else self.trainer.join([plan.policy for plan in plans])


def prepare(
  configs: Sequence[RunConfig], plans: Sequence[RestorePlan], hardware: Hardware, together: bool = False
) -> Training:
  """Builds task, trainer and schedule, and restores states, before compilation.

  Args:
    configs: of the run, or (`together`) of the runs of several agents.
    plans: one for each run, which gets the restored state and notices.
    hardware: of the process.
    together: whether arrays have an axis of agents, even of length 1.

  Raises:
    PlaygroundError: a setting, a checkpoint or a size that does not fit; with `together` a plan notes the error of its
      checkpoint.
  """
  config, plan = configs[0], plans[0]
  preflight(config.hardware, [config.resolved["env"], config.resolved["agent"], config.seed])
  agent = config.agent
  agent.check(1 if together else hardware.mesh.size)
  env = registry.load(config.choices["env"], config=config.env)
  env.trace()  # raises before there is a folder
  drawn = drawn_model(env, config.video.visuals)
  need_camera(drawn, config.video.camera, "video.camera")
  settings = [trainer_settings(each.agent, env.settings_of(each.env)) for each in configs]
  trainer = Trainer(env, agent, hardware.mesh, hardware.network_precision, settings if together else ())
  samplers = [model_sampler(env, each, agent.num_envs, agent.num_eval_envs) for each in configs]

  def draw() -> tuple[ModelFields, ModelFields]:
    models = [sample(each.seed) for sample, each in zip(samplers, configs, strict=True)]
    return trainer.join([model for model, _ in models]), trainer.join([model for _, model in models])

  plan.notices += trainer.notices()
  if trainer.num_devices > 1:
    plan.notices.append(describe_division(agent, trainer.num_devices))
  for each, theirs in zip(plans, configs, strict=True):
    try:
      each.restore(trainer, theirs, draw)
    except CheckpointError as error:
      if not together:
        raise
      each.error = str(error)
  trainer.settings = trainer.join([each.settings_over(own) for each, own in zip(plans, settings, strict=True)])
  preflight(config.hardware, [plan.step, plan.weights and plan.weights.step], "checkpoint")  # some may find it damaged

  num_updates = math.ceil(agent.num_timesteps / trainer.steps_per_update)
  events = schedule(num_updates, agent.num_evals, agent.num_resets_per_eval, math.ceil(num_updates / ROWS))
  if sets_schedule(config):
    plan.notices += cut_short(agent, env.episode_length, events, trainer.steps_per_update)
  num_recorded = min(config.video.episodes, agent.num_eval_envs // trainer.num_devices) * config.video.enable
  others = other_acts(trainer.algorithm)
  evaluate = make_evaluator(env, trainer.act, agent.num_eval_envs, trainer.mesh, num_recorded, others)
  resets = any(event.reset for event in events)
  from_policy = plan.policy is not None
  stored = stored_program(config, trainer, hardware, from_policy=from_policy, resets=resets, num_recorded=num_recorded)
  return Training(env, drawn, trainer, events, evaluate, draw, stored)


def _train_locked(
  config: RunConfig, interrupts: Interrupts, began_s: float, plan: RestorePlan, hardware: Hardware
) -> int:
  """Trains one run, new or resumed, whose lock this process holds."""
  training = prepare([config], [plan], hardware)
  if not is_main():
    with noting_loss(RunDirectory(share()).note_loss):
      program = training.compile([plan])
      callbacks = NonMainCallbacks(config, training.env, interrupts, plan.step)
      loop = Loop(training.trainer, program, training.events, [config.seed], [callbacks])
      _, completed = training.run(loop, [plan], interrupts)
    return interrupts.exit_code(completed)
  with (
    open_run(config, plan) as run_dir,
    run_dir.recorded(),
    noting_loss(run_dir.note_loss),
    Progress(training.steps) as progress,
  ):
    share(str(run_dir.path.absolute()))
    if plan.longer:  # not before it is recorded as running
      run_dir.note_budget(config.agent.num_timesteps, config.agent.num_evals)
    run_dir.write_manifest(seed=config.seed, task=config.choices["env"], impl=training.env.impl, **hardware.machine)
    for notice in plan.notices:
      progress.print(notice)
    progress.phase(f"compiling for {hardware.mesh.size} x {hardware.machine['device']}")
    program = training.compile([plan])
    if program.notice:
      progress.print(program.notice)
    run_dir.update_manifest(timings=timings_of(program, began_s))

    callbacks = RunCallbacks(
      config, run_dir, training.env, training.trainer, progress, interrupts, plan, training.drawn
    )
    with contextlib.closing(callbacks):
      progress.phase("training")
      loop = Loop(training.trainer, program, training.events, [config.seed], [callbacks])
      state, completed = training.run(loop, [plan], interrupts)
      callbacks.end_training()
      callbacks.finish(loop, training.trainer.policy(state), completed)
  say_where(run_dir)
  return interrupts.exit_code(completed)


@contextlib.contextmanager
def open_run(config: RunConfig, plan: RestorePlan) -> Iterator[RunDirectory]:
  """Yields the run's directory, which is locked; makes it for a new run."""
  if plan.run_dir is not None:
    yield plan.run_dir
    return
  with RunDirectory.claimed(str(config.run_dir), numbered=config.resolved["run_dir"] is None) as run_dir:
    run_dir.write_config(plan.to_write(config), config.overrides)
    yield run_dir


def timings_of(program: CompiledFunctions, began_s: float) -> dict[str, float]:
  """Returns the manifest's times (seconds) up to the compiled program."""
  started = process_age_s() - began_s
  return {"start_to_compiled_s": started, "trace_s": program.trace_s, "compile_s": program.compile_s}


def sets_schedule(config: RunConfig) -> bool:
  """Returns whether overrides or a curriculum, not a set or experiment, say when all environments are reset."""
  keys = tuple(f"agent.{key}=" for key in (*SCHEDULE, "num_envs"))
  is_stage = config.name != (config.choices.get("experiment") or config.choices["env"])  # a single run's name
  return is_stage or any(text.lstrip("+").startswith(keys) for text in config.overrides)


def cut_short(
  agent: AgentConfig, episode_length: int, events: Sequence[ScheduleEvent], steps_per_update: int
) -> list[str]:
  """Returns a warning if full resets come before an episode can end, else nothing.

  The time between full resets shrinks with the budget: a run of a tenth of the steps covers a tenth as much of an
  episode, and the policy never trains on later events (the next command, the second push).

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
    f"Training covers the first {seen} of an episode's {episode_length} control steps: then all environments are reset "
    f"(agent.num_resets_per_eval={agent.num_resets_per_eval}; fewer resets or more steps cover more of an episode)."
  ]


def model_sampler(
  env: Env, config: RunConfig, num_envs: int, num_eval_envs: int
) -> Callable[[int], tuple[ModelFields, ModelFields]]:
  """Returns the function that draws a run's randomised models.

  Returns:
    A function of the run's seed: model fields of the training environments, each [num_envs, ...], and of the evaluation
    environments; empty without terms.

  Raises:
    PlaygroundError: a term that does not fit the model.
  """
  randomizer = Randomizer(env.mj_model, config.env.events, impl=env.impl)
  sample = jax.jit(randomizer.sample_batch)

  def draw(seed: int) -> tuple[ModelFields, ModelFields]:
    if not randomizer.fields:
      return {}, {}
    train_key, eval_key = jax.random.split(jax.random.fold_in(jax.random.PRNGKey(seed), 1))
    return sample(jax.random.split(train_key, num_envs)), sample(jax.random.split(eval_key, num_eval_envs))

  return draw


def say_where(run_dir: RunDirectory) -> None:
  """Prints the paths of a run's files."""
  summary = run_dir.summary
  print(f"{summary['status']}: return {format_return(summary['final_return'])}, {summary['steps']:,} steps")
  places: dict[str, object] = {
    "metrics": run_dir.metrics_csv,
    "plots": run_dir.plots,
    "checkpoints": run_dir.checkpoints,
  }
  if (best := run_dir.checkpoints / BEST).is_dir():
    known = summary["best_step"] is not None  # metrics.csv may have been removed
    score = f" (return {format_return(summary['best_return'])} after {summary['best_step']:,} steps)" if known else ""
    places["best"] = f"{best}{score}"
  for name, path in places.items():
    print(f"  {name:12}{path}")
  videos = sorted(run_dir.videos.glob("*.mp4"))
  print(f"  {'video':12}{videos[-1] if videos else 'none'}")
