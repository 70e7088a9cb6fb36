"""Proximal Policy Optimisation (Schulman et al., 2017) on batched environments, over a mesh of devices.

Names and meaning of the hyperparameters are Brax's (paper, Appendix E). The loss equals Brax's on the same batch. One
training step collects `batch_size * num_minibatches` trajectories of `unroll_length` steps and passes over them
`num_updates_per_batch` times.
"""

import functools

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.flatten_util import ravel_pytree

from playground.envs.base import Env
from playground.envs.symmetry import Mirror, augmentation
from playground.errors import ConfigError
from playground.hardware.mesh import AXIS
from playground.learning.algorithm import Algorithm, AlgorithmState, Metrics, Policy, gradient_step
from playground.learning.cnn import random_shift
from playground.learning.hyperparameters import PPOConfig
from playground.learning.networks import ActorCritic, ActorCriticParams, Normalizer, normalize, update_normalizer
from playground.learning.rollout import Environments, side_by_side, unroll
from playground.pytree import PyTree

LOSSES = ("total_loss", "policy_loss", "value_loss", "entropy", "approx_kl", "clip_fraction")  # what is logged
ESTIMATION = "estimation_loss"  # with an estimator
KL = "kl"  # with a bounded KL divergence
_UNROLL = 64  # steps of a trajectory that are one kernel
_LEAST_SCALE = 1e-2  # of the critic's targets
_NO_KL = 1e-6  # a divergence below it is rounding


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
    targets: of the critic, [T, B], and
    advantages: [T, B]; only where they are computed once an epoch, else None.
    old_logits: of the policy before the update, [T, B, 2 * action_size]; only with a bounded KL divergence.
    mirrored_obs: normalised observations of the mirror images, each [T, B, ...], and
    mirrored_action: their actions before squashing, [T, B, action_size]; only with `mirror_augmentation`.
  """

  obs: dict[str, jax.Array]
  last_obs: dict[str, jax.Array]
  raw_action: jax.Array
  log_prob: jax.Array
  reward: jax.Array
  termination: jax.Array
  truncation: jax.Array
  value: jax.Array | None = None
  targets: jax.Array | None = None
  advantages: jax.Array | None = None
  old_logits: jax.Array | None = None
  mirrored_obs: dict[str, jax.Array] | None = None
  mirrored_action: jax.Array | None = None


class PPOState(AlgorithmState):
  """Also count, mean and sum of squared differences from the mean of the critic's targets, [3], if normalised."""

  targets_seen: jax.Array | None = None


