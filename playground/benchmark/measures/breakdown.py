"""Measures the time of each part of training: adds parts to the loop one by one, as in the paper's pixel tables."""

from collections.abc import Callable
from contextlib import nullcontext

import jax
import jax.numpy as jnp
import numpy as np

from playground.benchmark.measures.machine import used_memory
from playground.benchmark.measures.subject import Subject, alone, emit_peak, rate, setting_of
from playground.benchmark.worker import Rows
from playground.envs.base import PIXELS
from playground.envs.wrappers import ModelFields, Vectorize, Wrapper, wrap_for_training
from playground.hardware.mesh import compiler_options
from playground.learning.rollout import Environments, unroll
from playground.learning.trainer import TrainState
from playground.physics.backend import WORLDS, PhysicsData
from playground.pytree import PyTree

PARTS = {  # in the order they are added
  "physics": "MJX alone under a constant ctrl",
  "task": "control, pushes, observation, reward, termination",
  "episodes": "guarded numbers, time limit, auto-reset",
  "pixels": "camera images, if the task has any",
  "inference": "the actor instead of random actions",
  "storing": "transitions, log-probabilities, sums of ended episodes (PPO)",
  "update": "gradient steps: the whole training step",
}
TURNS = 3
LENGTH = 20  # control steps of one call, if the algorithm has no unrolls

# (carry, model fields, key) -> (carry, other outputs, so that they are computed)
Run = Callable[[PyTree, ModelFields, jax.Array], tuple[PyTree, PyTree]]
Step = Callable[[PyTree, ModelFields, jax.Array], PyTree]


def measure(
  rows: Rows,
  task: str,
  agent: str,
  overrides: list[str],
  seconds: float,
  watch_memory: bool = False,
  until: str = "update",
) -> None:
  """Emits a row for each of `PARTS` up to `until`: seconds of a control step with all parts so far.

  The parts take turns, and the best turn of each counts, since their differences matter. Memory is that of all parts
  together: JAX's, and with `watch_memory` the GPU driver's.
  """
  with used_memory(rows) if watch_memory else nullcontext():
    subject = Subject.build(rows, task, agent, overrides)
    trainer, state = (
      subject.trainer,
      subject.trainer.init(subject.key(0), subject.model, None, subject.trainer.settings),
    )
    length = getattr(trainer.config, "unroll_length", LENGTH)
    calls: dict[str, tuple[Callable[[int], PyTree], int]] = {}
    wanted = list(PARTS)[: list(PARTS).index(until) + 1]
    for part, (run, carry, repeat) in _rolls(subject, state, length).items():
      if part in wanted:
        calls[part] = (_repeat(subject, run, carry), trainer.config.num_envs * length * repeat)
    if "update" in wanted:
      calls["update"] = (_train(subject, state), trainer.steps_per_update)
    for call, _ in calls.values():
      jax.block_until_ready(call(1))
    best = dict.fromkeys(calls, 0.0)
    with alone(rows.lock):
      for _ in range(TURNS):
        for part, (call, steps) in calls.items():
          best[part] = max(best[part], rate(call, steps, seconds / TURNS)[0])
  emit_peak(rows)
  rows["conditions"] = f"{rows['conditions']}; parts added one by one, best of {TURNS} turns of {seconds / TURNS:.1f} s"
  for part, speed in best.items():
    rows.emit("seconds_per_step", 1 / speed, "s", setting=" ".join((*setting_of(overrides), f"part={part}")))


def _repeat(subject: Subject, run: Run, carry: PyTree) -> Callable[[int], PyTree]:
  """Returns a function that repeats `run`, each time from the last carry."""
  run = jax.jit(run, donate_argnums=0, compiler_options=_options(subject))
  carry = jax.tree.map(jnp.copy, carry)  # parts start from the same state, and each donates the buffers of its carry

  def call(count: int) -> PyTree:
    nonlocal carry
    other = None
    for i in range(count):
      carry, other = run(carry, subject.model, subject.key(i))
    return carry, other

  return call


