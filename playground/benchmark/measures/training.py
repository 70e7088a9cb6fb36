"""Measures training steps a second without evaluation, as in the paper's throughput tables."""

from contextlib import nullcontext
from functools import partial

import jax
import numpy as np

from playground.benchmark.measures.machine import used_memory
from playground.benchmark.measures.subject import Subject, alone, emit_peak, rate
from playground.benchmark.worker import Rows
from playground.learning.loop import compile_program
from playground.runs.provenance import process_age_s


def measure(
  rows: Rows,
  task: str,
  agent: str,
  overrides: list[str],
  seeds: list[int],
  seconds: float,
  watch_memory: bool = False,
  num_agents: int = 1,
) -> None:
  """Emits rows for compile time, time to the first update, memory, and for each seed steps/s.

  A seed starts from new networks, environments and randomised models; its first update is not timed. The time
  includes no evaluation and no full reset. One compilation serves all seeds.

  Args:
    rows: emits the rows.
    task: name of the task.
    agent: an option of the group `agent`.
    overrides: overrides of the run's configuration.
    seeds: seeds of the trainings.
    seconds: duration of each measurement, at least one update.
    watch_memory: whether to query the GPU driver for the memory in use.
    num_agents: agents in one program, each with its own seed; their steps are added up.
  """
  with used_memory(rows, seeds[0]) if watch_memory else nullcontext():
    subject = Subject.build(rows, task, agent, overrides, num_agents)
    trainer, conditions = subject.trainer, rows["conditions"]
    no_evaluation = jax.jit(lambda policy, key, model, settings: ())
    program = compile_program(trainer, no_evaluation, partial(subject.draw, seeds[0]))
    rows.emit("trace_s", program.trace_s, "s", seed=seeds[0])
    rows.emit("compile_s", program.compile_s, "s", seed=seeds[0])
    warm_up = 1 + trainer.config.prefill_updates
    for seed in seeds:
      model = program.model if seed == seeds[0] else subject.draw(seed)[0]
      with alone(rows.lock):
        state = None  # frees the last seed's state before the next one: a replay buffer is large
        state = program.init(subject.key(seed), model, None, trainer.settings)

        def train(count: int) -> jax.Array:
          nonlocal state
          state, metrics = program.train(state, model, np.int32(count))  # noqa: B023  # called within this turn
          return metrics["nonfinite"]

        jax.block_until_ready(train(warm_up))
        if seed == seeds[0] and rows.lock is None:  # with a lock, the time would include waiting for it
          rows.emit("start_to_first_update_s", process_age_s(), "s", seed=seed)
        speed, timed = rate(train, trainer.steps_per_update * num_agents, seconds)
      how = f"{timed:.1f} s timed after the first update, no evaluation, no outer resets"
      rows.emit("training_steps_per_s", speed, "steps/s", seed=seed, conditions=f"{conditions}; {how}")
    emit_peak(rows, seed=seeds[0])