class PPO(Algorithm[PPOConfig, ActorCritic, PPOState]):
  """PPO for one task."""

  def __init__(self, env: Env, config: PPOConfig, network_precision: str | None = None):
    networks = ActorCritic(env.observation_size, env.action_size, config.network, network_precision)
    if config.augment_pixels and not networks.pixel_sizes:
      raise ConfigError(
        f"agent.augment_pixels={config.augment_pixels} shifts images, and the task has none: set it to 0."
      )
    super().__init__(config, networks)
    self.mirror: Mirror | None = augmentation(env) if config.mirror_augmentation else None
    self.bounds_kl = config.desired_kl is not None or config.max_kl is not None
    self.losses = LOSSES + (ESTIMATION,) * bool(networks.estimated_obs_key) + (KL,) * self.bounds_kl

  @property
  def optimizer(self) -> optax.GradientTransformation:
    config = self.config
    clip = optax.clip_by_global_norm(config.max_grad_norm) if config.max_grad_norm else optax.identity()
    # With a desired KL divergence the learning rate is part of the optimiser's state.
    adam = optax.adam if config.desired_kl is None else optax.inject_hyperparams(optax.adam)
    return optax.chain(clip, adam(learning_rate=config.learning_rate))

  def init(self, key: jax.Array, policy: Policy | None) -> PPOState:
    policy = policy or self.new_policy(key)
    opt_state = self.optimizer.init(ravel_pytree(policy.params)[0])
    seen = jnp.zeros(3) if self.config.normalize_value_targets else None
    return PPOState(params=policy.params, opt_state=opt_state, normalizer=policy.normalizer, targets_seen=seen)

  def train_step(self, state: PPOState, envs: Environments, key: jax.Array) -> tuple[PPOState, Environments, Metrics]:
    config, networks = self.config, self.networks
    rollout_key, update_key = jax.random.split(key)

    # Collect: every environment gives the same number of trajectories.
    acting: Normalizer | None = state.normalizer if config.normalize_observations else None
    critic = functools.partial(networks.value, state.params.value) if config.bootstrap_on_timeout else None

    def trajectories(envs: Environments, key: jax.Array) -> tuple[Environments, PyTree]:
      envs, data = unroll(envs, networks, state.params.policy, acting, key, config.unroll_length, critic)
      return envs, (data, envs.state.obs)

    keys = jax.random.split(rollout_key, config.batch_size * config.num_minibatches // config.num_envs)
    envs, (data, last_obs) = envs.scan(trajectories, keys)
    data = jax.tree.map(side_by_side, data)
    last_obs = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), last_obs)

    # Normalise once for all epochs, with statistics that include this data.
    normalizer = acting
    if config.normalize_observations and networks.obs_keys:
      normalizer = update_normalizer(state.normalizer, networks.vectors(data.obs))
    obs, last_obs = normalize(data.obs, normalizer), normalize(networks.select(last_obs), normalizer)

    batch = Batch(obs, last_obs, data.raw_action, data.log_prob, data.reward, data.termination, data.truncation)
    if config.clipping_epsilon_value is not None:
      batch = batch.replace(value=networks.value(state.params.value, normalize(data.obs, acting)))
    if data.final_value is not None:
      batch = pay_time_outs(batch, data.final_value, config)
    if (mirror := self.mirror) is not None:
      mirrored = {key: mirror.obs[key](value) for key, value in data.obs.items()}
      batch = batch.replace(
        mirrored_obs=normalize(mirrored, normalizer), mirrored_action=mirror.action(data.raw_action)
      )
    if self.bounds_kl and not config.augment_pixels:  # else of the shifted images
      batch = batch.replace(old_logits=networks.logits(state.params.policy, batch.obs))
    scale, seen = None, state.targets_seen
    if seen is not None:
      seen = count_targets(seen, self._with_targets(batch, state.params).targets)
      scale = jnp.maximum(jnp.sqrt(seen[2] / seen[0]), _LEAST_SCALE)

    # Learn: several epochs, each over its own shuffle of the trajectories.
    flat, unravel = ravel_pytree(state.params)

    def epoch(carry: tuple[jax.Array, PyTree, jax.Array], key: jax.Array) -> tuple[PyTree, jax.Array]:
      shuffle_key, loss_key = jax.random.split(key)
      columns = jax.random.permutation(shuffle_key, batch.reward.shape[1]).reshape(config.num_minibatches, -1)
      data = self._with_targets(batch, unravel(carry[0])) if config.targets == "epoch" else batch

      def update(
        carry: tuple[jax.Array, PyTree, jax.Array], x: tuple[jax.Array, jax.Array]
      ) -> tuple[PyTree, jax.Array]:
        flat, opt_state, stopped = carry
        minibatch, key = self._minibatch(data, state.params.policy, *x)
        grads, parts = jax.grad(ppo_loss, has_aux=True)(unravel(flat), minibatch, key, networks, config, scale)
        kl = jax.lax.pmean(parts[KL], AXIS) if self.bounds_kl else jnp.zeros(())
        adapted = opt_state if config.desired_kl is None else self._adapt(opt_state, kl)
        *learned, norm, finite = gradient_step(self.optimizer, grads, flat, adapted)
        log = jnp.stack([*(parts[name] for name in self.losses), norm])
        log = jnp.append(jnp.where(finite, log, 0.0), jnp.stack([1.0 - finite, 1.0]))
        if config.max_kl is not None:  # no step from here on
          stopped |= kl > config.max_kl
          learned = jax.tree.map(lambda new, old: jnp.where(stopped, old, new), learned, [flat, opt_state])
          log = jnp.where(stopped, 0.0, log)
        return (*learned, stopped), log

      return jax.lax.scan(update, carry, (columns, jax.random.split(loss_key, config.num_minibatches)))

    epochs = jax.random.split(update_key, config.num_updates_per_batch)
    (flat, opt_state, stopped), log = jax.lax.scan(epoch, (flat, state.opt_state, jnp.array(False)), epochs)
    params = unravel(flat)

    *total, steps = jax.lax.pmean(log.sum((0, 1)), AXIS)
    names = (*self.losses, "grad_norm", "nonfinite_updates")
    made = jnp.maximum(steps, 1)
    metrics: Metrics = {name: value / made for name, value in zip(names, total, strict=True)}
    metrics |= {"gradient_steps": steps, "nonfinite_updates": total[-1]}
    if vectors := jax.tree.leaves(networks.vectors(obs)):
      farthest = jnp.stack([jnp.abs(entry).max() for entry in vectors]).max()
      metrics["obs_farthest"] = jax.lax.pmax(farthest, AXIS)  # largest distance from the mean, in standard deviations
    logits = networks.logits(params.policy, jax.tree.map(lambda x: x[0], obs))
    std = networks.distribution.create_dist(logits).scale.mean()  # before squashing, on the first step of the data
    metrics["policy_std"] = jax.lax.pmean(std, AXIS)
    if config.desired_kl is not None:
      metrics["learning_rate"] = opt_state[1].hyperparams["learning_rate"]
    if config.max_kl is not None:
      metrics["stopped_early"] = stopped.astype(jnp.float32)
    normalizer = state.normalizer if normalizer is None else normalizer
    learned = {"params": params, "opt_state": opt_state, "targets_seen": seen}
    return state.replace(**learned, normalizer=normalizer), envs, metrics

  def _with_targets(self, batch: Batch, params: ActorCriticParams) -> Batch:
    """Returns the batch with targets and advantages by the critic of `params`, normalised over all devices."""
    values = self.networks.value(params.value, _all_obs(batch))
    targets, advantages = gae(batch, values, self.config)
    if self.config.normalize_advantage:
      mean = jax.lax.pmean(advantages.mean(), AXIS)
      std = jnp.sqrt(jax.lax.pmean(jnp.square(advantages - mean).mean(), AXIS))
      advantages = (advantages - mean) / (std + 1e-8)
    return batch.replace(targets=targets, advantages=advantages)

  def _adapt(self, opt_state: PyTree, kl: jax.Array) -> PyTree:
    """Returns the optimiser's state with the learning rate adapted to a minibatch's divergence."""
    clip, adam = opt_state
    rate = adapted_rate(adam.hyperparams["learning_rate"], kl, self.config)
    return clip, adam._replace(hyperparams=adam.hyperparams | {"learning_rate": rate})

  def _minibatch(self, batch: Batch, policy: PyTree, columns: jax.Array, key: jax.Array) -> tuple[Batch, jax.Array]:
    """Returns the trajectories in `columns`, with shifted images if `augment_pixels` is set, and a key for the loss.

    `policy` has the actor's parameters before the update.
    """
    last_obs = jax.tree.map(lambda x: x[columns], batch.last_obs)
    minibatch = jax.tree.map(lambda x: x[:, columns], batch.replace(last_obs=None)).replace(last_obs=last_obs)
    if pad := self.config.augment_pixels:
      key, shift_key = jax.random.split(key)
      shifts = jax.random.randint(shift_key, (len(columns), 2), 0, 2 * pad + 1)
      shift = lambda obs: random_shift(obs, shifts, pad)
      minibatch = minibatch.replace(obs=shift(minibatch.obs), last_obs=shift(minibatch.last_obs))
      if self.bounds_kl:
        minibatch = minibatch.replace(old_logits=self.networks.logits(policy, minibatch.obs))
    return minibatch, key


