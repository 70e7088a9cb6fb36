"""Hyperparameters of REINFORCE. Nothing here imports JAX: a wrong value is reported before JAX starts."""

import dataclasses
from typing import Annotated

from playground.learning.hyperparameters import AgentConfig, NetworkConfig
from playground.limits import SHARE, count, positive


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReinforceConfig(AgentConfig):
  """Hyperparameters of REINFORCE."""

  algorithm = "reinforce.algorithm:Reinforce"
  traced = ("learning_rate", "discounting")

  unroll_length: Annotated[int, count(1, 100_000), "policy steps of a trajectory"] = 50
  learning_rate: Annotated[float, positive(1), "of Adam"] = 1e-3
  discounting: Annotated[float, SHARE, "discount factor of one policy step"] = 0.97
  network: NetworkConfig = dataclasses.field(default_factory=NetworkConfig)

  @property
  def steps_per_update(self) -> int:
    return self.num_envs * self.unroll_length
