"""Trains several agents in one process and one compiled program; each agent has its own run directory."""

import contextlib
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self, cast

import jax
from jax.stages import Compiled

from playground.errors import ConfigError, HardwareError, PlaygroundError
from playground.hardware.mesh import device_memory
from playground.hardware.setup import Hardware, setup
from playground.learning.algorithm import Policy
from playground.learning.checkpoints import CheckpointStore
from playground.learning.evaluation import Recording
from playground.learning.loop import CompiledFunctions, Loop
from playground.learning.population import Population
from playground.learning.rollout import Step
from playground.learning.trainer import TrainState
from playground.runs.callbacks import RunCallbacks
from playground.runs.interrupts import Interrupted, Interrupts, exit_code
from playground.runs.programs import population_of, share_program
from playground.runs.progress import Progress
from playground.runs.restore_plan import RestorePlan
from playground.runs.run_dir import RunDirectory
from playground.runs.train import open_run, prepare, say_where, timings_of

if TYPE_CHECKING:
  from playground.config import RunConfig

Group = tuple[list["RunConfig"], Population | None]  # runs that train together, and their population if they are one


def train_together(configs: Sequence["RunConfig"], exploit_every: int = 0, explore: Sequence[str] = ()) -> int:
  """Trains runs that have the same program, new or to resume.

  If a run fails (non-finite numbers, a full disk, no intact checkpoint, a run to resume that another process trains),
  the others continue. Runs at the same step train together. Groups at different steps, as after an interruption
  between two runs, train one after another. A population continues from the newest step that all its runs have.

  Args:
    configs: of the runs.
    exploit_every: see `Population`; 0 is no population.
    explore: keys of the settings that the agents of a population copy and perturb.

  Returns:
    The exit code: 0 when all are finished, 2 where a run failed, 128 plus the signal's number when interrupted
    (and saved).

  Raises:
    PlaygroundError: an error that concerns all runs.
  """
  if not share_program(configs):
    raise ConfigError("These runs cannot train together: they differ in more than seeds and numbers of agent and task.")
  population = population_of(configs, exploit_every, explore)
  with Interrupts() as interrupts:
    try:
      hardware = setup(configs[0].hardware)
      return _train_runs(configs, population, interrupts, hardware)
    except Interrupted as interrupt:
      print(f"Interrupted by {interrupt}.")
      return exit_code(interrupt.signum)


def _train_runs(
  configs: Sequence["RunConfig"], population: Population | None, interrupts: Interrupts, hardware: Hardware
) -> int:
  """Trains the unfinished runs, one group after another, until a signal; returns the exit code."""
  able: list[RunConfig] = []
  codes: list[int] = []
  for config in configs:
    try:
      RestorePlan.find(config)
      able.append(config)
    except PlaygroundError as error:
      codes.append(_say_failed(config, str(error)))
  left = _groups(able, population)
  while left and interrupts.signum is None:
    codes.append(_train_group(*left.pop(0), interrupts, hardware))
    interrupts.stop_saving()  # the next group compiles first
  if interrupts.signum is not None and (left or any(codes)):
    return exit_code(interrupts.signum)
  return max(codes, default=0)


def _say_failed(config: "RunConfig", why: str) -> int:
  """Prints why a run failed while others go on; returns its exit code."""
  print(f"{Path(config.resume or str(config.run_dir)).name} failed: {why}", file=sys.stderr)
  return 2


def _groups(configs: Sequence["RunConfig"], population: Population | None) -> list[Group]:
  """Groups the unfinished runs: a population is one group, others are grouped by step and by what they start from.

  A run that failed, or lost its folder, leaves a population whose other runs are too far ahead to go on with it.
  """
  others = [(config, plan) for config in configs if not (plan := RestorePlan.find(config)).finished]
  members: list[RunConfig] = []
  if population and others:
    plans = [plan for _, plan in others]
    apart = not _shared_steps(plans) and any(plan.checkpoints for plan in plans)
    stays = [
      not apart or (plan.run_dir is not None and plan.run_dir.status.get("status") != "failed") for plan in plans
    ]
    if sum(stays) > 1:
      members = [config for (config, _), stay in zip(others, stays, strict=True) if stay]
      others = [other for other, stay in zip(others, stays, strict=True) if not stay]
  groups: dict[tuple[str, bool], list[RunConfig]] = {}
  for config, plan in others:
    step = plan.checkpoints[0].name if plan.checkpoints else ""
    groups.setdefault((step, plan.weights is None), []).append(config)
  return [(members, population)] * bool(members) + [(group, None) for group in groups.values()]