def ppo_loss(
  params: ActorCriticParams,
  batch: Batch,
  key: jax.Array,
  networks: ActorCritic,
  config: PPOConfig,
  value_scale: jax.Array | None = None,
) -> tuple[jax.Array, dict[str, jax.Array]]:
  """Clipped surrogate, value and entropy loss (Schulman et al., 2017) with GAE on the current critic.

  Args:
    params: actor's and critic's parameters.
    batch: trajectories.
    key: for the sampled entropy of the squashed Gaussian.
    networks: the networks the parameters belong to.
    config: hyperparameters.
    value_scale: divisor of the critic's errors, []; None is 1.

  Returns:
    The loss, and `LOSSES` by name, with `ESTIMATION` if an estimator is trained and `KL` if it is bounded.
  """
  logits, estimate = networks.logits_and_estimate(params.policy, batch.obs)
  if batch.targets is None or batch.advantages is None:
    values = networks.value(params.value, _all_obs(batch))  # at once: the critic is most of the cost
    targets, advantages = gae(batch, values, config)
    values = values[:-1]
    if config.normalize_advantage:
      advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
  else:
    values, targets, advantages = networks.value(params.value, batch.obs), batch.targets, batch.advantages
  if (limit := config.clip_advantages) is not None:
    advantages = jnp.clip(advantages, -limit, limit)

  def surrogate_loss(log_ratio: jax.Array) -> jax.Array:
    if config.dual_clip is not None:  # else the gradient of a negative advantage grows with the ratio, without limit
      log_ratio = jnp.minimum(log_ratio, jnp.log(config.dual_clip))
    ratio = jnp.exp(log_ratio)
    clipped_ratio = jnp.clip(ratio, 1 - config.clipping_epsilon, 1 + config.clipping_epsilon)
    return -jnp.minimum(ratio * advantages, clipped_ratio * advantages).mean()

  log_ratio = networks.distribution.log_prob(logits, batch.raw_action) - batch.log_prob
  ratio = jnp.exp(log_ratio)
  policy_loss = surrogate_loss(log_ratio)

  def squared(error: jax.Array) -> jax.Array:
    error = error if value_scale is None else error / value_scale
    delta = config.value_huber_delta
    return jnp.square(error) if delta is None else 2 * optax.huber_loss(error, delta=delta)

  def critic_loss(values: jax.Array) -> jax.Array:
    value_error = squared(targets - values)
    if (limit := config.clipping_epsilon_value) is not None:  # beyond it the gradient is 0
      assert batch.value is not None
      near = batch.value + jnp.clip(values - batch.value, -limit, limit)
      value_error = jnp.maximum(value_error, squared(targets - near))
    if batch.targets is not None and not config.bootstrap_on_timeout:  # else their error is 0
      value_error *= 1 - batch.truncation
    return 0.5 * config.vf_loss_coefficient * value_error.mean()

  value_loss = critic_loss(values)
  if batch.mirrored_obs is not None:  # with the log-probabilities, advantages and targets of the original
    assert batch.mirrored_action is not None
    mirrored_logits = networks.logits(params.policy, batch.mirrored_obs)
    mirrored_log_prob = networks.distribution.log_prob(mirrored_logits, batch.mirrored_action)
    policy_loss = (policy_loss + surrogate_loss(mirrored_log_prob - batch.log_prob)) / 2
    value_loss = (value_loss + critic_loss(networks.value(params.value, batch.mirrored_obs))) / 2

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
  bounded = {} if batch.old_logits is None else {KL: networks.kl(batch.old_logits, logits).mean()}
  return loss, dict(zip(LOSSES, parts, strict=True)) | estimation | bounded


