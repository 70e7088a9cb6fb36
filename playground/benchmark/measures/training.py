"""Training alone, at full speed: what the paper's throughput tables measure."""

from contextlib import nullcontext
from functools import partial

import jax
import numpy as np

from playground.benchmark.measures.machine import used_memory
from playground.benchmark.measures.subject import Subject, alone, emit_peak, rate
from playground.benchmark.worker import Facts
from playground.learning.loop import compile_program
from playground.runs.provenance import process_age_s


def measure(
  facts: Facts,
  task: str,
  agent: str,
  overrides: list[str],
  seeds: list[int],
  seconds: float,
  watch_memory: bool = False,
  num_agents: int = 1,
) -> None:
  """Rows for compile time, time to the first update and memory, and for each seed the steps a second.

  A seed starts from new networks, environments and randomised models; its first update is not timed. The time holds no
  evaluation and no reset of all environments. One compilation serves all seeds.

  Args:
    facts: takes the rows.
    task: which.
    agent: an option of the group.
    overrides: of the run's configuration.
    seeds: of the trainings.
    seconds: how long to time each, at least one update.
    watch_memory: ask the GPU's driver, too, how much is in use.
    num_agents: how many train in one program, each from a seed of its own; their steps are added up.
  """
  with used_memory(facts, seeds[0]) if watch_memory else nullcontext():
    subject = Subject.build(facts, task, agent, overrides, num_agents)
    trainer, conditions = subject.trainer, facts["conditions"]
    no_evaluation = jax.jit(lambda policy, key, model, settings: ())
    program = compile_program(trainer, no_evaluation, partial(subject.draw, seeds[0]))
    facts.emit("trace_s", program.trace_s, "s", seed=seeds[0])
    facts.emit("compile_s", program.compile_s, "s", seed=seeds[0])
    warm_up = 1 + trainer.config.prefill_updates
    for seed in seeds:
      model = program.model if seed == seeds[0] else subject.draw(seed)[0]
      with alone(facts.lock):
        state = None  # the last seed's goes before the next one's comes: a replay buffer is large
        state = program.init(subject.key(seed), model, None, trainer.settings)

        def train(count: int) -> jax.Array:
          nonlocal state
          state, metrics = program.train(state, model, np.int32(count))  # noqa: B023  # called within this turn
          return metrics["nonfinite"]

        jax.block_until_ready(train(warm_up))
        if seed == seeds[0] and facts.lock is None:  # with a lock, waiting for it would be in the time
          facts.emit("start_to_first_update_s", process_age_s(), "s", seed=seed)
        speed, timed = rate(train, trainer.steps_per_update * num_agents, seconds)
      how = f"{timed:.1f} s timed after the first update, no evaluation, no outer resets"
      facts.emit("training_steps_per_s", speed, "steps/s", seed=seed, conditions=f"{conditions}; {how}")
    emit_peak(facts, seed=seeds[0])
