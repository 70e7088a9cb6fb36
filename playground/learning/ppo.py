"""Proximal Policy Optimisation (Schulman et al., 2017) on batched environments, over a mesh of devices.

Names, meaning and defaults of the hyperparameters are Brax's (paper, Appendix E). One training step collects
`batch_size * num_minibatches` trajectories of `unroll_length` steps and passes over them `num_updates_per_batch` times.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from brax.training.acme import running_statistics
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh

from playground.envs.base import Env, State
from playground.envs.wrappers import ModelFields
from playground.errors import ConfigError
from playground.hardware.mesh import AXIS
from playground.learning.cnn import random_shift
from playground.learning.hyperparameters import PPOConfig
from playground.learning.learner import SPEC, Learner, Metrics, TrainState
from playground.learning.losses import ESTIMATION, LOSSES, Batch, pay_time_outs, ppo_loss
from playground.learning.networks import ActorCritic, ActorCriticParams, Normalizer, normalize
from playground.learning.rollout import NonfiniteCapture, repeat_unroll, unroll


class PPO(Learner):
  """The algorithm for one task."""

  def __init__(self, env: Env, config: PPOConfig, mesh: Mesh, network_precision: str | None = None):
    """Args:
      env: the task.
      config: hyperparameters.
      mesh: devices, one axis named "data".
      network_precision: matrix-product precision of the networks.

    Raises:
      ConfigError: sizes that do not divide, or networks that do not fit the task.
    """
    config.check(mesh.size)
    networks = ActorCritic(env.observation_size, env.action_size, config.network, network_precision)
    if config.augment_pixels and not networks.pixel_sizes:
      raise ConfigError(
        f"agent.augment_pixels={config.augment_pixels} shifts pictures, and the task has none: set it to 0."
      )
    super().__init__(env, config, mesh, networks, config.steps_per_update * env.action_repeat, TrainState(**SPEC))
    clip = optax.clip_by_global_norm(config.max_grad_norm) if config.max_grad_norm else optax.identity()
    self.optimizer = optax.chain(clip, optax.adam(config.learning_rate))
    self.loss = partial(
      ppo_loss,
      networks=self.networks,
      clipping_epsilon=config.clipping_epsilon,
      clipping_epsilon_value=config.clipping_epsilon_value,
      entropy_cost=config.entropy_cost,
      discounting=config.discounting,
      gae_lambda=config.gae_lambda,
      reward_scaling=config.reward_scaling,
      normalize_advantage=config.normalize_advantage,
      vf_loss_coefficient=config.vf_loss_coefficient,
      estimation_coefficient=config.estimation_coefficient,
    )
    self.losses = (*LOSSES, ESTIMATION) if networks.estimated_obs_key else LOSSES

  def _init(self, key: jax.Array, model: ModelFields) -> TrainState:
    key, net_key, env_key = jax.random.split(key, 3)
    params: Any = self.networks.init(net_key)
    env_state = self._fresh(env_key, model)
    return TrainState(
      params=params,
      opt_state=self.optimizer.init(ravel_pytree(params)[0]),
      normalizer=self.networks.init_normalizer(),
      key=key,
      env_state=env_state,
      capture=NonfiniteCapture.empty(env_state, self.env.action_size, model),
    )

  def _fresh(self, key: jax.Array, model: ModelFields) -> State:
    state = super()._fresh(key, model)
    if not self.config.init_at_random_ep_len:
      return state
    key = jax.random.fold_in(jax.random.split(key)[0], jax.lax.axis_index(AXIS))
    steps = state.info["steps"]
    age = jax.random.randint(key, steps.shape, 0, self.env.episode_length).astype(steps.dtype)
    return state.replace(info=state.info | {"steps": age})

  def _training_step(self, state: TrainState, model: ModelFields) -> tuple[TrainState, Metrics]:
    config = self.config
    key, shared = jax.random.split(state.key)
    rollout_key, update_key = jax.random.split(jax.random.fold_in(shared, jax.lax.axis_index(AXIS)))

    # Collect: every environment gives the same number of trajectories.
    normalizer: Normalizer | None = state.normalizer if config.normalize_observations else None
    critic = state.params.value if config.bootstrap_on_timeout else None
    actor = (self.networks, state.params.policy, normalizer)
    one = lambda env_state, capture, key: unroll(
      self.env, env_state, capture, model, *actor, key, config.unroll_length, critic
    )
    keys = jax.random.split(rollout_key, config.batch_size * config.num_minibatches // config.num_envs)
    env_state, capture, data, last_obs, episodes = repeat_unroll(one, state.env_state, state.capture, keys)

    # Normalise once for all passes, with statistics that include this data.
    if config.normalize_observations and self.networks.obs_keys:
      normalizer = running_statistics.update(state.normalizer, self.networks.vectors(data.obs), pmap_axis_name=AXIS)
    obs, last_obs = normalize(data.obs, normalizer), normalize(self.networks.select(last_obs), normalizer)

    batch = Batch(obs, last_obs, data.raw_action, data.log_prob, data.reward, data.termination, data.truncation)
    if config.clipping_epsilon_value is not None:
      batch = batch.replace(value=self.networks.value(state.params.value, normalize(data.obs, state.normalizer)))
    if data.final_value is not None:
      batch = pay_time_outs(batch, data.final_value, config.discounting, config.reward_scaling)

    # Learn: several passes, each over its own shuffle of the trajectories. Parameters, Adam's moments and the log are a
    # vector each: of their forty arrays each would cost a kernel or two in every step.
    flat, unravel = ravel_pytree(state.params)

    def one_pass(carry: tuple[jax.Array, Any], key: jax.Array) -> tuple[Any, jax.Array]:
      shuffle_key, loss_key = jax.random.split(key)
      columns = jax.random.permutation(shuffle_key, batch.reward.shape[1]).reshape(config.num_minibatches, -1)
      keys = jax.random.split(loss_key, config.num_minibatches)
      return jax.lax.scan(partial(self._sgd_step, batch, unravel), carry, (columns, keys))

    passes = jax.random.split(update_key, config.num_updates_per_batch)
    (flat, opt_state), log = jax.lax.scan(one_pass, (flat, state.opt_state), passes)
    params = unravel(flat)

    names = (*self.losses, "grad_norm", "nonfinite_updates")
    means = dict(zip(names, jax.lax.pmean(log.mean((0, 1)), AXIS), strict=True))
    metrics = means | jax.lax.psum(episodes, AXIS)
    metrics["gradient_steps"] = jnp.float32(config.num_updates_per_batch * config.num_minibatches)
    metrics["nonfinite_updates"] *= metrics["gradient_steps"]
    metrics["learned"] = jnp.ones(())
    if vectors := jax.tree.leaves(self.networks.vectors(obs)):
      farthest = jnp.stack([jnp.abs(entry).max() for entry in vectors]).max()
      metrics["obs_farthest"] = jax.lax.pmax(farthest, AXIS)  # of any number from its mean, in standard deviations
    metrics["policy_std"] = jax.lax.pmean(self._mean_std(params, obs), AXIS)
    after = TrainState(
      params=params,
      opt_state=opt_state,
      normalizer=state.normalizer if normalizer is None else normalizer,
      key=key,
      env_state=env_state,
      capture=capture,
    )
    return after, metrics

  def _sgd_step(
    self,
    batch: Batch,
    unravel: Callable[[jax.Array], Any],
    carry: tuple[jax.Array, Any],
    x: tuple[jax.Array, jax.Array],
  ) -> tuple[Any, jax.Array]:
    """One gradient step on the trajectories in `columns`; returns its losses, the gradient's norm and if it was bad."""
    flat, opt_state = carry
    columns, key = x
    last_obs = jax.tree.map(lambda x: x[columns], batch.last_obs)
    minibatch = jax.tree.map(lambda x: x[:, columns], batch.replace(last_obs=None)).replace(last_obs=last_obs)
    if pad := self.config.augment_pixels:
      key, shift_key = jax.random.split(key)
      shifts = jax.random.randint(shift_key, (len(columns), 2), 0, 2 * pad + 1)
      shift = lambda obs: random_shift(obs, shifts, pad)
      minibatch = minibatch.replace(obs=shift(minibatch.obs), last_obs=shift(minibatch.last_obs))
    (_, parts), grads = jax.value_and_grad(self.loss, has_aux=True)(unravel(flat), minibatch, key)
    grads = jax.lax.pmean(ravel_pytree(grads)[0], AXIS)
    norm = jnp.linalg.norm(grads)
    updates, new_opt_state = self.optimizer.update(grads, opt_state, flat)
    finite = jnp.isfinite(norm)  # a bad gradient is counted and left out
    new = (optax.apply_updates(flat, updates), new_opt_state)
    carry = jax.tree.map(lambda n, o: jnp.where(finite, n, o), new, carry)
    log = jnp.stack([*(parts[name] for name in self.losses), norm])
    return carry, jnp.append(jnp.where(finite, log, 0.0), 1.0 - finite)

  def _mean_std(self, params: ActorCriticParams, obs: dict[str, jax.Array]) -> jax.Array:
    """Mean standard deviation of the actor, before squashing, on the first step of the data."""
    logits = self.networks.logits(params.policy, jax.tree.map(lambda x: x[0], obs))
    return self.networks.distribution.create_dist(logits).scale.mean()