def adapted_rate(rate: jax.Array, kl: jax.Array, config: PPOConfig) -> jax.Array:
  """Returns the learning rate of a gradient step (Schulman et al., 2017, section 4, as RSL-RL has it).

  Above twice the desired divergence the rate falls by a third, below half of it the rate grows by a half; at 0, where
  the policy has not changed yet, it stays.

  Args:
    rate: the learning rate so far, [].
    kl: divergence of the policy from the one before the update, [].
    config: `desired_kl`, `min_learning_rate`, `max_learning_rate`.
  """
  desired = config.desired_kl
  assert desired is not None
  lower, higher = jnp.maximum(rate / 1.5, config.min_learning_rate), jnp.minimum(rate * 1.5, config.max_learning_rate)
  return jnp.where(kl > 2 * desired, lower, jnp.where((kl > _NO_KL) & (kl < desired / 2), higher, rate))


def count_targets(seen: jax.Array, targets: jax.Array | None) -> jax.Array:
  """Adds the targets of all devices to count, mean and sum of squared differences, [3] (Chan et al., 1983)."""
  assert targets is not None
  devices = jax.lax.axis_size(AXIS)
  count = jnp.float32(targets.size * devices)
  mean = jax.lax.pmean(targets.mean(), AXIS)
  squares = jax.lax.psum(jnp.square(targets - mean).sum(), AXIS)
  total, difference = seen[0] + count, mean - seen[1]
  merged = seen[2] + squares + jnp.square(difference) * seen[0] * count / total
  return jnp.stack([total, seen[1] + difference * count / total, merged])


def _all_obs(batch: Batch) -> dict[str, jax.Array]:
  """Returns the observations of all steps and after the last one, each [T + 1, B, ...]."""
  return jax.tree.map(lambda x, last: jnp.concatenate([x, last[None]]), batch.obs, batch.last_obs)


def pay_time_outs(batch: Batch, final_value: jax.Array, config: PPOConfig) -> Batch:
  """Adds the critic's value of the last observation to the reward of steps at the time limit, and terminates there.

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

  A truncated step has delta 0 and ends the sum of those before it.

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
