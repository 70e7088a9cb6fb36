"""PPO's loss, equal to Brax's `compute_ppo_loss` on the same batch, for data that is normalised already."""

from typing import Any

import jax
import jax.numpy as jnp
from brax.training.agents.ppo.losses import compute_gae
from flax import struct

from playground.learning.networks import ActorCritic, ActorCriticParams


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

  Returns:
    The loss and its parts, for the log.
  """
  logits = networks.logits(params.policy, batch.obs)
  values = networks.value(params.value, batch.obs)
  last_value = networks.value(params.value, batch.last_obs)

  targets, advantages = compute_gae(
    truncation=batch.truncation,
    termination=batch.termination,
    rewards=batch.reward * reward_scaling,
    values=values,
    bootstrap_value=last_value,
    lambda_=gae_lambda,
    discount=discounting,
  )
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
  parts: dict[str, Any] = {
    "total_loss": loss,
    "policy_loss": policy_loss,
    "value_loss": value_loss,
    "entropy": entropy,
    "approx_kl": (ratio - 1 - log_ratio).mean(),
    "clip_fraction": (jnp.abs(ratio - 1) > clipping_epsilon).mean(),
  }
  return loss, parts
