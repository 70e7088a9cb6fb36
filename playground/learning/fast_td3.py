"""FastTD3 (arXiv 2505.22642) on batched environments: off-policy, a deterministic actor, large batches.

Twin critics give distributions over returns (C51), fitted to the projected distribution of the critic with the smaller
value. Environments explore with different amounts of noise. One training step is one step of all environments and
`grad_updates_per_step` gradient steps.

Differences from the published code: actions are clipped before they are stored; observation statistics count each
observation once, when it is collected, and nothing is added to their standard deviation, which there is 0.01 larger;
environments change their amount of noise every `episode_length` steps together rather than at each one's end, so that
it follows from the step alone; weights are LeCun-uniform and biases 0 at first.
"""

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.flatten_util import ravel_pytree

from playground.envs.base import Env, Observation
from playground.hardware.mesh import AXIS
from playground.learning.algorithm import Policy, gradient_step
from playground.learning.c51 import C51Networks, c51_loss, updates_actor
from playground.learning.hyperparameters import FastTD3Config
from playground.learning.off_policy import Learned, OffPolicy, OffPolicyState, Transition
from playground.pytree import PyTree


class FastTD3Params(struct.PyTreeNode):
  """The learned parameters: of the actor, and of the twin critics, each array [2, ...]."""

  policy: PyTree
  q: PyTree


class FastTD3Networks(C51Networks):
  """A deterministic actor and two distributional critics."""

  def __init__(self, env: Env, config: FastTD3Config, precision: str | None):
    """Builds the networks; see `C51Networks` for the errors."""
    super().__init__(env, config, precision, "fast_td3")

  def init(self, key: jax.Array) -> FastTD3Params:
    policy, q = jax.random.split(key)
    return FastTD3Params(self.init_policy(policy), self.init_q(q))

  def mode(self, policy: PyTree, obs: dict[str, jax.Array]) -> jax.Array:
    """Returns actions in [-1, 1], [..., action_size], for normalised observations."""
    return self.distribution.mode(self.logits(policy, obs))


