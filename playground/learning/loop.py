"""The host's side of training, the same for every algorithm: when to train, evaluate, reset, save and stop.

The device never waits: a thread logs and saves results while the next segment runs.
"""

import contextlib
import dataclasses
import itertools
import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Protocol, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec as P
from jax.stages import Compiled, Traced, Wrapped

from playground.envs.wrappers import ModelFields
from playground.gc_pause import gc_paused
from playground.hardware.distributed import any_process, is_multiprocess, share
from playground.hardware.mesh import compiler_options, local_shard, put, shard
from playground.learning.algorithm import Policy
from playground.learning.evaluation import Evaluate, Recording
from playground.learning.population import PARENT, Population
from playground.learning.rollout import Step
from playground.learning.stored_program import LoweredFunction, StoredProgram, UnusableProgramError
from playground.learning.trainer import Trainer, TrainState
from playground.pytree import PyTree
from playground.text import first_line

Metrics = dict[str, float]
Draw = Callable[[], tuple[ModelFields, ModelFields]]  # randomised models, of the training and of the evaluation
SAVE_EVERY_S = 300.0  # s: a state is saved at every evaluation, and at events when this long has passed since the last
CALL_S = 5.0  # s: a call of `train` takes about as long at most, because a request to stop waits for its end
COMPILER = "compiler"  # name of the threads that compile


@dataclasses.dataclass(frozen=True)
class ScheduleEvent:
  """A point of the schedule: actions after `update` training steps."""

  update: int
  evaluate: bool = False
  reset: bool = False


def schedule(num_updates: int, num_evals: int, num_resets_per_eval: int, max_updates: int) -> list[ScheduleEvent]:
  """Divides a run of `num_updates` training steps into calls of at most `max_updates`.

  Evaluations are evenly spaced, the first before training and the last at its end (a single one at the end). Resets
  of all environments are evenly spaced, too: `num_resets_per_eval` between two evaluations, none at the very end.
  """
  stretches = max(num_evals - 1, 1)
  evals = {round(i * num_updates / stretches) for i in range(stretches + 1)}
  evals -= set() if num_evals > 1 else {0}
  points = stretches * num_resets_per_eval
  resets = {round(i * num_updates / points) for i in range(1, points)} - {0, num_updates} if points else set()
  events, at = [], 0
  for stop in sorted(evals | resets | {num_updates}):
    events += [ScheduleEvent(update) for update in range(at + max_updates, stop, max_updates)]
    events.append(ScheduleEvent(stop, stop in evals, stop in resets))
    at = stop
  return events


def longest_stretch(events: Sequence[ScheduleEvent]) -> int:
  """Returns the most training steps between resets of all environments, or to the end of the run."""
  starts = [0, *(event.update for event in events if event.reset), events[-1].update]
  return max(after - before for before, after in itertools.pairwise(starts))


class Callbacks(Protocol):
  """Callbacks of the run of one agent, called on a thread while the device continues."""

  def on_metrics(self, step: int, metrics: Metrics, captured: Step | None, recording: Recording | None) -> None:
    """A row of the log.

    Args:
      step: control steps trained.
      metrics: its columns.
      captured: the run's first non-finite step (on the host) if the row counts any, else None.
      recording: of the row's evaluation, None without one.
    """
    ...

  def on_save(self, update: int, step: int, state: TrainState) -> None:
    """Saves a state, which is on the host; the last one has no data in its replay buffer, which nothing reads again."""
    ...

  def should_stop(self) -> bool:
    """Whether to save and exit, at the next event if that is near."""
    ...


