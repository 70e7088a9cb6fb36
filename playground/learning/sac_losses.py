"""SAC's three losses, equal to Brax's on the same batch and the same draws, for data that is normalised already."""

import jax
import jax.numpy as jnp
from flax import struct

from playground.learning.networks import SoftActorCritic, SoftActorCriticParams

PARTS = ("critic_loss", "actor_loss", "alpha_loss", "alpha", "entropy")  # what `sac_loss` reports


class Transition(struct.PyTreeNode):
  """Steps of B environments.

  Attributes:
    obs: observations the actions were taken on, each [B, ...].
    next_obs: observations after them, each [B, ...]; where an episode ended, its own last one.
    action: in [-1, 1], [B, action_size].
    reward: [B], unscaled.
    discount: 0 where the task ended the episode, else 1 (after a time-out, too), [B].
    nonfinite: 1 where a number that is not finite cut it, [B]; the critics learn nothing there.
  """

  obs: dict[str, jax.Array]
  next_obs: dict[str, jax.Array]
  action: jax.Array
  reward: jax.Array
  discount: jax.Array
  nonfinite: jax.Array


def sac_loss(
  params: SoftActorCriticParams,
  target_q: object,
  batch: Transition,
  noise: jax.Array,
  networks: SoftActorCritic,
  *,
  discounting: float,
  reward_scaling: float,
) -> tuple[jax.Array, jax.Array]:
  """Critic, actor and temperature loss (Haarnoja et al., 2018b, equations 5, 9 and 18) at once.

  Each holds the others' parameters fixed, so the gradient of their sum is each one's own. One draw of the actor serves
  both its own loss and the temperature's.

  Args:
    params: what is learned.
    target_q: the target critics' parameters.
    batch: normalised transitions.
    noise: standard normal draws for the actions on `obs` and on `next_obs`, [2, B, action_size].
    networks: the networks the parameters belong to.
    discounting: discount factor of one step.
    reward_scaling: factor on rewards.

  Returns:
    The sum of the losses, and its parts in the order of `PARTS`.
  """
  fixed = jax.lax.stop_gradient
  alpha, target_entropy = jnp.exp(params.log_alpha), -0.5 * networks.action_size

  both = jax.tree.map(lambda *x: jnp.stack(x), batch.obs, batch.next_obs)
  logits = networks.logits(params.policy, both)
  (action, next_action), (log_prob, next_log_prob) = networks.sample(logits, noise)

  # The critics on the action taken, the target critics on the next one, and the critics on what the actor would do.
  q, next_q, actor_q = networks.q_each(
    (params.q, batch.obs, batch.action),
    (target_q, batch.next_obs, fixed(next_action)),
    (fixed(params.q), batch.obs, action),
  )

  next_value = next_q.min(axis=0) - alpha * next_log_prob
  target = fixed(batch.reward * reward_scaling + batch.discount * discounting * next_value)
  critic_loss = 0.5 * jnp.square((q - target) * (1 - batch.nonfinite)).mean()
  entropy = -log_prob.mean()
  actor_loss = -fixed(alpha) * entropy - actor_q.min(axis=0).mean()
  alpha_loss = alpha * fixed(entropy - target_entropy)
  parts = (critic_loss, actor_loss, alpha_loss, alpha, entropy)
  return critic_loss + actor_loss + alpha_loss, jnp.stack(parts)
