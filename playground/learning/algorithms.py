"""The algorithms that `agent.name` chooses from. A new one is a `Learner` and a line here."""

from typing import Any

from jax.sharding import Mesh

from playground.envs.base import Env
from playground.errors import UnknownNameError, nearest
from playground.learning.learner import Learner
from playground.learning.ppo import PPO
from playground.learning.rsl_rl import RslRlPPO
from playground.learning.sac import SAC

ALGORITHMS: dict[str, type[PPO] | type[SAC] | type[RslRlPPO]] = {"ppo": PPO, "sac": SAC, "rsl_rl_ppo": RslRlPPO}


def algorithm(name: str) -> type[PPO] | type[SAC] | type[RslRlPPO]:
  """The class for an `agent.name`; raises UnknownNameError if there is none."""
  if name not in ALGORITHMS:
    known = ", ".join(ALGORITHMS)
    raise UnknownNameError(f"agent.name={name} does not exist: choose from {known}.{nearest(name, ALGORITHMS)}")
  return ALGORITHMS[name]


def make_learner(env: Env, agent: Any, mesh: Mesh, network_precision: str | None) -> Learner:
  """Builds the algorithm of an `agent` config for a task's own model: to act or to look at, not to train."""
  algorithm_class = algorithm(agent.name)
  return algorithm_class(env, algorithm_class.Config.from_config(agent), mesh, network_precision)
