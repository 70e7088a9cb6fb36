"""From an `agent.name` to its algorithm."""

import importlib
from typing import Any

from jax.sharding import Mesh

from playground.envs.base import Env
from playground.learning.hyperparameters import config_class
from playground.learning.learner import Learner


def algorithm(name: str) -> Any:
  """Imports the class for an `agent.name`; raises UnknownNameError if there is none."""
  module, _, class_name = config_class(name).algorithm.partition(":")
  return getattr(importlib.import_module(module), class_name)


def make_learner(env: Env, agent: Any, mesh: Mesh, network_precision: str | None) -> Learner:
  """Builds the algorithm of an `agent` config for a task's own model: to act or to look at, not to train."""
  config = config_class(agent.name).from_config(agent)
  return algorithm(agent.name)(env, config, mesh, network_precision)
