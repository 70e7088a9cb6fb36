"""One environment of a task in NumPy, which the interfaces of other libraries wrap."""

import os
from typing import NamedTuple

import jax
import numpy as np

from playground import registry
from playground.envs.base import Env, State
from playground.envs.c_physics import on_c_physics
from playground.envs.wrappers import wrap_for_evaluation
from playground.errors import ConfigError, lookup
from playground.pytree import PyTree
from playground.settings import Section

Arrays = np.ndarray | dict[str, np.ndarray]

_builders: set[int] = set()  # this process, and those that it is a fork of, if they have built a task


class Moment(NamedTuple):
  """The outputs of one environment after a reset or a step.

  Attributes:
    obs: one vector, or a dict of them.
    reward: of the step.
    terminated: the task ended the episode.
    truncated: the time limit ended the episode.
    metrics: metrics of the step, by name.
  """

  obs: Arrays
  reward: float
  terminated: bool
  truncated: bool
  metrics: dict[str, float]


class Episodes:
  """Runs episodes of a task, with the task's time limit and action repeat.

  Attributes:
    env: the task.
    state: the present state, a batch of one; None before the first reset.
  """

  def __init__(self, task: str, overrides: Section | None = None, physics: str = "c"):
    """Builds a task; see `load_task`."""
    self.env = load_task(task, overrides, physics)
    batch = wrap_for_evaluation(self.env)
    self._reset, self._step = jax.jit(lambda key: batch.reset(key[None])), jax.jit(batch.step)
    self.state: State | None = None

  def reset(self, seed: int) -> Moment:
    """Starts an episode."""
    state = self.state = self._reset(jax.random.PRNGKey(seed))
    return self._moment(state)

  def step(self, action: np.ndarray) -> Moment:
    """Applies an action in [-1, 1], [action_size]; raises ConfigError if its shape is another."""
    assert self.state is not None, "reset before the first step"
    action = need_shape("action", np.asarray(action, np.float32), (self.env.action_size,))
    state = self.state = self._step(self.state, action[None])
    return self._moment(state)

  def _moment(self, state: State) -> Moment:
    outputs: PyTree = (state.obs, state.reward, state.done, state.info["truncation"], state.metrics)
    obs, reward, done, truncated, metrics = jax.tree.map(lambda x: np.array(x)[0], outputs)
    ended = bool(done) and not truncated
    return Moment(obs, float(reward), ended, bool(truncated), {name: float(value) for name, value in metrics.items()})


def need_shape(name: str, array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
  """Returns an array; raises ConfigError if it has another shape, which JAX may broadcast."""
  if array.shape != shape:
    raise ConfigError(f"{name} has the shape {list(array.shape)}, and must have {list(shape)}.")
  return array


def load_task(task: str, overrides: Section | None = None, physics: str = "mjx") -> Env:
  """Builds a task.

  Args:
    task: its name.
    overrides: values of its config by dotted key.
    physics: `mjx`, or `c`: plain C MuJoCo, which needs no compilation and is faster for one environment on a CPU.

  Raises:
    UnknownNameError: no such task, key or physics.
    ConfigError: this process is a fork of one that has built a task; JAX would wait for threads that it lacks.
  """
  _builders.add(os.getpid())
  if len(_builders) > 1:
    raise ConfigError(
      "This process is a fork of one that has started JAX, and would hang: spawn processes, in gymnasium.make_vec with "
      "vector_kwargs={'context': 'spawn'}."
    )
  place = lookup({"c": on_c_physics, "mjx": lambda env: env}, physics, "physics")
  return place(registry.load(task, overrides=overrides))