@dataclasses.dataclass
class CompiledFunctions:
  """The compiled functions of a run, and its models.

  Attributes:
    train, init, reset, gather: see `Trainer`.
    evaluate: see `evaluation.make_evaluator`.
    model: randomised model fields of the training environments, each [num_envs, ...].
    eval_model: of the evaluation environments.
    trace_s: duration of tracing, s; 0 if an earlier start stored the functions.
    compile_s: duration of compilation after that, s.
    notice: a sentence about a problem, or None.
  """

  train: Callable[..., tuple[TrainState, dict[str, jax.Array]]]
  init: Callable[..., TrainState]
  reset: Callable[..., TrainState]
  evaluate: Evaluate
  gather: Callable[[TrainState], TrainState]
  model: ModelFields
  eval_model: ModelFields
  trace_s: float
  compile_s: float
  notice: str | None


def compile_program(
  trainer: Trainer,
  evaluate: Wrapped,
  draw: Draw,
  policy: Policy | None = None,
  stored: StoredProgram | None = None,
  resets: bool = True,
) -> CompiledFunctions:
  """Compiles all functions and Warp's kernels in parallel, before the first step.

  Each is traced once, unless an earlier start has stored them.

  Args:
    trainer: of the run.
    evaluate: (policy, key, model fields, settings) -> scores, jitted.
    draw: randomised model fields of the training and of the evaluation environments.
    policy: weights that a new run starts from, or None.
    stored: file of the lowered functions, None without one.
    resets: whether the schedule resets all environments; without, `reset` is compiled if it is called at all.
  """
  start, notices = time.perf_counter(), []
  options = compiler_options(trainer.mesh, trainer.env.unwrapped.impl)
  kernels = trainer.env.unwrapped.physics.compile_ahead()
  pool = ThreadPoolExecutor(thread_name_prefix=COMPILER)
  try:
    if stored is not None:
      try:
        if loaded := _compile_stored(trainer, draw, stored, options, pool):
          return loaded
      except UnusableProgramError as error:
        notices.append(str(error))
    with gc_paused():  # tracing makes millions of objects
      futures = _trace(trainer, evaluate, draw, policy, stored, resets, options, pool)
      trace_s = time.perf_counter() - start
      model, eval_model = shard(draw(), trainer.mesh)  # takes seconds, which XLA needs anyway
      results = {name: future.result() for name, future in futures.items()}
    if kernels is not None:
      notices.append(kernels.wait())
  finally:
    if kernels is not None:
      kernels.stop()
    pool.shutdown(wait=False, cancel_futures=True)  # an interrupted run does not wait for compilation
  compile_s = time.perf_counter() - start - trace_s
  lowered = {name: function for name, (_, function) in results.items() if function is not None}
  if stored is not None and len(lowered) == len(results):
    try:
      stored.save(lowered)
    except OSError as error:
      notices.append(f"The program was not stored, so the next start traces again: {first_line(error)}.")
  compiled = _uncompiled(trainer) | {name: function for name, (function, _) in results.items()}
  notice = " ".join(filter(None, notices)) or None
  return CompiledFunctions(
    **compiled, model=model, eval_model=eval_model, trace_s=trace_s, compile_s=compile_s, notice=notice
  )


def _compile_stored(
  trainer: Trainer, draw: Draw, stored: StoredProgram, options: dict[str, str], pool: ThreadPoolExecutor
) -> CompiledFunctions | None:
  """Compiles stored functions, None without any; raises UnusableProgramError."""
  start = time.perf_counter()
  functions = stored.load()
  if functions is None:
    return None
  futures = {name: pool.submit(function.compile, trainer.mesh, options) for name, function in functions.items()}
  model, eval_model = shard(draw(), trainer.mesh)
  try:
    compiled = _uncompiled(trainer) | {name: future.result() for name, future in futures.items()}
  except Exception as error:  # any error: JAX and XLA read a file
    raise stored.discard(error) from error
  compile_s = time.perf_counter() - start
  return CompiledFunctions(
    **compiled, model=model, eval_model=eval_model, trace_s=0.0, compile_s=compile_s, notice=None
  )


def _uncompiled(trainer: Trainer) -> dict[str, Callable[..., Any]]:
  """Returns the functions that not every run compiles: without resets in its schedule, or in a single process."""
  return {"reset": trainer.reset, "gather": trainer.gather}


