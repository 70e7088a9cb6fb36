"""Measures environment steps alone, with random actions."""

import jax

from playground.benchmark.measures.subject import Subject, alone, emit_peak, rate
from playground.benchmark.worker import Rows

LENGTH = 20  # control steps of one call


def measure(rows: Rows, task: str, agent: str, overrides: list[str], seconds: float) -> None:
  """Emits a row for env steps/s of `agent.num_envs` environments, and one for memory.

  The environments are wrapped as in training: guard, time limit, auto-reset, randomised models.
  """
  subject = Subject.build(rows, task, agent, overrides)
  env, model, num_envs = subject.trainer.env, subject.model, subject.trainer.config.num_envs

  def roll(state, key, calls):
    def step(state, key):
      action = jax.random.uniform(key, (num_envs, env.action_size), minval=-1.0, maxval=1.0)
      return env.step(state, action, model), None

    def body(i, state):
      return jax.lax.scan(step, state, jax.random.split(jax.random.fold_in(key, i), LENGTH))[0]

    return jax.lax.fori_loop(0, calls, body, state)

  roll = jax.jit(roll, donate_argnums=0)
  state = jax.jit(env.reset)(jax.random.split(subject.key(0), num_envs), model)

  def call(count: int) -> jax.Array:
    nonlocal state
    state = roll(state, subject.key(count), count)
    return state.done

  jax.block_until_ready(call(1))
  with alone(rows.lock):
    speed, timed = rate(call, num_envs * LENGTH * env.action_repeat, seconds)
  rows["conditions"] = f"random actions; {timed:.1f} s timed"
  rows.emit("env_steps_per_s", speed, "steps/s")
  emit_peak(rows)
