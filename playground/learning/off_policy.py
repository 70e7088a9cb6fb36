"""The training step of algorithms that learn from a replay buffer, and returns of several steps.

One training step takes one step of every environment, then `grad_updates_per_step` gradient steps on transitions drawn
from the buffer.
"""

import abc
from collections.abc import Mapping
from typing import ClassVar, Generic, TypeVar

import jax
import jax.numpy as jnp
from flax import struct

from playground.envs.base import Env, Observation
from playground.envs.symmetry import Mirror, augmentation
from playground.errors import ConfigError
from playground.hardware.mesh import AXIS
from playground.learning.algorithm import Algorithm, AlgorithmState, Metrics, Policy
from playground.learning.hyperparameters import OffPolicyConfig
from playground.learning.networks import Actor, normalize, update_normalizer
from playground.learning.replay import ReplayBuffer
from playground.learning.rollout import Environments
from playground.mdp.managers import ACTOR
from playground.pytree import PyTree


class Transition(struct.PyTreeNode):
  """Steps of N environments, each [N, ...].

  Attributes:
    obs: observation groups that actor or critics read.
    next_obs: the same after the step; where an episode ended, its last ones.
    action: in [-1, 1].
    reward: unscaled.
    discount: factor on the value of `next_obs`: 0 where the task ended the episode, else 1 (after a time-out, too).
    nonfinite: 1 for a step with a non-finite number, which the critics skip, else 0.
    first: 1 where an episode begins with `obs`; only with `num_steps` above 1, else None.
  """

  obs: dict[str, jax.Array]
  next_obs: dict[str, jax.Array]
  action: jax.Array
  reward: jax.Array
  discount: jax.Array
  nonfinite: jax.Array
  first: jax.Array | None = None


class OffPolicyState(AlgorithmState):
  """Also the parameters of the target critics, of the same structure as `params.q`."""

  target_q: PyTree = None


Learned = tuple[PyTree, PyTree, PyTree]  # parameters, target critics, optimiser
ConfigT = TypeVar("ConfigT", bound=OffPolicyConfig)
NetworksT = TypeVar("NetworksT", bound=Actor)