def _trace(
  trainer: Trainer,
  evaluate: Wrapped,
  draw: Draw,
  policy: Policy | None,
  stored: StoredProgram | None,
  resets: bool,
  options: dict[str, str],
  pool: ThreadPoolExecutor,
) -> dict[str, Future[tuple[Compiled, LoweredFunction | None]]]:
  """Traces all functions and compiles them in the pool; returns each by name with its storable form."""
  agents = (trainer.num_agents,) if trainer.num_agents else ()
  key, count = jax.ShapeDtypeStruct((*agents, 2), jnp.uint32), jax.ShapeDtypeStruct((), jnp.int32)

  def compile_traced(function: Wrapped, traced: Traced, *args: PyTree) -> tuple[Compiled, LoweredFunction | None]:
    if stored is not None:
      with contextlib.suppress(ValueError, NotImplementedError):  # it calls code that JAX does not serialise
        lowered = LoweredFunction.of(function, traced, *args)
        return lowered.compile(trainer.mesh, options), lowered
    return traced.lower().compile(dict(options)), None

  def submit(function: Wrapped, *args: PyTree) -> Future[tuple[Compiled, LoweredFunction | None]]:
    return pool.submit(compile_traced, function, function.trace(*args), *args)

  model, eval_model = jax.eval_shape(draw)
  state = trainer.init.trace(key, model, policy, trainer.settings).out_info
  futures = {
    "train": submit(trainer.train, state, model, count),  # first, because it takes XLA longest
    "init": submit(trainer.init, key, model, policy, trainer.settings),
    "evaluate": submit(evaluate, trainer.policy(state), key, eval_model, state.settings),
  }
  if is_multiprocess():
    futures["gather"] = submit(cast(Wrapped, trainer.gather), state)
  return futures | {"reset": submit(trainer.reset, state, key, model)} if resets else futures


@dataclasses.dataclass
class SegmentResult:
  """The results of training up to one event, on the host."""

  event: ScheduleEvent
  steps: int
  trained: dict[str, np.ndarray] | None = None
  train_s: float = 0.0
  evaluated: tuple[dict[str, np.ndarray], Recording] | None = None
  lineage: tuple[np.ndarray, dict[str, np.ndarray]] | None = None  # see `Population.exchange`
  eval_s: float = 0.0
  captured: Sequence[Step | None] | None = None
  snapshot: TrainState | None = None