def _shared_steps(plans: Sequence[RestorePlan]) -> set[str]:
  """Returns the names of the checkpoints that all runs have."""
  first, *others = ({path.name for path in plan.checkpoints} for plan in plans)
  return first.intersection(*others)


def _train_group(
  configs: Sequence["RunConfig"], population: Population | None, interrupts: Interrupts, hardware: Hardware
) -> int:
  """Trains runs at the same step, or a population."""
  with contextlib.ExitStack() as runs:
    plans = [runs.enter_context(_locked(config)) for config in configs]
    if any(plan.error for plan in plans):
      runs.close()
      return _without_failed(configs, plans, population, interrupts, hardware)
    if population:
      steps = _shared_steps(plans)
      for config, plan in zip(configs, plans, strict=True):
        if plan.checkpoints and not steps:
          plan.notices.append("No step has a checkpoint of all runs: the population starts from the beginning.")
          plan.start_over(config)
        plan.checkpoints = [path for path in plan.checkpoints if path.name in steps]
    training = prepare(configs, plans, hardware, together=True)
    if any(plan.error for plan in plans):
      runs.close()
      return _without_failed(configs, plans, population, interrupts, hardware)
    if len({plan.update for plan in plans}) > 1:  # a checkpoint is damaged, and its run is behind the others
      _set_damaged_apart(configs, plans)
      runs.close()
      return _train_runs(configs, population, interrupts, hardware)
    members = [
      runs.enter_context(Member(open_run(config, plan), interrupts))
      for config, plan in zip(configs, plans, strict=True)
    ]
    progress = runs.enter_context(Progress(training.steps))
    machine = {"impl": training.env.impl, "agents_in_program": len(configs), **hardware.machine}
    for config, plan, member in zip(configs, plans, members, strict=True):
      member.run_dir.write_manifest(seed=config.seed, task=config.choices["env"], **machine)
      for notice in plan.notices:
        progress.print(f"{member.name}: {notice}")
    progress.phase(f"compiling {len(configs)} agents for {hardware.mesh.size} x {hardware.machine['device']}")
    program = training.compile(plans)
    for notice in (program.notice, memory_needed(program, hardware)):
      if notice:
        progress.print(notice)
    for config, plan, member in zip(configs, plans, members, strict=True):
      member.run_dir.update_manifest(timings=timings_of(program, 0.0))
      shown = progress if member is members[0] else progress.silent(member.name)
      member.begin(
        RunCallbacks(config, member.run_dir, training.env, training.trainer, shown, interrupts, plan, training.drawn)
      )
    progress.phase("training")
    loop = Loop(training.trainer, program, training.events, [config.seed for config in configs], members, population)
    state, completed = training.run(loop, plans, interrupts)
    policies = jax.device_get(training.trainer.policy(state))
    for member in members:  # all first: no run's time has another's video in it, and videos are rendered side by side
      member.end_training()
    for i, member in enumerate(members):
      member.finish(loop, training.trainer.agent(policies, i), completed)
  for member in members:
    say_where(member.run_dir) if member.error is None else print(
      f"{member.name} failed: {member.error}", file=sys.stderr
    )
  if any(member.error for member in members):
    return 2
  return interrupts.exit_code(completed)


@contextlib.contextmanager
def _locked(config: "RunConfig") -> Iterator[RestorePlan]:
  """Yields the plan of a run, which is locked; one that cannot start has an `error`."""
  with contextlib.ExitStack() as lock:
    try:
      plan = lock.enter_context(RestorePlan.find(config).locked(config))
    except PlaygroundError as error:
      plan = RestorePlan(error=str(error))
    yield plan


