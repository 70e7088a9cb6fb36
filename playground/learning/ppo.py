"""Proximal Policy Optimisation (Schulman et al., 2017) on batched environments, over a mesh of devices.

Names and meaning of the hyperparameters are Brax's (paper, Appendix E). The loss equals Brax's on the same batch. One
training step collects `batch_size * num_minibatches` trajectories of `unroll_length` steps and passes over them
`num_updates_per_batch` times.
"""

from typing import Any

import jax
import jax.numpy as jnp
import optax
from brax.training.acme import running_statistics
from flax import struct
from jax.flatten_util import ravel_pytree

from playground.envs.base import Env
from playground.errors import ConfigError
from playground.hardware.mesh import AXIS
from playground.learning.algorithm import Algorithm, AlgorithmState, Metrics, Policy, gradient_step
from playground.learning.cnn import random_shift
from playground.learning.hyperparameters import PPOConfig
from playground.learning.networks import ActorCritic, ActorCriticParams, Normalizer, normalize
from playground.learning.rollout import Environments, side_by_side, unroll

LOSSES = ("total_loss", "policy_loss", "value_loss", "entropy", "approx_kl", "clip_fraction")  # what is logged
ESTIMATION = "estimation_loss"  # with them where something is estimated
_UNROLL = 64  # steps of a trajectory that are one kernel


class Batch(struct.PyTreeNode):
  """B trajectories of T steps each, time first.

  Attributes:
    obs: normalised observations the actions were taken on, each [T, B, ...].
    last_obs: normalised observations after the last step, each [B, ...].
    raw_action: actions before squashing, [T, B, action_size].
    log_prob: their log-probability under the policy that took them, [T, B].
    reward: [T, B], unscaled.
    termination: 1 where the task ended the episode, [T, B].
    truncation: 1 where the time limit cut it, [T, B].
    value: the critic's value when the action was taken, [T, B]; only where the value loss is clipped, else None.
  """

  obs: dict[str, jax.Array]
  last_obs: dict[str, jax.Array]
  raw_action: jax.Array
  log_prob: jax.Array
  reward: jax.Array
  termination: jax.Array
  truncation: jax.Array
  value: jax.Array | None = None