class FastTD3(OffPolicy[FastTD3Config, FastTD3Networks]):
  """FastTD3 for one task."""

  samples = False
  logged = ("critic_loss", "policy_loss", "q_mean", "targets_at_edge", "critic_grad_norm", "grad_norm")

  def __init__(self, env: Env, config: FastTD3Config, network_precision: str | None = None):
    super().__init__(env, config, FastTD3Networks(env, config, network_precision))
    self._noise_for = -(-env.episode_length // env.action_repeat)  # policy steps

  @property
  def optimizer(self) -> optax.GradientTransformation:
    return optax.adamw(self.config.learning_rate, weight_decay=self.config.weight_decay)

  def init_optimizer(self, params: FastTD3Params) -> PyTree:
    return tuple(self.optimizer.init(ravel_pytree(part)[0]) for part in (params.policy, params.q))

  def act(self, policy: Policy, obs: Observation, key: jax.Array, deterministic: bool | None = None) -> jax.Array:
    """Returns actions in [-1, 1], [..., action_size]: the actor's own, without exploration."""
    return super().act(policy, obs, key, deterministic=True)

  def explore(self, state: OffPolicyState, obs: Observation, key: jax.Array) -> jax.Array:
    """Returns the actor's actions with noise, within [-1, 1]."""
    assert state.replay is not None
    action = self.act(self.policy(state), obs, key)
    levels = self._noise_levels(state.replay.inserted, len(action))
    return jnp.clip(action + levels[:, None] * jax.random.normal(key, action.shape), -1, 1)

  def _noise_levels(self, step: jax.Array, count: int) -> jax.Array:
    """Returns the noise std of this device's environments, [count], which changes after each length of an episode.

    It follows from the step alone, so it is the same with every seed.
    """
    key = jax.random.fold_in(jax.random.PRNGKey(0), step // self._noise_for)
    key = jax.random.fold_in(key, jax.lax.axis_index(AXIS))
    return jax.random.uniform(key, (count,), minval=self.config.min_noise, maxval=self.config.max_noise)

  def learn(self, start: Learned, batches: Transition, key: jax.Array, step: jax.Array) -> tuple[Learned, jax.Array]:
    """Makes gradient steps, one for each batch: of the critics, at times of the actor, then of the target critics."""
    config, networks, optimizer = self.config, self.networks, self.optimizer
    params, target_q, opt_state = start
    (actor, unravel_actor), (critic, unravel_critic) = ravel_pytree(params.policy), ravel_pytree(params.q)
    count = config.grad_updates_per_step

    def update(carry: PyTree, x: tuple[Transition, jax.Array, jax.Array]) -> tuple[PyTree, jax.Array]:
      actor, critic, target, (actor_opt, critic_opt) = carry
      batch, key, i = x
      policy = unravel_actor(actor)
      grads, (loss, mean, edge) = jax.grad(critic_loss, has_aux=True)(
        unravel_critic(critic), unravel_critic(target), policy, batch, key, networks, config
      )
      critic, critic_opt, critic_norm, good = gradient_step(optimizer, grads, critic, critic_opt)

      def move(actor: jax.Array, actor_opt: PyTree) -> PyTree:
        loss_and_grad = jax.value_and_grad(policy_loss)
        loss, grads = loss_and_grad(unravel_actor(actor), unravel_critic(critic), batch, networks, config)
        return *gradient_step(optimizer, grads, actor, actor_opt), loss

      stay = lambda actor, actor_opt: (actor, actor_opt, jnp.zeros(()), jnp.array(True), jnp.zeros(()))
      turn = updates_actor(config, i, step)
      actor, actor_opt, norm, good_too, actor_loss = jax.lax.cond(turn, move, stay, actor, actor_opt)
      target += config.tau * (critic - target)
      finite = good & good_too
      # The actor's values are 0 where it stays: n times those of every n-th update have the right mean.
      n = config.policy_frequency
      log = jnp.where(finite, jnp.stack([loss, n * actor_loss, mean, edge, critic_norm, n * norm]), 0.0)
      return (actor, critic, target, (actor_opt, critic_opt)), jnp.append(log, 1.0 - finite)

    carry = (actor, critic, ravel_pytree(target_q)[0], opt_state)
    carry, log = jax.lax.scan(update, carry, (batches, jax.random.split(key, count), jnp.arange(count)))
    actor, critic, target, opt_state = carry
    learned = FastTD3Params(unravel_actor(actor), unravel_critic(critic))
    return (learned, unravel_critic(target), opt_state), log.mean(axis=0)


def critic_loss(
  params: PyTree,
  target_params: PyTree,
  policy: PyTree,
  batch: Transition,
  key: jax.Array,
  networks: FastTD3Networks,
  config: FastTD3Config,
) -> tuple[jax.Array, tuple[jax.Array, jax.Array, jax.Array]]:
  """`c51_loss` with noise on the next actions.

  Args:
    params: the critics'.
    target_params: the target critics'.
    policy: the actor's.
    batch: B normalised transitions.
    key: for the noise.
    networks: the networks the parameters belong to.
    config: `discounting`, `reward_scaling`, `policy_noise`, `noise_clip`, `use_smaller_q`.

  Returns:
    See `c51_loss`.
  """
  noise = config.policy_noise * jax.random.normal(key, batch.action.shape)
  next_action = networks.mode(policy, batch.next_obs) + jnp.clip(noise, -config.noise_clip, config.noise_clip)
  next_action = jnp.clip(next_action, -1, 1)
  return c51_loss(params, target_params, batch, next_action, 0.0, config.use_smaller_q, networks, config)


def policy_loss(
  policy: PyTree, q_params: PyTree, batch: Transition, networks: FastTD3Networks, config: FastTD3Config
) -> jax.Array:
  """Minus the mean value of the actor's actions, by the smaller critic or by both."""
  logits = networks.q(q_params, batch.obs, networks.mode(policy, batch.obs))
  values = networks.atoms.mean(jax.nn.softmax(logits))
  return -(values.min(axis=0) if config.use_smaller_q else values.mean(axis=0)).mean()
