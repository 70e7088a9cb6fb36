"""The interface of an algorithm. The trainer does what is the same for all (`playground.learning.trainer`)."""

import abc
import copy
import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import ClassVar, Generic, TypeVar

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.flatten_util import ravel_pytree

from playground.envs.base import Env, Observation
from playground.errors import ConfigError, lookup
from playground.hardware.mesh import AXIS
from playground.learning.hyperparameters import AgentConfig
from playground.learning.networks import Actor, Normalizer
from playground.learning.replay import Replay, ReplayBuffer
from playground.learning.rollout import Environments
from playground.pytree import PyTree
from playground.settings import check
from playground.trust import named_module

Metrics = dict[str, jax.Array]


class Policy(struct.PyTreeNode):
  """Parameters and observation statistics: enough to act, and to start another run.

  Attributes:
    params: of all networks; the actor's are `params.policy`.
    normalizer: running mean and standard deviation of observations.
  """

  params: PyTree
  normalizer: Normalizer


class AlgorithmState(struct.PyTreeNode):
  """The learned state of an algorithm, the same on every device. A subclass may add fields.

  Attributes:
    params, normalizer: see `Policy`.
    opt_state: of the optimiser.
    replay: experience of an algorithm that has a replay buffer, divided over the devices by environments.
  """

  params: PyTree
  opt_state: PyTree
  normalizer: Normalizer
  replay: Replay | None = None


ConfigT = TypeVar("ConfigT", bound=AgentConfig)
NetworksT = TypeVar("NetworksT", bound=Actor)
StateT = TypeVar("StateT", bound=AlgorithmState)


class Algorithm(abc.ABC, Generic[ConfigT, NetworksT, StateT]):
  """An algorithm for one task: pure functions that run on every device, each with its share of the environments.

  Collectives between the devices name the axis `AXIS`; its size is `jax.lax.axis_size(AXIS)`. A subclass takes
  `(env, config, network_precision)` and fills `init` and `train_step`.

  Attributes:
    samples: whether the policy can sample its actions; else it has only a mode.
    config: hyperparameters, checked.
    networks: the actor, with the networks that only training needs.
    replay: the buffer of an algorithm that trains on past experience, else None.
  """

  samples: ClassVar[bool] = True

  def __init__(self, config: ConfigT, networks: NetworksT, replay: ReplayBuffer | None = None):
    self.config, self.networks, self.replay = config, networks, replay

  @abc.abstractmethod
  def init(self, key: jax.Array, policy: Policy | None) -> StateT:
    """Returns the state of a new run, with the parameters and statistics of `policy` if there is one."""

  @abc.abstractmethod
  def train_step(self, state: StateT, envs: Environments, key: jax.Array) -> tuple[StateT, Environments, Metrics]:
    """Collects experience and learns from it, once.

    Args:
      state: the learned state.
      envs: this device's share of the environments.
      key: of this device.

    Returns:
      The new state and environments, and float32 scalars, the same on all devices: means of the logged metrics,
      `gradient_steps`, and `nonfinite_updates`, the number of skipped ones. Where `learned` is 0, the means are not
      logged: there was nothing to learn from yet.
    """

  def new_policy(self, key: jax.Array) -> Policy:
    """Returns new parameters, and statistics of no observations."""
    return Policy(self.networks.init(key), self.networks.init_normalizer())

  def policy(self, state: StateT) -> Policy:
    """Returns the policy."""
    return Policy(state.params, state.normalizer)

  def act(self, policy: Policy, obs: Observation, key: jax.Array, deterministic: bool | None = None) -> jax.Array:
    """Returns actions in [-1, 1], [..., action_size]; `deterministic` defaults to `deterministic_eval`."""
    normalizer = policy.normalizer if self.config.normalize_observations else None
    deterministic = self.config.deterministic_eval if deterministic is None else deterministic
    return self.networks.act(policy.params.policy, normalizer, obs, key, deterministic)


AnyAlgorithm = Algorithm[AgentConfig, Actor, AlgorithmState]


class TracedSetting:
  """Stands in an algorithm's constructor for a number of `traced`, whose value only `init` and `train_step` know."""


def build_algorithm(env: Env, config: AgentConfig, network_precision: str | None) -> AnyAlgorithm:
  """Imports and builds the algorithm of a config.

  Raises:
    ConfigError: an invalid value, sizes that do not fit each other, or networks that do not fit the task.
  """
  check(config, "agent")
  module, _, name = config.algorithm.partition(":")
  key = f"{type(config).__name__}.algorithm"
  found = vars(named_module(key, config.algorithm, module))
  make: Callable[..., AnyAlgorithm] = lookup(found, name, f"{key}={config.algorithm}")
  if lacking := sorted(getattr(make, "__abstractmethods__", ())):
    raise ConfigError(f"{key}={config.algorithm} lacks the method {' and '.join(lacking)}.")
  fields = [field.name for field in dataclasses.fields(config)]
  for setting in config.traced:
    lookup(dict.fromkeys(fields), setting, f"{type(config).__name__}.traced")
  # A number that the constructor reads would be a constant, the same for all agents of the program.
  unknown = dict.fromkeys(config.traced, TracedSetting())
  algorithm = make(env, dataclasses.replace(config, **unknown), network_precision)
  algorithm.config = config
  return algorithm


def with_settings(algorithm: AnyAlgorithm, values: Mapping[str, jax.Array]) -> AnyAlgorithm:
  """Returns the same algorithm with other values, each [], of settings that `config.traced` names."""
  other = copy.copy(algorithm)
  other.config = dataclasses.replace(algorithm.config, **values)
  return other


def other_acts(algorithm: AnyAlgorithm) -> dict[str, Callable[..., jax.Array]]:
  """Returns the act function that `deterministic_eval` does not choose, by name in metrics.csv (mode, sampled)."""
  mode = not algorithm.config.deterministic_eval
  act = functools.partial(algorithm.act, deterministic=mode)
  return {"mode" if mode else "sampled": act} if algorithm.samples else {}


def gradient_step(
  optimizer: optax.GradientTransformation, grads: PyTree, params: jax.Array, opt_state: PyTree
) -> tuple[jax.Array, PyTree, jax.Array, jax.Array]:
  """Applies gradients, averaged over the devices; a non-finite one is skipped.

  Parameters are one vector: separate arrays would cost one or two GPU kernels each.

  Args:
    optimizer: of `params`.
    grads: a tree.
    params: the raveled tree of parameters.
    opt_state: of the optimiser.

  Returns:
    Parameters and optimiser after it, the gradient's norm, and whether it was finite.

  Raises:
    ConfigError: the gradients are not of these parameters.
  """
  flat, _ = ravel_pytree(grads)
  if flat.shape != params.shape:
    raise ConfigError(f"gradient_step got {flat.size:,} gradients for {params.size:,} parameters: give it all of them.")
  flat = jax.lax.pmean(flat, AXIS)
  norm = jnp.linalg.norm(flat)
  updates, new_opt_state = optimizer.update(flat, opt_state, params)
  finite = jnp.isfinite(norm)
  new = (optax.apply_updates(params, updates), new_opt_state)
  params, opt_state = jax.tree.map(lambda n, o: jnp.where(finite, n, o), new, (params, opt_state))
  return params, opt_state, norm, finite