class PPO(Algorithm[PPOConfig, ActorCritic, AlgorithmState]):
  """PPO for one task."""

  def __init__(self, env: Env, config: PPOConfig, network_precision: str | None = None):
    networks = ActorCritic(env.observation_size, env.action_size, config.network, network_precision)
    if config.augment_pixels and not networks.pixel_sizes:
      raise ConfigError(
        f"agent.augment_pixels={config.augment_pixels} shifts pictures, and the task has none: set it to 0."
      )
    super().__init__(config, networks)
    clip = optax.clip_by_global_norm(config.max_grad_norm) if config.max_grad_norm else optax.identity()
    self.optimizer = optax.chain(clip, optax.adam(config.learning_rate))
    self.losses = (*LOSSES, ESTIMATION) if networks.estimated_obs_key else LOSSES

  def init(self, key: jax.Array, policy: Policy | None) -> AlgorithmState:
    params = self.networks.init(key) if policy is None else policy.params
    normalizer = self.networks.init_normalizer() if policy is None else policy.normalizer
    return AlgorithmState(params=params, opt_state=self.optimizer.init(ravel_pytree(params)[0]), normalizer=normalizer)

  def train_step(
    self, state: AlgorithmState, envs: Environments, key: jax.Array
  ) -> tuple[AlgorithmState, Environments, Metrics]:
    config, networks = self.config, self.networks
    rollout_key, update_key = jax.random.split(key)

    # Collect: every environment gives the same number of trajectories.
    normalizer: Normalizer | None = state.normalizer if config.normalize_observations else None
    critic = state.params.value if config.bootstrap_on_timeout else None

    def trajectories(envs: Environments, key: jax.Array) -> tuple[Environments, Any]:
      envs, data = unroll(envs, networks, state.params.policy, normalizer, key, config.unroll_length, critic)
      return envs, (data, envs.state.obs)

    keys = jax.random.split(rollout_key, config.batch_size * config.num_minibatches // config.num_envs)
    envs, (data, last_obs) = envs.scan(trajectories, keys)
    data = jax.tree.map(side_by_side, data)
    last_obs = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), last_obs)

    # Normalise once for all epochs, with statistics that include this data.
    if config.normalize_observations and networks.obs_keys:
      normalizer = running_statistics.update(state.normalizer, networks.vectors(data.obs), pmap_axis_name=AXIS)
    obs, last_obs = normalize(data.obs, normalizer), normalize(networks.select(last_obs), normalizer)

    batch = Batch(obs, last_obs, data.raw_action, data.log_prob, data.reward, data.termination, data.truncation)
    if config.clipping_epsilon_value is not None:
      batch = batch.replace(value=networks.value(state.params.value, normalize(data.obs, state.normalizer)))
    if data.final_value is not None:
      batch = pay_time_outs(batch, data.final_value, config)

    # Learn: several epochs, each over its own shuffle of the trajectories.
    flat, unravel = ravel_pytree(state.params)

    def update(carry: tuple[jax.Array, Any], x: tuple[jax.Array, jax.Array]) -> tuple[Any, jax.Array]:
      minibatch, key = self._minibatch(batch, *x)
      grads, parts = jax.grad(ppo_loss, has_aux=True)(unravel(carry[0]), minibatch, key, networks, config)
      params, opt_state, norm, finite = gradient_step(self.optimizer, grads, *carry)
      log = jnp.stack([*(parts[name] for name in self.losses), norm])
      return (params, opt_state), jnp.append(jnp.where(finite, log, 0.0), 1.0 - finite)

    def epoch(carry: tuple[jax.Array, Any], key: jax.Array) -> tuple[Any, jax.Array]:
      shuffle_key, loss_key = jax.random.split(key)
      columns = jax.random.permutation(shuffle_key, batch.reward.shape[1]).reshape(config.num_minibatches, -1)
      return jax.lax.scan(update, carry, (columns, jax.random.split(loss_key, config.num_minibatches)))

    epochs = jax.random.split(update_key, config.num_updates_per_batch)
    (flat, opt_state), log = jax.lax.scan(epoch, (flat, state.opt_state), epochs)
    params = unravel(flat)

    names = (*self.losses, "grad_norm", "nonfinite_updates")
    metrics: Metrics = dict(zip(names, jax.lax.pmean(log.mean((0, 1)), AXIS), strict=True))
    metrics["gradient_steps"] = jnp.float32(config.num_updates_per_batch * config.num_minibatches)
    metrics["nonfinite_updates"] *= metrics["gradient_steps"]
    if vectors := jax.tree.leaves(networks.vectors(obs)):
      farthest = jnp.stack([jnp.abs(entry).max() for entry in vectors]).max()
      metrics["obs_farthest"] = jax.lax.pmax(farthest, AXIS)  # of any number from its mean, in standard deviations
    logits = networks.logits(params.policy, jax.tree.map(lambda x: x[0], obs))
    std = networks.distribution.create_dist(logits).scale.mean()  # before squashing, on the first step of the data
    metrics["policy_std"] = jax.lax.pmean(std, AXIS)
    normalizer = state.normalizer if normalizer is None else normalizer
    return state.replace(params=params, opt_state=opt_state, normalizer=normalizer), envs, metrics

  def _minibatch(self, batch: Batch, columns: jax.Array, key: jax.Array) -> tuple[Batch, jax.Array]:
    """The trajectories in `columns`, their images shifted if `augment_pixels` says so, and a key for the loss."""
    last_obs = jax.tree.map(lambda x: x[columns], batch.last_obs)
    minibatch = jax.tree.map(lambda x: x[:, columns], batch.replace(last_obs=None)).replace(last_obs=last_obs)
    if pad := self.config.augment_pixels:
      key, shift_key = jax.random.split(key)
      shifts = jax.random.randint(shift_key, (len(columns), 2), 0, 2 * pad + 1)
      shift = lambda obs: random_shift(obs, shifts, pad)
      minibatch = minibatch.replace(obs=shift(minibatch.obs), last_obs=shift(minibatch.last_obs))
    return minibatch, key


