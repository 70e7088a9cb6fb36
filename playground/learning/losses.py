"""PPO's loss, equal to Brax's `compute_ppo_loss` on the same batch, for data that is normalised already."""

import jax
import jax.numpy as jnp
import optax
from flax import struct

from playground.learning.networks import ActorCritic, ActorCriticParams

LOSSES = ("total_loss", "policy_loss", "value_loss", "entropy", "approx_kl", "clip_fraction")  # what is logged
ESTIMATION = "estimation_loss"  # with them where something is estimated


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


def ppo_loss(
  params: ActorCriticParams,
  batch: Batch,
  key: jax.Array,
  networks: ActorCritic,
  *,
  clipping_epsilon: float = 0.3,
  clipping_epsilon_value: float | None = None,
  entropy_cost: float = 1e-4,
  discounting: float = 0.9,
  gae_lambda: float = 0.95,
  reward_scaling: float = 1.0,
  normalize_advantage: bool = True,
  vf_loss_coefficient: float = 0.5,
  estimation_coefficient: float = 1.0,
) -> tuple[jax.Array, dict[str, jax.Array]]:
  """Clipped surrogate, value and entropy loss (Schulman et al., 2017) with GAE on the present critic.

  Args:
    params: actor's and critic's parameters.
    batch: trajectories.
    key: for the sampled entropy of the squashed Gaussian.
    networks: the networks the parameters belong to.
    clipping_epsilon: probability ratios are clipped to 1 +- this.
    clipping_epsilon_value: if set, values may move this far from those at acting time before the loss stops paying.
    entropy_cost: weight of the entropy bonus.
    discounting: discount factor of one step.
    gae_lambda: decay of generalised advantage estimation.
    reward_scaling: factor on rewards.
    normalize_advantage: whether advantages get zero mean and unit deviation over the batch.
    vf_loss_coefficient: weight of the value loss (on top of the usual half).
    estimation_coefficient: weight of the actor's mean error (Huber) in estimating `network.estimated_obs_key`.

  Returns:
    The loss, and `LOSSES` by name, with `ESTIMATION` where something is estimated.
  """
  logits, estimate = networks.logits_and_estimate(params.policy, batch.obs)
  obs = jax.tree.map(lambda x, last: jnp.concatenate([x, last[None]]), batch.obs, batch.last_obs)
  values = networks.value(params.value, obs)  # in one go: the critic is most of the cost
  targets, advantages = gae(batch, values, reward_scaling, discounting, gae_lambda)
  values = values[:-1]
  if normalize_advantage:
    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)

  log_ratio = networks.distribution.log_prob(logits, batch.raw_action) - batch.log_prob
  ratio = jnp.exp(log_ratio)
  clipped_ratio = jnp.clip(ratio, 1 - clipping_epsilon, 1 + clipping_epsilon)
  policy_loss = -jnp.minimum(ratio * advantages, clipped_ratio * advantages).mean()

  value_error = jnp.square(targets - values)
  if clipping_epsilon_value is not None:
    assert batch.value is not None
    near = batch.value + jnp.clip(values - batch.value, -clipping_epsilon_value, clipping_epsilon_value)
    value_error = jnp.maximum(value_error, jnp.square(targets - near))
  value_loss = 0.5 * vf_loss_coefficient * value_error.mean()

  entropy = networks.distribution.entropy(logits, key).mean()
  loss = policy_loss + value_loss - entropy_cost * entropy
  estimation = {}
  if estimate is not None:
    # Not squared: a number that hardly ever changes is hundreds of deviations away when it does.
    estimation[ESTIMATION] = optax.huber_loss(estimate, batch.obs[networks.estimated_obs_key]).mean()
    loss += estimation_coefficient * estimation[ESTIMATION]
  approx_kl = (ratio - 1 - log_ratio).mean()
  clip_fraction = (jnp.abs(ratio - 1) > clipping_epsilon).mean()
  parts = (loss, policy_loss, value_loss, entropy, approx_kl, clip_fraction)
  return loss, dict(zip(LOSSES, parts, strict=True)) | estimation


def pay_time_outs(batch: Batch, final_value: jax.Array, discounting: float, reward_scaling: float) -> Batch:
  """Ends episodes that time cut as if they had earned there what the critic expects of the rest.

  Args:
    batch: trajectories.
    final_value: the critic's value, of scaled rewards, of an episode's last observation where time cut it, else 0,
      [T, B].
    discounting: discount factor of one step.
    reward_scaling: factor on rewards, which those of the batch still lack.
  """
  return batch.replace(
    reward=batch.reward + discounting * final_value / reward_scaling,
    termination=jnp.maximum(batch.termination, batch.truncation),
    truncation=jnp.zeros_like(batch.truncation),
  )


def gae(
  batch: Batch, values: jax.Array, reward_scaling: float, discounting: float, gae_lambda: float
) -> tuple[jax.Array, jax.Array]:
  """Generalised advantage estimation (Schulman et al., 2016), as Brax has it.

  A truncated step teaches nothing (delta 0) and cuts the sum of those before it.

  Args:
    batch: B trajectories of T steps.
    values: the critic's values of their T + 1 states, [T + 1, B].
    reward_scaling: factor on rewards.
    discounting: discount factor of one step.
    gae_lambda: decay of the sum of temporal differences.

  Returns:
    Targets of the critic and advantages, each [T, B]; no gradient flows through them.
  """
  values = jax.lax.stop_gradient(values)
  learns = 1 - batch.truncation
  reward = batch.reward * reward_scaling
  discount = discounting * (1 - batch.termination)

  def step(total: jax.Array, x: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
    delta, decay = x
    total = delta + decay * total
    return total, total

  deltas = (reward + discount * values[1:] - values[:-1]) * learns
  start, decays = jnp.zeros_like(values[0]), discount * learns * gae_lambda
  # Unrolled: a loop on a GPU costs a kernel an iteration, here 10 to 25 % of a training step.
  sums = jax.lax.scan(step, start, (deltas, decays), reverse=True, unroll=_UNROLL)[1]
  targets = sums + values[:-1]
  next_targets = jnp.concatenate([targets[1:], values[-1:]])
  return targets, (reward + discount * next_targets - values[:-1]) * learns


_UNROLL = 64  # steps of a trajectory that are one kernel
