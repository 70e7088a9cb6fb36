"""FastSAC (arXiv 2512.01996) on batched environments: off-policy, a stochastic actor, large batches.

Twin critics give distributions over soft returns (C51), each fitted to the projected distribution of its own target
critic. The actor is a squashed Gaussian that starts at a mean of 0 and a small std; its samples explore. The
temperature is tuned so that the policy keeps an entropy. One training step is one step of all environments and
`grad_updates_per_step` gradient steps.

The entropy target is in our units, where actions are in [-1, 1]: by default -0.48 nats an action, which is a Gaussian
with a standard deviation of 0.15 (FlashSAC's rule, arXiv 2604.04539). The published target is 0 nats in units of 0.25
rad: -0.69 an action where ±1 is half a radian, and -1.9 where, as there, it reaches the joint limits.

Differences from the published code: hidden layers are normalised after their activation, not before; log-probabilities
are exact; the temperature's logarithm does not decay; observation statistics count each observation once, when it is
collected, and nothing is added to their standard deviation, which there is 0.01 larger; weights are LeCun-uniform and
biases 0 at first; transitions are mirrored only with `mirror_augmentation`.
"""

import jax
import jax.numpy as jnp
import optax
from brax.training.distribution import NormalTanhDistribution
from flax import struct
from jax.flatten_util import ravel_pytree

from playground.envs.base import Env
from playground.learning.algorithm import gradient_step
from playground.learning.c51 import C51Networks, c51_loss, updates_actor
from playground.learning.hyperparameters import FastSACConfig
from playground.learning.off_policy import Learned, OffPolicy, Transition
from playground.pytree import PyTree

_BETA_2 = 0.95  # of AdamW


class FastSACParams(struct.PyTreeNode):
  """The learned parameters.

  Attributes:
    policy: parameters of the actor.
    q: of the twin critics, each array [2, ...].
    log_alpha: logarithm of the temperature, [].
  """

  policy: PyTree
  q: PyTree
  log_alpha: jax.Array


class BoundedNormalTanh(NormalTanhDistribution):
  """A Gaussian, then tanh; a tanh also bounds the logarithm of the Gaussian's standard deviation."""

  def __init__(self, event_size: int, min_log_std: float, max_log_std: float):
    super().__init__(event_size)
    self._low, self._high = min_log_std, max_log_std

  def create_dist(self, parameters: jax.Array) -> PyTree:
    normal = super().create_dist(parameters)
    share = 0.5 * (jnp.tanh(jnp.split(parameters, 2, axis=-1)[1]) + 1)
    normal.scale = jnp.exp(self._low + share * (self._high - self._low))
    return normal


class FastSACNetworks(C51Networks):
  """A squashed Gaussian actor and two distributional critics."""

  def __init__(self, env: Env, config: FastSACConfig, precision: str | None):
    """Builds the networks; see `C51Networks` for the errors."""
    super().__init__(env, config, precision, "fast_sac")
    network = config.network
    self.distribution = BoundedNormalTanh(env.action_size, network.min_log_std, network.max_log_std)
    self._initial_temperature = config.initial_temperature

  def init(self, key: jax.Array) -> FastSACParams:
    policy, q = jax.random.split(key)
    log_alpha = jnp.log(jnp.float32(self._initial_temperature))
    return FastSACParams(self.init_policy(policy), self.init_q(q), log_alpha)