def ppo_loss(
  params: ActorCriticParams, batch: Batch, key: jax.Array, networks: ActorCritic, config: PPOConfig
) -> tuple[jax.Array, dict[str, jax.Array]]:
  """Clipped surrogate, value and entropy loss (Schulman et al., 2017) with GAE on the present critic.

  Args:
    params: actor's and critic's parameters.
    batch: trajectories.
    key: for the sampled entropy of the squashed Gaussian.
    networks: the networks the parameters belong to.
    config: hyperparameters.

  Returns:
    The loss, and `LOSSES` by name, with `ESTIMATION` where something is estimated.
  """
  logits, estimate = networks.logits_and_estimate(params.policy, batch.obs)
  obs = jax.tree.map(lambda x, last: jnp.concatenate([x, last[None]]), batch.obs, batch.last_obs)
  values = networks.value(params.value, obs)  # in one go: the critic is most of the cost
  targets, advantages = gae(batch, values, config)
  values = values[:-1]
  if config.normalize_advantage:
    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)

  log_ratio = networks.distribution.log_prob(logits, batch.raw_action) - batch.log_prob
  ratio = jnp.exp(log_ratio)
  clipped_ratio = jnp.clip(ratio, 1 - config.clipping_epsilon, 1 + config.clipping_epsilon)
  policy_loss = -jnp.minimum(ratio * advantages, clipped_ratio * advantages).mean()

  value_error = jnp.square(targets - values)
  if (limit := config.clipping_epsilon_value) is not None:  # beyond it the loss stops paying
    assert batch.value is not None
    near = batch.value + jnp.clip(values - batch.value, -limit, limit)
    value_error = jnp.maximum(value_error, jnp.square(targets - near))
  value_loss = 0.5 * config.vf_loss_coefficient * value_error.mean()

  entropy = networks.distribution.entropy(logits, key).mean()
  loss = policy_loss + value_loss - config.entropy_cost * entropy
  estimation = {}
  if estimate is not None:
    # Not squared: a number that hardly ever changes is hundreds of standard deviations away when it does.
    estimation[ESTIMATION] = optax.huber_loss(estimate, batch.obs[networks.estimated_obs_key]).mean()
    loss += config.estimation_coefficient * estimation[ESTIMATION]
  approx_kl = (ratio - 1 - log_ratio).mean()
  clip_fraction = (jnp.abs(ratio - 1) > config.clipping_epsilon).mean()
  parts = (loss, policy_loss, value_loss, entropy, approx_kl, clip_fraction)
  return loss, dict(zip(LOSSES, parts, strict=True)) | estimation


def pay_time_outs(batch: Batch, final_value: jax.Array, config: PPOConfig) -> Batch:
  """Ends episodes that time cut as if they had earned there what the critic expects of the rest.

  Args:
    batch: trajectories.
    final_value: the critic's value, of scaled rewards, of an episode's last observation where time cut it, else 0,
      [T, B].
    config: `discounting`, `reward_scaling`.
  """
  return batch.replace(
    reward=batch.reward + config.discounting * final_value / config.reward_scaling,
    termination=jnp.maximum(batch.termination, batch.truncation),
    truncation=jnp.zeros_like(batch.truncation),
  )


def gae(batch: Batch, values: jax.Array, config: PPOConfig) -> tuple[jax.Array, jax.Array]:
  """Generalised advantage estimation (Schulman et al., 2016), as Brax has it.

  A truncated step teaches nothing (delta 0) and cuts the sum of those before it.

  Args:
    batch: B trajectories of T steps.
    values: the critic's values of their T + 1 states, [T + 1, B].
    config: `reward_scaling`, `discounting`, `gae_lambda`.

  Returns:
    Targets of the critic and advantages, each [T, B]; no gradient flows through them.
  """
  values = jax.lax.stop_gradient(values)
  learns = 1 - batch.truncation
  reward = batch.reward * config.reward_scaling
  discount = config.discounting * (1 - batch.termination)

  def step(total: jax.Array, x: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
    delta, decay = x
    total = delta + decay * total
    return total, total

  deltas = (reward + discount * values[1:] - values[:-1]) * learns
  start, decays = jnp.zeros_like(values[0]), discount * learns * config.gae_lambda
  # Unrolled: a loop on a GPU costs a kernel an iteration, here 10 to 25 % of a training step.
  sums = jax.lax.scan(step, start, (deltas, decays), reverse=True, unroll=_UNROLL)[1]
  targets = sums + values[:-1]
  next_targets = jnp.concatenate([targets[1:], values[-1:]])
  return targets, (reward + discount * next_targets - values[:-1]) * learns
