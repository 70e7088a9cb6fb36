"""Zero or random actions, to view a task without a policy."""

from collections.abc import Mapping

import jax
import numpy as np

from playground.deploy.contract import Contract, commands_of
from playground.deploy.policy import Seen
from playground.envs.base import Env, Observation
from playground.errors import lookup

AGENTS = ("zero", "random")


class ScriptedPolicy:
  """Acts with zeros or uniformly random actions in [-1, 1], in place of an `ExportedPolicy`."""

  def __init__(self, agent: str, task: str, env: Env, seed: int):
    """Takes one of `AGENTS` and the task.

    Raises:
      UnknownNameError: there is no such agent.
    """
    lookup(dict.fromkeys(AGENTS), agent, "--agent")
    self._scale = float(agent == "random")
    self._action_size = env.action_size
    self._sizes = env.observation_size
    self._generator = np.random.default_rng(seed)
    self.contract: Contract = {"task": task, "origin": {"steps": 0, "evaluation": None}, **commands_of(env)}

  def actions(self, obs: Seen) -> np.ndarray:
    """Returns actions [..., action_size] for observations with any leading axes."""
    shape = (*self._batch(obs), self._action_size)
    return (self._scale * self._generator.uniform(-1, 1, shape)).astype(np.float32)

  def act(self, policy: object, obs: Observation, key: jax.Array) -> jax.Array:
    """Returns actions [..., action_size] inside jitted code, as evaluations call a policy."""
    del policy
    return self._scale * jax.random.uniform(key, (*self._batch(obs), self._action_size), minval=-1.0)

  def _batch(self, obs: Seen) -> tuple[int, ...]:
    """Returns the leading axes of observations."""
    if not isinstance(obs, Mapping):
      return np.shape(obs)[:-1]
    name = next(iter(obs))
    assert isinstance(self._sizes, Mapping), "observations by group have sizes by group"
    return np.shape(obs[name])[: np.ndim(obs[name]) - len(self._sizes[name])]
