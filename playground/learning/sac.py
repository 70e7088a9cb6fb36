"""Soft Actor-Critic (Haarnoja et al., 2018b) on batched environments, over a mesh of devices.

Names and meaning of the hyperparameters are Brax's (paper, Appendix E). The losses equal Brax's on the same batch and
draws. One training step takes one step of every environment and then `grad_updates_per_step` gradient steps on
transitions drawn from the replay buffer.
"""

from typing import cast

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from playground.envs.base import Env
from playground.hardware.mesh import AXIS
from playground.learning.hyperparameters import SACConfig
from playground.learning.networks import SoftActorCritic, SoftActorCriticParams
from playground.learning.off_policy import Learned, OffPolicy, Transition
from playground.pytree import PyTree

PARTS = ("critic_loss", "actor_loss", "alpha_loss", "alpha", "entropy")  # what `sac_loss` reports


class SAC(OffPolicy[SACConfig, SoftActorCritic]):
  """SAC for one task."""

  logged = (*PARTS, "grad_norm")

  def __init__(self, env: Env, config: SACConfig, network_precision: str | None = None):
    networks = SoftActorCritic(env.observation_size, env.action_size, config.network, network_precision)
    super().__init__(env, config, networks)
    self.optimizer = optax.scale_by_adam()

  def init_optimizer(self, params: SoftActorCriticParams) -> PyTree:
    return self.optimizer.init(ravel_pytree(params)[0])

  def learn(self, start: Learned, batches: Transition, key: jax.Array, step: jax.Array) -> tuple[Learned, jax.Array]:
    """Makes gradient steps, one for each batch.

    Parameters are one vector: a kernel for each array costs far more.
    """
    params, target_q, opt_state = start
    (flat, unravel), (flat_target, unravel_target) = ravel_pytree(params), ravel_pytree(target_q)
    config = self.config
    updates, size = batches.reward.shape
    noise = jax.random.normal(key, (updates, 2, size, self.networks.action_size))
    rates = (config.learning_rate, config.learning_rate, config.alpha_learning_rate)  # critics, actor, temperature
    rates = jax.tree.broadcast(SoftActorCriticParams(*rates), params)  # pyright: ignore[reportArgumentType]
    rates = ravel_pytree(jax.tree.map(jnp.full_like, params, rates))[0]

    def update(carry: tuple[PyTree, PyTree, PyTree], x: tuple[Transition, jax.Array]) -> tuple[PyTree, jax.Array]:
      """Makes one gradient step for critics, actor and temperature, then updates the target critics."""
      params, target, opt_state = carry
      grads, parts = jax.grad(sac_loss, has_aux=True)(
        unravel(params), unravel_target(target), *x, self.networks, config
      )
      grads = jax.lax.pmean(ravel_pytree(grads)[0], AXIS)
      norm = jnp.linalg.norm(grads)
      step, new_opt_state = self.optimizer.update(grads, opt_state)
      new_params = params - rates * cast(jax.Array, step)
      new_target = target + config.tau * (new_params[: target.size] - target)  # the critics come first
      finite = jnp.isfinite(norm)  # a non-finite gradient is counted and skipped
      carry = jax.tree.map(lambda n, o: jnp.where(finite, n, o), (new_params, new_target, new_opt_state), carry)
      parts = jnp.where(finite, jnp.append(parts, norm), 0.0)
      return carry, jnp.append(parts, 1.0 - finite)

    (flat, flat_target, opt_state), parts = jax.lax.scan(update, (flat, flat_target, opt_state), (batches, noise))
    return (unravel(flat), unravel_target(flat_target), opt_state), parts.mean(axis=0)


def sac_loss(
  params: SoftActorCriticParams,
  target_q: object,
  batch: Transition,
  noise: jax.Array,
  networks: SoftActorCritic,
  config: SACConfig,
) -> tuple[jax.Array, jax.Array]:
  """Critic, actor and temperature loss (Haarnoja et al., 2018b, equations 5, 9 and 18) at once, equal to Brax's.

  Each holds the others' parameters fixed, so the gradient of their sum is each one's own. One draw of the actor serves
  both its own loss and the temperature's.

  Args:
    params: of critics, actor and temperature.
    target_q: the target critics' parameters.
    batch: normalised transitions.
    noise: standard normal draws for the actions on `obs` and on `next_obs`, [2, B, action_size].
    networks: the networks the parameters belong to.
    config: `discounting`, `reward_scaling`.

  Returns:
    The sum of the losses, and its parts in the order of `PARTS`.
  """
  fixed = jax.lax.stop_gradient
  alpha, target_entropy = jnp.exp(params.log_alpha), -0.5 * networks.action_size

  both = jax.tree.map(lambda *x: jnp.stack(x), batch.obs, batch.next_obs)
  logits = networks.logits(params.policy, both)
  normal = networks.distribution.create_dist(logits)
  raw_action = normal.loc + normal.scale * noise
  action, next_action = networks.distribution.postprocess(raw_action)
  log_prob, next_log_prob = networks.distribution.log_prob(logits, raw_action)

  # The critics on the action taken, the target critics on the next one, and the critics on what the actor would do.
  q, next_q, actor_q = networks.q_each(
    (params.q, batch.obs, batch.action),
    (target_q, batch.next_obs, fixed(next_action)),
    (fixed(params.q), batch.obs, action),
  )

  next_value = next_q.min(axis=0) - alpha * next_log_prob
  target = fixed(batch.reward * config.reward_scaling + batch.discount * config.discounting * next_value)
  critic_loss = 0.5 * jnp.square((q - target) * (1 - batch.nonfinite)).mean()
  entropy = -log_prob.mean()
  actor_loss = -fixed(alpha) * entropy - actor_q.min(axis=0).mean()
  alpha_loss = alpha * fixed(entropy - target_entropy)
  parts = (critic_loss, actor_loss, alpha_loss, alpha, entropy)
  return critic_loss + actor_loss + alpha_loss, jnp.stack(parts)
