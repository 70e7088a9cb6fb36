"""Zero or random actions, to view a task without a policy."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from playground import registry
from playground.config import compose, config_dict
from playground.deploy.contract import Contract
from playground.deploy.policy import Seen
from playground.deploy.trained import switch_off_interval_events
from playground.envs.base import Env, Observation
from playground.envs.c_physics import on_c_physics
from playground.envs.options import uses_vision
from playground.errors import lookup
from playground.hardware.setup import setup, this_machine
from playground.randomization import Randomizer

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
    velocity: Any = (env.config.get("commands") or {}).get("velocity") or {}
    self.contract: Contract = {
      "task": task,
      "origin": {"steps": 0, "evaluation": None},
      "command": dict(velocity.get("params") or {}),
    }

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


def build_task(
  task: str, overrides: Sequence[str], seed: int, *, randomize: bool = False, interval_events: bool = True
) -> Env:
  """Builds a task on C MuJoCo.

  Args:
    task: its name.
    overrides: as for playground-run.
    seed: of the randomised model.
    randomize: whether the startup events change the model once.
    interval_events: whether pushes and other interval events act.

  Raises:
    PlaygroundError: no such task, or overrides that do not compose.
  """
  setup(this_machine(compose(["hardware=cpu"]).hardware))
  config: Any = config_dict(compose([f"env={task}", *overrides]).env)
  config.impl = "warp" if uses_vision(config) else "jax"  # the smallest model to build; it is not simulated
  if not interval_events:
    switch_off_interval_events(config)
  env = registry.load(task, config=config)
  if randomize:
    for name, value in Randomizer(env.mj_model, config.events).sample(jax.random.PRNGKey(seed)).items():
      getattr(env.mj_model, name)[:] = np.asarray(value)
  return on_c_physics(env)
