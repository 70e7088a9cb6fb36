"""REINFORCE with a learned baseline (Sutton and Barto, 2018, section 13.4) on batched environments."""

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from playground.envs.base import Env
from playground.hardware.mesh import AXIS
from playground.learning.algorithm import Algorithm, AlgorithmState, Metrics, Policy, gradient_step
from playground.learning.networks import ActorCritic, ActorCriticParams, normalize, update_normalizer
from playground.learning.rollout import Environments, Transitions, unroll
from reinforce.config import ReinforceConfig


class Reinforce(Algorithm[ReinforceConfig, ActorCritic, AlgorithmState]):
  """One training step collects a trajectory of every environment and makes one gradient step on it."""

  def __init__(self, env: Env, config: ReinforceConfig, network_precision: str | None = None):
    super().__init__(config, ActorCritic(env.observation_size, env.action_size, config.network, network_precision))

  @property
  def optimizer(self) -> optax.GradientTransformation:
    return optax.adam(self.config.learning_rate)

  def init(self, key: jax.Array, policy: Policy | None) -> AlgorithmState:
    policy = policy or self.new_policy(key)
    opt_state = self.optimizer.init(ravel_pytree(policy.params)[0])
    return AlgorithmState(params=policy.params, opt_state=opt_state, normalizer=policy.normalizer)

  def train_step(
    self, state: AlgorithmState, envs: Environments, key: jax.Array
  ) -> tuple[AlgorithmState, Environments, Metrics]:
    normalizer = state.normalizer if self.config.normalize_observations else None
    envs, data = unroll(envs, self.networks, state.params.policy, normalizer, key, self.config.unroll_length)
    last_obs = normalize(self.networks.select(envs.state.obs), normalizer)
    obs = normalize(data.obs, normalizer)

    flat, unravel = ravel_pytree(state.params)
    grads, losses = jax.grad(self._loss, has_aux=True)(unravel(flat), data.replace(obs=obs), last_obs)
    flat, opt_state, norm, finite = gradient_step(self.optimizer, grads, flat, state.opt_state)
    if normalizer is not None:
      normalizer = update_normalizer(normalizer, self.networks.vectors(data.obs))

    metrics = {name: jnp.where(finite, value, 0.0) for name, value in jax.lax.pmean(losses, AXIS).items()}
    metrics |= {"grad_norm": jnp.where(finite, norm, 0.0), "gradient_steps": jnp.ones(())}
    metrics["nonfinite_updates"] = 1.0 - finite
    after = state.replace(params=unravel(flat), opt_state=opt_state, normalizer=normalizer or state.normalizer)
    return after, envs, metrics

  def _loss(
    self, params: ActorCriticParams, data: Transitions, last_obs: dict[str, jax.Array]
  ) -> tuple[jax.Array, Metrics]:
    """Minus the log-probability of each action times its return above the baseline, and the baseline's error."""
    values = self.networks.value(params.value, data.obs)
    final_value = jax.lax.stop_gradient(self.networks.value(params.value, last_obs))
    returns = jax.lax.stop_gradient(self._returns(data, values, final_value))
    log_prob = self.networks.distribution.log_prob(self.networks.logits(params.policy, data.obs), data.raw_action)
    policy_loss = -(log_prob * jax.lax.stop_gradient(returns - values)).mean()
    value_loss = 0.5 * jnp.square(returns - values).mean()
    return policy_loss + value_loss, {"policy_loss": policy_loss, "value_loss": value_loss}

  def _returns(self, data: Transitions, values: jax.Array, final_value: jax.Array) -> jax.Array:
    """Discounted returns, [T, N]; where time or the trajectory cuts an episode, the baseline stands for the rest."""

    def step(following: jax.Array, x: tuple[Transitions, jax.Array]) -> tuple[jax.Array, jax.Array]:
      now, value = x
      total = now.reward + self.config.discounting * (1 - now.termination) * following
      total = jnp.where(now.truncation > 0, value, total)
      return total, total

    return jax.lax.scan(step, final_value, (data, values), reverse=True)[1]