def _without_failed(
  configs: Sequence["RunConfig"], plans: Sequence[RestorePlan], population: Population | None, interrupts: Interrupts,
  hardware: Hardware,
) -> int:  # fmt: skip
  """Prints the errors of those plans that have one, and trains the other runs."""
  for config, plan in zip(configs, plans, strict=True):
    if plan.error is not None:
      _say_failed(config, plan.error)
  others = [config for config, plan in zip(configs, plans, strict=True) if plan.error is None]
  return max(2, _train_runs(others, population, interrupts, hardware))


def _set_damaged_apart(configs: Sequence["RunConfig"], plans: Sequence[RestorePlan]) -> None:
  """Moves damaged checkpoints away and prints it, so that the runs can be grouped by those that are left."""
  for config, plan in zip(configs, plans, strict=True):
    if plan.run_dir is not None and plan.step is not None and int(plan.checkpoints[0].name) > plan.step:
      CheckpointStore(plan.run_dir.checkpoints, config.checkpoint.keep, plan.step).close()
      for notice in plan.notices:
        print(f"{plan.run_dir.path.name}: {notice}")


def memory_needed(program: CompiledFunctions, hardware: Hardware) -> str:
  """Returns a sentence on the memory that training takes.

  Raises:
    HardwareError: a device has less memory than that.
  """
  needs, limit = cast(Compiled, program.train).memory_analysis(), device_memory(hardware.mesh)
  if needs is None or limit is None:
    return ""
  size = needs.argument_size_in_bytes + needs.temp_size_in_bytes
  if size > limit:
    raise HardwareError(
      f"These agents need {size / 1e9:.2f} GB on each device, which has {limit / 1e9:.2f} GB: lower "
      "launcher.max_agents."
    )
  return f"Training takes {size / 1e9:.2f} of {limit / 1e9:.2f} GB on each device."


class Member:
  """Implements the loop's callbacks for one agent's run, which ends at its first error while other runs continue.

  Attributes:
    run_dir: the run's directory, open and locked while the context lasts.
    name: name of that directory.
    error: reason of the run's failure; None without a failure.
  """

  def __init__(self, opened: contextlib.AbstractContextManager[RunDirectory], interrupts: Interrupts):
    self.error: str | None = None
    self._opened, self._interrupts = opened, interrupts
    self._callbacks: RunCallbacks | None = None

  def __enter__(self) -> Self:
    with contextlib.ExitStack() as record:
      self.run_dir = record.enter_context(self._opened)
      self.name = self.run_dir.path.name
      record.enter_context(self.run_dir.recorded())
      self._record = record.pop_all()
    return self

  def __exit__(
    self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
  ) -> None:
    if self.error is None:
      self._record.__exit__(kind, error, trace)

  def begin(self, callbacks: RunCallbacks) -> None:
    """Starts the run with its callbacks, which are closed at the end."""
    self._callbacks = self._record.enter_context(contextlib.closing(callbacks))

  def on_metrics(
    self, step: int, metrics: dict[str, float], captured: Step | None, recording: Recording | None
  ) -> None:
    self._do(lambda callbacks: callbacks.on_metrics(step, metrics, captured, recording))

  def on_save(self, update: int, step: int, state: TrainState) -> None:
    self._do(lambda callbacks: callbacks.on_save(update, step, state))

  def should_stop(self) -> bool:
    return self._interrupts.signum is not None or self.error is not None

  def end_training(self) -> None:
    """See `RunCallbacks.end_training`."""
    self._do(lambda callbacks: callbacks.end_training())

  def finish(self, loop: Loop, policy: Policy, completed: bool) -> None:
    """See `RunCallbacks.finish`."""
    self._do(lambda callbacks: callbacks.finish(loop, policy, completed))

  def _do(self, work: Callable[[RunCallbacks], None]) -> None:
    if self.error is not None or self._callbacks is None:
      return
    try:
      work(self._callbacks)
    except (PlaygroundError, OSError) as error:
      self.error = str(error)
      try:
        self._record.__exit__(type(error), error, error.__traceback__)  # records that the run failed, and why
      except PlaygroundError as error:
        self.error = str(error)