class OffPolicy(Algorithm[ConfigT, NetworksT, OffPolicyState], Generic[ConfigT, NetworksT]):
  """An algorithm that learns from a replay buffer; a subclass fills `init_optimizer` and `learn`.

  Attributes:
    logged: names of the metrics of `learn`.
    buffer: the replay buffer.
    mirror: the task's left-right mirror, with `mirror_augmentation`, else None.
  """

  logged: ClassVar[tuple[str, ...]]

  def __init__(self, env: Env, config: ConfigT, networks: NetworksT):
    if config.prefill_updates * config.num_envs * env.action_repeat >= config.num_timesteps:
      raise ConfigError(
        f"{config.num_timesteps:,} environment steps are over before agent.min_replay_size={config.min_replay_size} "
        "transitions are collected, so nothing would be learned: train for longer."
      )
    self.mirror: Mirror | None = augmentation(env) if config.mirror_augmentation else None
    shape = lambda *size: jax.ShapeDtypeStruct(size, jnp.float32)
    self._inside = groups_inside(env, networks.obs_sizes)
    obs = {key: shape(*size) for key, size in networks.obs_sizes.items() if key not in self._inside}
    first = shape() if config.num_steps > 1 else None
    example = Transition(obs, obs, shape(env.action_size), shape(), shape(), shape(), first)  # pyright: ignore
    dtype = jnp.dtype(config.replay_dtype)
    self.buffer = ReplayBuffer(config.max_replay_size, config.num_envs, example, config.checkpoint_replay, dtype)
    super().__init__(config, networks, self.buffer)

  @abc.abstractmethod
  def init_optimizer(self, params: PyTree) -> PyTree:
    """Returns the state of the optimiser before the first gradient step."""

  @abc.abstractmethod
  def learn(self, start: Learned, batches: Transition, key: jax.Array, step: jax.Array) -> tuple[Learned, jax.Array]:
    """Makes gradient steps, one for each batch.

    Args:
      start: the learned state.
      batches: normalised transitions, each [updates, B, ...].
      key: of this device.
      step: training steps so far, [].

    Returns:
      The learned state, and means over the gradient steps: of `logged`, then the share that was skipped for a
      non-finite gradient.
    """

  def init(self, key: jax.Array, policy: Policy | None) -> OffPolicyState:
    policy = policy or self.new_policy(key)
    return OffPolicyState(
      params=policy.params,
      opt_state=self.init_optimizer(policy.params),
      normalizer=policy.normalizer,
      replay=self.buffer.init(self.config.num_envs // jax.lax.axis_size(AXIS)),
      target_q=policy.params.q,
    )

  def train_step(
    self, state: OffPolicyState, envs: Environments, key: jax.Array
  ) -> tuple[OffPolicyState, Environments, Metrics]:
    config = self.config
    act_key, replay_key, learn_key = jax.random.split(key, 3)
    assert state.replay is not None

    # Collect: one step of every environment.
    envs, transition = self.collect(state, envs, act_key)
    normalizer = state.normalizer
    if config.normalize_observations:
      normalizer = update_normalizer(normalizer, transition.obs)
    stored = lambda obs: {key: x for key, x in obs.items() if key not in self._inside}
    kept = transition.replace(obs=stored(transition.obs), next_obs=stored(transition.next_obs))
    replay = self.buffer.insert(state.replay, kept)

    # Learn, once the buffer is large enough: batches of all gradient steps are drawn and normalised at once.
    def learn(start: Learned) -> tuple[Learned, jax.Array]:
      shape = (config.grad_updates_per_step, config.batch_size // jax.lax.axis_size(AXIS))
      if config.num_steps > 1:
        windows = self.buffer.sample_windows(replay, replay_key, shape, config.num_steps)
        batches = n_step(windows, config.discounting)
      else:
        batches = self.buffer.sample(replay, replay_key, shape)
      seen = normalizer if config.normalize_observations else None
      whole = lambda obs: obs | {key: obs[of][..., :n] for key, (of, n) in self._inside.items()}
      batches = batches.replace(obs=whole(batches.obs), next_obs=whole(batches.next_obs))
      if self.mirror is not None:
        batches = mirror_half(batches, self.mirror, jax.random.fold_in(replay_key, 1))
      batches = batches.replace(obs=normalize(batches.obs, seen), next_obs=normalize(batches.next_obs, seen))
      return self.learn(start, batches, learn_key, replay.inserted)

    ready = state.replay.inserted >= config.prefill_updates
    idle = lambda start: (start, jnp.zeros(len(self.logged) + 1))
    start = (state.params, state.target_q, state.opt_state)
    (params, target_q, opt_state), log = jax.lax.cond(ready, learn, idle, start)

    metrics: Metrics = dict(zip((*self.logged, "nonfinite_updates"), jax.lax.pmean(log, AXIS), strict=True))
    metrics["learned"] = ready.astype(jnp.float32)
    metrics["gradient_steps"] = metrics["learned"] * config.grad_updates_per_step
    metrics["nonfinite_updates"] *= metrics["gradient_steps"]
    learned = {"params": params, "target_q": target_q, "opt_state": opt_state}
    return state.replace(**learned, normalizer=normalizer, replay=replay), envs, metrics

  def collect(self, state: OffPolicyState, envs: Environments, key: jax.Array) -> tuple[Environments, Transition]:
    """Steps this device's environments once."""
    before = envs.state
    action = self.explore(state, before.obs, key)
    envs, final_obs = envs.step(action)
    after = envs.state
    # A reset of all environments ends no episode, but those that begin have made no step.
    first = jnp.maximum(before.done, before.info["steps"] == 0) if self.config.num_steps > 1 else None
    transition = Transition(
      obs=self.networks.select(before.obs),
      next_obs=self.networks.select(final_obs),
      action=action,
      reward=after.reward,
      discount=1 - after.done * (1 - after.info["truncation"]),
      nonfinite=after.info["nonfinite"],
      first=first,
    )
    return envs, transition

  def explore(self, state: OffPolicyState, obs: Observation, key: jax.Array) -> jax.Array:
    """Returns the actions to collect with, in [-1, 1], [N, action_size]: the policy's samples."""
    return self.act(self.policy(state), obs, key, deterministic=False)


def groups_inside(env: Env, sizes: Mapping[str, tuple[int, ...]]) -> dict[str, tuple[str, int]]:
  """Finds the group `state` where another one begins with it; the buffer does not store it then.

  Returns:
    By group: the other group, and the size of the first one.
  """
  found: dict[str, tuple[str, int]] = {}
  parts = env.observation_parts if len(sizes) > 1 else {}
  for group in sizes:
    first, length = next(iter(parts.get(group, {}).items()), (group, 0))
    if group != ACTOR and first == ACTOR and sizes.get(ACTOR) == (length,):
      found[ACTOR] = group, length
  return found


def mirror_half(batch: Transition, mirror: Mirror, key: jax.Array) -> Transition:
  """Replaces each transition, with a probability of one half, by its left-right mirror image.

  Args:
    batch: transitions before normalisation, each [..., ].
    mirror: of the task.
    key: draws which.
  """
  swap = jax.random.bernoulli(key, shape=(*batch.reward.shape, 1))
  obs = lambda groups: {name: jnp.where(swap, mirror.obs[name](x), x) for name, x in groups.items()}
  action = jnp.where(swap, mirror.action(batch.action), batch.action)
  return batch.replace(obs=obs(batch.obs), next_obs=obs(batch.next_obs), action=action)


def n_step(windows: Transition, discounting: float) -> Transition:
  """Combines several transitions into one: rewards add up, discounted, until the episode or the window ends.

  Args:
    windows: successive steps, each [n, ..., ] with `first`.
    discounting: discount of one step.

  Returns:
    A transition from the first observation and action to the last `next_obs`. `discount` is multiplied by that of all
    steps but one; `nonfinite` is 1 if any of the combined steps is non-finite.
  """
  assert windows.first is not None
  whole = jax.tree.map(lambda x: x[0], windows)
  alive, discount = jnp.ones_like(whole.reward), jnp.ones_like(whole.reward)
  for k in range(1, len(windows.reward)):
    step = jax.tree.map(lambda x, k=k: x[k], windows)
    alive *= 1 - step.first
    goes_on = alive > 0
    discount = jnp.where(goes_on, discount * discounting, discount)
    latest = lambda new, old, on=goes_on: jnp.where(on.reshape(on.shape + (1,) * (new.ndim - on.ndim)), new, old)
    whole = whole.replace(
      reward=whole.reward + alive * discount * step.reward,
      next_obs=jax.tree.map(latest, step.next_obs, whole.next_obs),
      discount=latest(step.discount, whole.discount),
      nonfinite=jnp.maximum(whole.nonfinite, alive * step.nonfinite),
    )
  return whole.replace(discount=whole.discount * discount)