def _train(subject: Subject, state: TrainState) -> Callable[[int], PyTree]:
  """Returns a function that makes a number of training steps."""
  lowered = subject.trainer.train.lower(state, subject.model, np.int32(1))
  train = lowered.compile(_options(subject))

  def call(count: int) -> PyTree:
    nonlocal state
    state, metrics = train(state, subject.model, np.int32(count))
    return metrics

  call(1 + subject.trainer.config.prefill_updates)
  return call


def _options(subject: Subject) -> dict[str, str | bool]:
  """Returns the options of XLA that a run's programs are compiled with."""
  return {**compiler_options(subject.trainer.mesh, subject.env.unwrapped.impl)}


def _rolls(subject: Subject, state: TrainState, length: int) -> dict[str, tuple[Run, PyTree, int]]:
  """Returns the parts before the update, by name: function of `length` steps, its carry, control steps of each."""
  trainer, env = subject.trainer, subject.trainer.env
  task, repeat, num_envs = env.unwrapped, env.action_repeat, trainer.config.num_envs
  bare, policy = Vectorize(task), trainer.policy(state)

  def random_actions(key: jax.Array) -> jax.Array:
    return jax.random.uniform(key, (num_envs, env.action_size), minval=-1.0, maxval=1.0)

  def by_chance(env: Wrapper) -> Step:
    return lambda state, model, key: env.step(state, random_actions(key), model)

  def act(carry: PyTree, model: ModelFields, key: jax.Array) -> PyTree:
    state, policy = carry  # in the carry, because closed-over arrays are compiled in as constants
    return env.step(state, trainer.act(policy, state.obs, key, False), model), policy

  def advance(data: PhysicsData, fields: dict[str, jax.Array]) -> PhysicsData:
    model = task.mjx_model.tree_replace(fields) if fields else task.mjx_model
    return task.physics.step(model, data, data.ctrl, task.n_substeps)

  def scan(step: Step) -> Run:
    def run(carry: PyTree, model: ModelFields, key: jax.Array) -> tuple[PyTree, PyTree]:
      return jax.lax.scan(lambda c, k: (step(c, model, k), None), carry, jax.random.split(key, length))

    return run

  # The state after a step, because a carry's structure must not change.
  stepped = jax.jit(bare.step)(
    jax.jit(bare.reset)(jax.random.split(subject.key(0), num_envs), subject.model),
    jnp.zeros((num_envs, env.action_size)),
    subject.model,
  )
  seeing: dict[str, tuple[Run, PyTree, int]] = {"episodes": (scan(by_chance(env)), state.env_state, repeat)}
  if any(key.startswith(PIXELS) for key in trainer.networks.select(state.env_state.obs)):
    blind = wrap_for_training(task)
    first = jax.jit(blind.reset)(jax.random.split(subject.key(0), num_envs), subject.model)
    seeing = {"episodes": (scan(by_chance(blind)), first, repeat), "pixels": seeing["episodes"]}
  rolls: dict[str, tuple[Run, PyTree, int]] = {
    "physics": (scan(lambda data, model, key: jax.vmap(advance, axis_name=WORLDS)(data, dict(model))), stepped.data, 1),
    "task": (scan(by_chance(bare)), stepped, 1),
    **seeing,
    "inference": (scan(act), (state.env_state, policy), repeat),
  }
  if hasattr(trainer.config, "unroll_length"):  # the algorithm learns from whole rollouts

    def store(carry: PyTree, model: ModelFields, key: jax.Array) -> tuple[PyTree, PyTree]:
      before, capture, policy = carry
      normalizer = policy.normalizer if trainer.config.normalize_observations else None
      envs = Environments(before, capture, model, {}, env)
      envs, stored = unroll(envs, trainer.networks, policy.params.policy, normalizer, key, length)
      return (envs.state, envs.capture, policy), (stored, envs.sums)

    rolls["storing"] = (store, (state.env_state, state.capture, policy), repeat)
  return rolls