class FastSAC(OffPolicy[FastSACConfig, FastSACNetworks]):
  """FastSAC for one task."""

  logged = (
    *("critic_loss", "policy_loss", "q_mean", "targets_at_edge", "entropy", "alpha"),
    *("critic_grad_norm", "grad_norm"),
  )

  def __init__(self, env: Env, config: FastSACConfig, network_precision: str | None = None):
    super().__init__(env, config, FastSACNetworks(env, config, network_precision))

  @property
  def optimizer(self) -> optax.GradientTransformation:
    """Of the actor and of the critics."""
    return optax.adamw(self.config.learning_rate, b2=_BETA_2, weight_decay=self.config.weight_decay)

  @property
  def alpha_optimizer(self) -> optax.GradientTransformation:
    return optax.adam(self.config.alpha_learning_rate, b2=_BETA_2)

  def init_optimizer(self, params: FastSACParams) -> PyTree:
    actor, critic, alpha = (ravel_pytree(part)[0] for part in (params.policy, params.q, params.log_alpha))
    return self.optimizer.init(actor), self.optimizer.init(critic), self.alpha_optimizer.init(alpha)

  def learn(self, start: Learned, batches: Transition, key: jax.Array, step: jax.Array) -> tuple[Learned, jax.Array]:
    """Makes gradient steps, one for each batch.

    Each updates the critics, the temperature, every `policy_frequency`-th time the actor, then the target critics.
    """
    config, networks, optimizer = self.config, self.networks, self.optimizer
    params, target_q, opt_state = start
    (actor, unravel_actor), (critic, unravel_critic) = ravel_pytree(params.policy), ravel_pytree(params.q)
    count = config.grad_updates_per_step

    def update(carry: PyTree, x: tuple[Transition, jax.Array, jax.Array]) -> tuple[PyTree, jax.Array]:
      actor, critic, log_alpha, target, (actor_opt, critic_opt, alpha_opt) = carry
      batch, key, i = x
      next_key, actor_key = jax.random.split(key)

      next_action, next_log_prob = networks.sample(networks.logits(unravel_actor(actor), batch.next_obs), next_key)
      bonus = -jnp.exp(log_alpha[0]) * next_log_prob
      grads, (loss, mean, edge) = jax.grad(c51_loss, has_aux=True)(  # each critic from its own target, no minimum
        *(unravel_critic(critic), unravel_critic(target), batch, next_action, bonus, False, networks, config),
      )
      critic, critic_opt, critic_norm, good = gradient_step(optimizer, grads, critic, critic_opt)

      target_entropy = config.target_entropy * networks.action_size
      grads = jax.grad(alpha_loss)(log_alpha, next_log_prob, target_entropy)
      log_alpha, alpha_opt, _, good_alpha = gradient_step(self.alpha_optimizer, grads, log_alpha, alpha_opt)
      alpha = jnp.exp(log_alpha[0])

      def move(actor: jax.Array, actor_opt: PyTree) -> PyTree:
        loss_and_grad = jax.value_and_grad(policy_loss)
        loss, grads = loss_and_grad(unravel_actor(actor), unravel_critic(critic), alpha, batch, actor_key, networks)
        return *gradient_step(optimizer, grads, actor, actor_opt), loss

      stay = lambda actor, actor_opt: (actor, actor_opt, jnp.zeros(()), jnp.array(True), jnp.zeros(()))
      turn = updates_actor(config, i, step)
      actor, actor_opt, norm, good_actor, actor_loss = jax.lax.cond(turn, move, stay, actor, actor_opt)
      target += config.tau * (critic - target)
      finite = good & good_alpha & good_actor
      # The actor's values are 0 where it stays: n times those of every n-th update have the right mean.
      n = config.policy_frequency
      log = jnp.stack([loss, n * actor_loss, mean, edge, -next_log_prob.mean(), alpha, critic_norm, n * norm])
      carry = (actor, critic, log_alpha, target, (actor_opt, critic_opt, alpha_opt))
      return carry, jnp.append(jnp.where(finite, log, 0.0), 1.0 - finite)

    carry = (actor, critic, params.log_alpha[None], ravel_pytree(target_q)[0], opt_state)
    carry, log = jax.lax.scan(update, carry, (batches, jax.random.split(key, count), jnp.arange(count)))
    actor, critic, log_alpha, target, opt_state = carry
    learned = FastSACParams(unravel_actor(actor), unravel_critic(critic), log_alpha[0])
    return (learned, unravel_critic(target), opt_state), log.mean(axis=0)


def alpha_loss(log_alpha: jax.Array, log_prob: jax.Array, target_entropy: jax.Array | float) -> jax.Array:
  """Pulls the temperature up where the entropy is below its target, in nats, and down where it is above."""
  return -(jnp.exp(log_alpha) * (log_prob + target_entropy).mean()).sum()


def policy_loss(
  policy: PyTree, q_params: PyTree, alpha: jax.Array, batch: Transition, key: jax.Array, networks: FastSACNetworks
) -> jax.Array:
  """Mean of the temperature times the log-probability of a sampled action, minus its value by both critics."""
  action, log_prob = networks.sample(networks.logits(policy, batch.obs), key)
  values = networks.atoms.mean(jax.nn.softmax(networks.q(q_params, batch.obs, action)))
  return (alpha * log_prob - values.mean(axis=0)).mean()
