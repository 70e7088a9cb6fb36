"""Soft Actor-Critic (Haarnoja et al., 2018b) on batched environments, over a mesh of devices.

Names and meaning of the hyperparameters are Brax's (paper, Appendix E). The losses equal Brax's on the same batch and
draws. One training step takes one step of every environment and then `grad_updates_per_step` gradient steps on
transitions drawn from the replay buffer.
"""

from typing import cast

import jax
import jax.numpy as jnp
import optax
from brax.training.acme import running_statistics
from flax import struct
from jax.flatten_util import ravel_pytree

from playground.envs.base import Env
from playground.errors import ConfigError
from playground.hardware.mesh import AXIS
from playground.learning.algorithm import Algorithm, AlgorithmState, Metrics, Policy
from playground.learning.hyperparameters import SACConfig
from playground.learning.networks import SoftActorCritic, SoftActorCriticParams, normalize
from playground.learning.replay import ReplayBuffer
from playground.learning.rollout import Environments
from playground.pytree import PyTree

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


class SACState(AlgorithmState):
  """A state (params: `SoftActorCriticParams`) with target critics."""

  target_q: PyTree = None


class SAC(Algorithm[SACConfig, SoftActorCritic, SACState]):
  """SAC for one task."""

  def __init__(self, env: Env, config: SACConfig, network_precision: str | None = None):
    if config.prefill_updates * config.num_envs * env.action_repeat >= config.num_timesteps:
      raise ConfigError(
        f"agent.num_timesteps={config.num_timesteps} is over before agent.min_replay_size={config.min_replay_size} "
        "transitions are collected, so nothing would be learned."
      )
    networks = SoftActorCritic(env.observation_size, env.action_size, config.network, network_precision)
    obs = {key: jax.ShapeDtypeStruct(size, jnp.float32) for key, size in networks.obs_sizes.items()}
    scalar, action = jax.ShapeDtypeStruct((), jnp.float32), jax.ShapeDtypeStruct((env.action_size,), jnp.float32)
    example = Transition(obs, obs, action, reward=scalar, discount=scalar, nonfinite=scalar)  # pyright: ignore
    buffer = ReplayBuffer(config.max_replay_size, config.num_envs, example, config.checkpoint_replay)
    super().__init__(config, networks, buffer)
    self.buffer, self.optimizer = buffer, optax.scale_by_adam()

  def init(self, key: jax.Array, policy: Policy | None) -> SACState:
    policy = policy or self.new_policy(key)
    return SACState(
      params=policy.params,
      opt_state=self.optimizer.init(ravel_pytree(policy.params)[0]),
      normalizer=policy.normalizer,
      replay=self.buffer.init(self.config.num_envs // jax.lax.axis_size(AXIS)),
      target_q=policy.params.q,
    )

  def train_step(self, state: SACState, envs: Environments, key: jax.Array) -> tuple[SACState, Environments, Metrics]:
    config, networks = self.config, self.networks
    act_key, replay_key, noise_key = jax.random.split(key, 3)
    assert state.replay is not None

    # Collect: one step of every environment.
    envs, transition = self._collect(state, envs, act_key)
    normalizer = state.normalizer
    if config.normalize_observations:
      normalizer = running_statistics.update(normalizer, transition.obs, pmap_axis_name=AXIS)
    replay = self.buffer.insert(state.replay, transition)

    # Learn, once there is enough to learn from: what all gradient steps need is drawn and normalised in one go.
    shape = (config.grad_updates_per_step, config.batch_size // jax.lax.axis_size(AXIS))
    batches = self.buffer.sample(replay, replay_key, shape)
    if config.normalize_observations:
      obs, next_obs = normalize(batches.obs, normalizer), normalize(batches.next_obs, normalizer)
      batches = batches.replace(obs=obs, next_obs=next_obs)
    noise = jax.random.normal(noise_key, (shape[0], 2, shape[1], networks.action_size))
    ready = state.replay.inserted >= config.prefill_updates
    start = (state.params, state.target_q, state.opt_state)
    idle = lambda start, *_: (start, jnp.zeros(len(PARTS) + 2))
    (params, target_q, opt_state), parts = jax.lax.cond(ready, self._learn, idle, start, batches, noise)

    names = (*PARTS, "grad_norm", "nonfinite_updates")
    metrics: Metrics = dict(zip(names, jax.lax.pmean(parts, AXIS), strict=True))
    metrics["learned"] = ready.astype(jnp.float32)
    metrics["gradient_steps"] = metrics["learned"] * config.grad_updates_per_step
    metrics["nonfinite_updates"] *= metrics["gradient_steps"]
    learned = {"params": params, "target_q": target_q, "opt_state": opt_state}
    return state.replace(**learned, normalizer=normalizer, replay=replay), envs, metrics

  def _collect(self, state: SACState, envs: Environments, key: jax.Array) -> tuple[Environments, Transition]:
    """Steps this device's environments once with sampled actions."""
    before = envs.state
    action = self.act(self.policy(state), before.obs, key, deterministic=False)
    envs, final_obs = envs.step(action)
    transition = Transition(
      obs=self.networks.select(before.obs),
      next_obs=self.networks.select(final_obs),
      action=action,
      reward=envs.state.reward,
      discount=1 - envs.state.done * (1 - envs.state.info["truncation"]),
      nonfinite=envs.state.info["nonfinite"],
    )
    return envs, transition

  def _learn(
    self, start: tuple[PyTree, PyTree, PyTree], batches: Transition, noise: jax.Array
  ) -> tuple[PyTree, jax.Array]:
    """Gradient steps, one for each batch. Parameters travel as one vector: a kernel for each array costs far more."""
    params, target_q, opt_state = start
    (flat, unravel), (flat_target, unravel_target) = ravel_pytree(params), ravel_pytree(target_q)
    config = self.config
    rates = (config.learning_rate, config.learning_rate, config.alpha_learning_rate)  # critics, actor, temperature
    rates = jax.tree.broadcast(SoftActorCriticParams(*rates), params)  # pyright: ignore[reportArgumentType]
    rates = ravel_pytree(jax.tree.map(jnp.full_like, params, rates))[0]

    def update(carry: tuple[PyTree, PyTree, PyTree], x: tuple[Transition, jax.Array]) -> tuple[PyTree, jax.Array]:
      """One gradient step for critics, actor and temperature, and one of the target critics after them."""
      params, target, opt_state = carry
      grads, parts = jax.grad(sac_loss, has_aux=True)(
        unravel(params), unravel_target(target), *x, self.networks, config
      )
      grads = jax.lax.pmean(ravel_pytree(grads)[0], AXIS)
      norm = jnp.linalg.norm(grads)
      step, new_opt_state = self.optimizer.update(grads, opt_state)
      new_params = params - rates * cast(jax.Array, step)
      new_target = target + config.tau * (new_params[: target.size] - target)  # the critics come first
      finite = jnp.isfinite(norm)  # a bad gradient is counted and left out
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
    params: what is learned.
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
  (action, next_action), (log_prob, next_log_prob) = networks.sample(logits, noise)

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