@dataclasses.dataclass
class Loop:
  """Runs the schedule of one agent or several, from a state at one of its events to the end.

  Results are fetched between two programs on the device, never while one runs. Warp captures CUDA graphs of its kernels
  on the stream of the running program, and a transfer that another thread starts meanwhile breaks the capture.

  Attributes:
    trainer: of the run.
    functions: the trainer's, compiled, and the models.
    events: the schedule.
    seeds: of each agent; evaluations and resets draw from it and the event they belong to, so they do not depend on
      where the run was interrupted.
    callbacks: of each agent; training stops if all ask for it.
    population: exchanges between agents, or None.
    train_s: device time of training alone.
    first_update_s: device time of one training step, the mean over the first training call.
    first_update_at: when the first training step was done, on the clock of `time.perf_counter`: when the first training
      call began, plus `first_update_s`.
  """

  trainer: Trainer
  functions: CompiledFunctions
  events: list[ScheduleEvent]
  seeds: Sequence[int]
  callbacks: Sequence[Callbacks]
  population: Population | None = None
  train_s: float = 0.0
  first_update_s: float | None = None
  first_update_at: float | None = None

  def __post_init__(self) -> None:
    keys = self.trainer.join([np.asarray(jax.random.split(jax.random.PRNGKey(seed), 3)) for seed in self.seeds])
    self._init_key, self._eval_key, self._reset_key = (jnp.asarray(keys[..., i, :]) for i in range(3))
    self._max_updates = 1  # of a call; it at most doubles from call to call, since training steps may become slower

  def init(self, policy: Policy | None = None) -> TrainState:
    """Returns the state of a new run, which starts from a policy (host arrays) if there is one."""
    placed = None if policy is None else self.trainer.place_policy(policy)
    key, settings = self._place(self._init_key), self._place(self.trainer.settings)
    return self.functions.init(key, self.functions.model, placed, settings)

  def run(self, state: TrainState, update: int | None = None) -> tuple[TrainState, bool]:
    """Runs to the end of the schedule, or until the callbacks ask to stop.

    Args:
      state: the state to continue from; its buffers are donated.
      update: its number of training steps, None for a new run.

    Returns:
      The last state, and whether the schedule was completed.
    """
    events = [event for event in self.events if update is None or event.update > update]
    at, reported, initial = update or 0, None, None
    self._last_save = time.perf_counter()
    with ThreadPoolExecutor(1, thread_name_prefix="report") as reports:
      for event in events:
        if not event.update:  # evaluated after the first training call, which need not wait for it
          initial = event, self.trainer.place_policy(self.trainer.policy(state)), self._place(self.trainer.settings)
          continue
        state, done = self._work(state, event, event.update - at)
        results, at = [done], done.event.update
        if initial:
          results, initial = [self._evaluate_initial(*initial), done], None
        if reported:
          reported.result()  # one row is in flight; its error is raised here
        stop = any_process(self._should_stop()) and at != events[-1].update
        if stop and done.snapshot is None:
          done.snapshot = jax.device_get(self.functions.gather(state))
        reported = reports.submit(lambda results=results: [self._report(each) for each in results])
        if stop:
          break
      if reported:
        reported.result()
    return state, at == self.events[-1].update

  def _work(self, state: TrainState, event: ScheduleEvent, num_updates: int) -> tuple[TrainState, SegmentResult]:
    """Trains up to an event and performs its actions, each of which has ended before the next begins.

    If the callbacks ask to stop long before the event, the result is that of an earlier event without actions.
    """
    done = SegmentResult(event, 0)
    if num_updates:
      start = time.perf_counter()
      state, trained, count = self._train(state, num_updates)
      if count < num_updates:
        event = done.event = ScheduleEvent(event.update - num_updates + count)
      done.steps, done.trained = count * self.trainer.steps_per_update, trained
      done.train_s = time.perf_counter() - start
      self.train_s += done.train_s
      if np.any(trained["nonfinite"] > 0):
        capture = jax.device_get(self.functions.gather(state).capture)
        shapes = self.trainer.shapes((state.env_state, self.functions.model))
        action_size = self.trainer.env.action_size
        first = lambda i: self.trainer.agent(capture, i).first(shapes[0], action_size, shapes[1])
        done.captured = [first(i) for i in range(len(self.callbacks))]
    if event.evaluate:
      scores = self._evaluate(done, self.trainer.policy(state), state.settings)
      if self.population:
        state, done.lineage = self._exchange(state, event, scores["episode_reward"], self.population)
    if event.reset:
      state = self.functions.reset(state, self._key(self._reset_key, event), self.functions.model)
      jax.block_until_ready(state)
    late = any_process(time.perf_counter() - self._last_save > SAVE_EVERY_S)
    last = event is self.events[-1]
    if late or event.evaluate or last:
      saved = self.functions.gather(state)
      done.snapshot = jax.device_get(self.trainer.without_data(saved) if last else saved)
      self._last_save = time.perf_counter()
    return state, done

  def _train(self, state: TrainState, num_updates: int) -> tuple[TrainState, dict[str, np.ndarray], int]:
    """Trains in calls of about `CALL_S`; fewer training steps if the callbacks ask to stop and the rest takes longer.

    Returns:
      The state, the metrics of all calls, and the number of training steps.
    """
    done = 0
    while True:
      start = time.perf_counter()
      count = int(share(str(min(self._max_updates, num_updates - done))))  # the same in every process
      state, trained = self.functions.train(state, self.functions.model, np.int32(count))
      sums, trained, done = trained.pop("sums"), jax.device_get(trained), done + count
      update_s = (time.perf_counter() - start) / count
      if self.first_update_s is None:
        self.first_update_s, self.first_update_at = update_s, start + update_s
      self._max_updates = max(1, min(2 * self._max_updates, int(CALL_S / update_s)))
      left = num_updates - done
      if not left or any_process(left * update_s > CALL_S and self._should_stop()):
        return state, trained, done
      state = state.replace(sums=sums)

  def _should_stop(self) -> bool:
    return all(each.should_stop() for each in self.callbacks)

  def _evaluate_initial(self, event: ScheduleEvent, policy: Policy, settings: PyTree) -> SegmentResult:
    """The evaluation before training; no agent has anything to learn from another one yet."""
    done = SegmentResult(event, 0)
    self._evaluate(done, policy, settings)
    if self.population:
      done.lineage = np.arange(len(self.callbacks)), jax.device_get(settings)
    return done

  def _evaluate(self, done: SegmentResult, policy: Policy, settings: PyTree) -> dict[str, np.ndarray]:
    """Evaluates a policy with the random numbers of an event; returns the scores."""
    start = time.perf_counter()
    key = self._key(self._eval_key, done.event)
    scores, recording = self.functions.evaluate(policy, key, self.functions.eval_model, settings)
    scores = jax.device_get(scores)
    done.eval_s = time.perf_counter() - start
    done.evaluated = scores, {name: local_shard(value, axis=1) for name, value in recording.items()}
    return scores

  def _exchange(
    self, state: TrainState, event: ScheduleEvent, returns: np.ndarray, population: Population
  ) -> tuple[TrainState, tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Exchanges between the agents of a population if it is due, never at the end of the run."""
    settings = jax.device_get(state.settings)
    count = sum(each.evaluate and 0 < each.update <= event.update for each in self.events)
    if event is self.events[-1] or count % population.exploit_every:
      return state, (np.arange(len(self.callbacks)), settings)
    lineage = population.exchange(returns, settings, event.update)
    return self.trainer.inherit(state, *lineage), lineage

  def _report(self, done: SegmentResult) -> None:
    """Passes results to the callbacks of each agent."""
    step = done.event.update * self.trainer.steps_per_update
    trained, (scores, recording), snapshot = done.trained, done.evaluated or (None, None), done.snapshot
    for i, callbacks in enumerate(self.callbacks):
      row: Metrics = {}
      if trained is not None:
        report = {k: float(v) for k, v in self.trainer.agent(trained, i).items()}
        row |= {f"training/{k}": v for k, v in report.items() if not math.isnan(v)}  # NaN is a mean over nothing
        row["time/steps_per_second"] = done.steps / done.train_s
      if scores is not None:
        row |= {f"eval/{k}": float(v) for k, v in self.trainer.agent(scores, i).items()}
        row["time/eval_s"] = done.eval_s
      if done.lineage is not None and self.population is not None:
        parents, settings = done.lineage
        row |= {PARENT: float(parents[i])} if parents[i] != i else {}
        row |= {f"population/{key}": float(settings[key][i]) for key in self.population.explore}
      captured = None if done.captured is None else done.captured[i]
      callbacks.on_metrics(step, row, captured, self.trainer.agent(recording, i))
      if snapshot is not None:
        callbacks.on_save(done.event.update, step, self.trainer.agent(snapshot, i))

  def _key(self, key: jax.Array, event: ScheduleEvent) -> jax.Array:
    fold = lambda key: jax.random.fold_in(key, event.update)
    return self._place(fold(key) if key.ndim == 1 else jax.vmap(fold)(key))

  def _place(self, tree: PyTree) -> PyTree:
    return put(tree, self.trainer.mesh, P())
