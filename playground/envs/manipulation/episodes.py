"""Where an episode begins: its first state, and what a task keeps in `info`."""

from typing import Any

import jax
import jax.numpy as jnp

from playground.envs.base import Env, State
from playground.envs.physics import PhysicsData


def begin_anew(state: State, **first: Any) -> State:
  """Sets entries of `info` where an episode begins, from its first state.

  An auto-reset brings back the simulator's first state, its time of 0 included, but hands on the last episode's `info`.

  Args:
    state: before a step.
    first: entries by name, as they are at the start of an episode.
  """
  begins = state.data.time == 0
  return state.replace(info=state.info | {k: jnp.where(begins, v, state.info[k]) for k, v in first.items()})


def first_state(env: Env, data: PhysicsData, obs: Any, info: dict[str, Any]) -> State:
  """The state that an episode begins with: nothing is rewarded or counted yet.

  Args:
    env: the task.
    data: the physics at the start.
    obs: the observation of it.
    info: what the task carries into the first step.
  """
  metrics = jax.eval_shape(env.evaluate, data, info, jnp.zeros(env.action_size)).metrics
  zero = jnp.zeros(())
  return State(data, obs, zero, zero, dict.fromkeys(metrics, zero), info)
