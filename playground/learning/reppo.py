"""Relative Entropy Pathwise Policy Optimisation (REPPO, arXiv 2507.11019) on batched environments.

On-policy: a critic Q(s, a) is fitted to the λ-returns of the newest rollout alone, and the actor follows its gradient
with respect to the action. A bound on the policy's change, in KL divergence, keeps it where Q holds. There is no replay
buffer and no target network. One training step collects `unroll_length` steps of all environments and passes over them
`num_updates_per_batch` times.

Differences from the published code: the true last observation of an episode is the next one where time cuts it; the
entropy bonus of a next state ends with the episode; the divergence is the exact one of the Gaussians before squashing;
the critic's prior is a constant; nothing is added to the variance of an observation. The actor is Brax's: layer
normalisation follows the activation instead of a normalisation before it, the standard deviation is softplus(s) + 0.1
instead of exp(s) + 0.1, and the weights are LeCun-uniform.
"""

import jax
import jax.numpy as jnp
import optax
from brax.training.distribution import NormalTanhDistribution
from flax import linen, struct
from jax.flatten_util import ravel_pytree

from playground.envs.base import Env
from playground.hardware.mesh import AXIS
from playground.learning.algorithm import Algorithm, AlgorithmState, Metrics, Policy, gradient_step
from playground.learning.hyperparameters import REPPOConfig
from playground.learning.networks import Actor, Normalizer, normalize, refuse_images, update_normalizer
from playground.learning.rollout import Environments
from playground.pytree import PyTree

CRITIC_LOSSES = ("critic_loss", "q_loss", "auxiliary_loss", "q_mean", "targets_outside")  # what is logged
ACTOR_LOSSES = ("policy_loss", "entropy", "kl", "kl_above_bound", "alpha", "kl_multiplier")
_PRIOR = 40.0  # of the logits of value 0
_LARGEST = 0.999  # of an action: log-probabilities of ±1 are infinite
_UNROLL = 16  # steps of a λ-return that are one kernel


class REPPOParams(struct.PyTreeNode):
  """The learned parameters.

  Attributes:
    policy: parameters of the actor.
    q: of the critic.
    log_alpha: logarithm of the temperature, [].
    log_beta: logarithm of the multiplier of the divergence, [].
  """

  policy: PyTree
  q: PyTree
  log_alpha: jax.Array
  log_beta: jax.Array


class Transition(struct.PyTreeNode):
  """Steps of N environments, each [T, N, ...]: `next_obs` is before the auto-reset, `valid` is 0 for a non-finite step.

  `target` is of the critic, `next_embedding` of its auxiliary head; both are None before they are computed.
  """

  obs: dict[str, jax.Array]
  next_obs: dict[str, jax.Array]
  action: jax.Array
  reward: jax.Array
  done: jax.Array
  truncation: jax.Array
  valid: jax.Array
  target: jax.Array | None = None
  next_embedding: jax.Array | None = None


class Block(linen.Module):
  """A dense layer, normalised, then swish."""

  size: int

  @linen.compact
  def __call__(self, x: jax.Array) -> jax.Array:
    return linen.swish(linen.RMSNorm()(linen.Dense(self.size)(x)))


class Critic(linen.Module):
  """A distribution over values of (observation, action), and a prediction of the next reward and embedding."""

  hidden_size: int
  prior: tuple[float, ...]

  @linen.compact
  def __call__(self, obs: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Returns logits of the bins [..., K], the embedding [..., H] and the prediction [..., H + 1], reward first."""
    hidden = Block(self.hidden_size)(jnp.concatenate([obs, action], axis=-1))
    embedding = linen.Dense(self.hidden_size)(hidden)
    features = linen.swish(embedding)
    logits = linen.Dense(len(self.prior))(Block(self.hidden_size)(features)) + jnp.asarray(self.prior)
    prediction = linen.Dense(self.hidden_size + 1)(Block(self.hidden_size)(features))
    return logits, embedding, prediction


class HLGauss:
  """Values as distributions over bins: a Gaussian histogram (Imani and White, 2018; Farebrother et al., 2024)."""

  def __init__(self, low: float, high: float, bins: int):
    """`bins` bins with centres from `low` to `high`; the Gaussian's standard deviation is 0.75 of a bin."""
    width = (high - low) / (bins - 1)
    self.low, self.high, self.std = low, high, 0.75 * width
    self.centres = jnp.linspace(low, high, bins)
    self.edges = jnp.linspace(low - width / 2, high + width / 2, bins + 1)

  def encode(self, value: jax.Array) -> jax.Array:
    """Returns probabilities of the bins, [..., K], for values [...]; those outside are moved to the nearest edge."""
    value = jnp.clip(value, self.low, self.high)[..., None]
    below = jax.scipy.special.erf((self.edges - value) / (jnp.sqrt(2.0) * self.std))
    return jnp.diff(below) / (below[..., -1:] - below[..., :1])

  def decode(self, logits: jax.Array) -> jax.Array:
    """Returns mean values, [...], of distributions with these logits, [..., K]."""
    return (jax.nn.softmax(logits) * self.centres).sum(axis=-1)


class REPPONetworks(Actor):
  """An actor and a distributional critic of actions."""

  def __init__(self, env: Env, config: REPPOConfig, precision: str | None):
    """Builds the networks.

    Raises:
      ConfigError: a task with images, an unknown activation, or an observation group that the task does not have.
    """
    sizes = env.observation_size
    refuse_images(sizes, "reppo")
    network = config.network
    super().__init__(sizes, env.action_size, network.hidden_layer_sizes, network, precision, layer_norm=True)
    self.distribution = NormalTanhDistribution(env.action_size, min_std=network.min_std)
    self.bins = HLGauss(config.min_value, config.max_value, config.num_bins)
    prior = _PRIOR * self.bins.encode(jnp.zeros(()))
    self._critic = Critic(network.q_hidden_layer_size, tuple(prior.tolist()))
    self._start = (config.initial_temperature, config.initial_kl_multiplier)

  def init(self, key: jax.Array) -> REPPOParams:
    policy, q = jax.random.split(key)
    obs = jnp.zeros((1, *self.obs_sizes[self.value_obs_key]))
    alpha, beta = (jnp.log(jnp.float32(x)) for x in self._start)
    action = jnp.zeros((1, self.action_size))
    return REPPOParams(self.policy_network.init(policy), self._critic.init(q, obs, action), alpha, beta)

  def q(self, q_params: PyTree, obs: dict[str, jax.Array], action: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """See `Critic`, for normalised observations."""
    with self.at_precision():
      return self._critic.apply(q_params, obs[self.value_obs_key], action)  # pyright: ignore[reportReturnType]


class REPPO(Algorithm[REPPOConfig, REPPONetworks, AlgorithmState]):
  """REPPO for one task."""

  def __init__(self, env: Env, config: REPPOConfig, network_precision: str | None = None):
    super().__init__(config, REPPONetworks(env, config, network_precision))

  @property
  def optimizer(self) -> optax.GradientTransformation:
    return optax.chain(optax.clip_by_global_norm(self.config.max_grad_norm), optax.adam(self.config.learning_rate))

  def init(self, key: jax.Array, policy: Policy | None) -> AlgorithmState:
    policy = policy or self.new_policy(key)
    opt_state = tuple(self.optimizer.init(ravel_pytree(part)[0]) for part in _split(policy.params))
    return AlgorithmState(params=policy.params, opt_state=opt_state, normalizer=policy.normalizer)

  def train_step(
    self, state: AlgorithmState, envs: Environments, key: jax.Array
  ) -> tuple[AlgorithmState, Environments, Metrics]:
    config, networks = self.config, self.networks
    rollout_key, target_key, update_key = jax.random.split(key, 3)
    normalizer: Normalizer | None = state.normalizer if config.normalize_observations else None

    # Collect with the stochastic policy.
    def step(envs: Environments, key: jax.Array) -> tuple[Environments, Transition]:
      obs = networks.select(envs.state.obs)
      action, _ = networks.sample(networks.logits(state.params.policy, normalize(obs, normalizer)), key)
      action = jnp.clip(action, -_LARGEST, _LARGEST)
      envs, final_obs = envs.step(action)
      after = envs.state
      next_obs, valid = networks.select(final_obs), 1 - after.info["nonfinite"]
      return envs, Transition(obs, next_obs, action, after.reward, after.done, after.info["truncation"], valid)

    envs, data = envs.scan(step, jax.random.split(rollout_key, config.unroll_length))
    statistics = state.normalizer
    if config.normalize_observations:
      statistics = update_normalizer(statistics, data.obs)
    data = data.replace(obs=normalize(data.obs, normalizer), next_obs=normalize(data.next_obs, normalizer))

    # Targets of the critic, with the parameters before the update.
    next_action, next_log_prob = networks.sample(networks.logits(state.params.policy, data.next_obs), target_key)
    logits, next_embedding, _ = networks.q(state.params.q, data.next_obs, next_action)
    termination = data.done * (1 - data.truncation)
    bonus = -config.discounting * jnp.exp(state.params.log_alpha) * next_log_prob * (1 - termination)
    reward = config.reward_scaling * data.reward + bonus
    target = lambda_returns(
      reward, networks.bins.decode(logits), data.done, data.truncation, config.discounting, config.gae_lambda
    )
    data = data.replace(target=target, next_embedding=next_embedding)

    # Learn: each epoch passes over its own shuffle of all transitions.
    data = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), data)
    old_logits = networks.logits(state.params.policy, data.obs)
    (actor, unravel_actor), (critic, unravel_critic) = (ravel_pytree(part) for part in _split(state.params))

    def update(carry: PyTree, x: tuple[jax.Array, jax.Array]) -> tuple[PyTree, jax.Array]:
      """Makes a gradient step of the critic, then one of the actor on the new critic."""
      (actor, critic), (actor_opt, critic_opt) = carry
      rows, key = x
      batch = jax.tree.map(lambda x: x[rows], data)
      grads, critic_log = jax.grad(critic_loss, has_aux=True)(unravel_critic(critic), batch, networks, config)
      critic, critic_opt, critic_norm, good = gradient_step(self.optimizer, grads, critic, critic_opt)
      loss = jax.grad(actor_loss, has_aux=True)
      grads, actor_log = loss(
        unravel_actor(actor), unravel_critic(critic), batch, old_logits[rows], key, networks, config
      )
      actor, actor_opt, norm, good_too = gradient_step(self.optimizer, grads, actor, actor_opt)
      finite = good & good_too
      log = jnp.concatenate([critic_log, actor_log, jnp.stack([critic_norm, norm])])
      log = jnp.append(jnp.where(finite, log, 0.0), 1.0 - finite)
      return ((actor, critic), (actor_opt, critic_opt)), log

    def epoch(carry: PyTree, key: jax.Array) -> tuple[PyTree, jax.Array]:
      shuffle_key, loss_key = jax.random.split(key)
      rows = jax.random.permutation(shuffle_key, data.reward.shape[0]).reshape(config.num_minibatches, -1)
      return jax.lax.scan(update, carry, (rows, jax.random.split(loss_key, config.num_minibatches)))

    start = ((actor, critic), state.opt_state)
    epochs = jax.random.split(update_key, config.num_updates_per_batch)
    ((actor, critic), opt_state), log = jax.lax.scan(epoch, start, epochs)

    names = (*CRITIC_LOSSES, *ACTOR_LOSSES, "critic_grad_norm", "grad_norm", "nonfinite_updates")
    metrics: Metrics = dict(zip(names, jax.lax.pmean(log.mean((0, 1)), AXIS), strict=True))
    metrics["gradient_steps"] = jnp.float32(config.num_updates_per_batch * config.num_minibatches)
    metrics["nonfinite_updates"] *= metrics["gradient_steps"]
    (policy, log_alpha, log_beta), q = unravel_actor(actor), unravel_critic(critic)
    params = REPPOParams(policy, q, log_alpha, log_beta)
    return state.replace(params=params, opt_state=opt_state, normalizer=statistics), envs, metrics


def _split(params: REPPOParams) -> tuple[tuple[PyTree, jax.Array, jax.Array], PyTree]:
  """Returns the parameters of the actor's optimiser, and of the critic's."""
  return (params.policy, params.log_alpha, params.log_beta), params.q


def lambda_returns(
  reward: jax.Array, next_value: jax.Array, done: jax.Array, truncation: jax.Array, discounting: float, decay: float
) -> jax.Array:
  """Returns λ-returns, [T, N].

  Args:
    reward: with the entropy bonus, [T, N].
    next_value: of the state after each step, an episode's last one where it ended, [T, N].
    done: 1 where an episode ended, [T, N].
    truncation: 1 where time cut it, [T, N].
    discounting: of a step.
    decay: λ.
  """

  def step(later: jax.Array, x: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
    reward, value, done, truncation = x
    ahead = jnp.where(truncation > 0, value, (1 - done) * (decay * later + (1 - decay) * value))
    now = reward + discounting * ahead
    return now, now

  steps = (reward, next_value, done, truncation)
  return jax.lax.scan(step, next_value[-1], steps, reverse=True, unroll=_UNROLL)[1]


def critic_loss(
  params: PyTree, batch: Transition, networks: REPPONetworks, config: REPPOConfig
) -> tuple[jax.Array, jax.Array]:
  """Cross-entropy to the targets' histograms, plus the squared error of the predicted reward and embedding.

  Args:
    params: the critic's.
    batch: B transitions with targets.
    networks: the networks the parameters belong to.
    config: `auxiliary_coefficient`.

  Returns:
    The loss, and `CRITIC_LOSSES`.
  """
  assert batch.target is not None
  assert batch.next_embedding is not None
  logits, _, prediction = networks.q(params, batch.obs, batch.action)
  bins = networks.bins
  cross_entropy = -(bins.encode(batch.target) * jax.nn.log_softmax(logits)).sum(axis=-1)
  following = jnp.concatenate([batch.reward[..., None], batch.next_embedding], axis=-1)
  error = jnp.square(prediction - following).mean(axis=-1) * (1 - batch.done)
  q_loss, auxiliary = (batch.valid * cross_entropy).mean(), (batch.valid * error).mean()
  loss = q_loss + config.auxiliary_coefficient * auxiliary
  outside = ((batch.target < bins.low) | (batch.target > bins.high)).mean()
  return loss, jnp.stack([loss, q_loss, auxiliary, bins.decode(logits).mean(), outside])


def actor_loss(
  params: tuple[PyTree, jax.Array, jax.Array],
  q_params: PyTree,
  batch: Transition,
  old_logits: jax.Array,
  key: jax.Array,
  networks: REPPONetworks,
  config: REPPOConfig,
) -> tuple[jax.Array, jax.Array]:
  """Soft value of the policy's actions, or its divergence where that is too large, plus losses of the multipliers.

  Args:
    params: the actor's, the logarithms of temperature and multiplier.
    q_params: the critic's, held fixed.
    batch: B transitions.
    old_logits: of the policy that collected, [B, 2 * action_size].
    key: for the actions.
    networks: the networks the parameters belong to.
    config: `kl_bound`, `target_entropy`.

  Returns:
    The loss, and `ACTOR_LOSSES`.
  """
  fixed = jax.lax.stop_gradient
  policy, log_alpha, log_beta = params
  alpha, beta = jnp.exp(log_alpha), jnp.exp(log_beta)
  logits = networks.logits(policy, batch.obs)
  action, log_prob = networks.sample(logits, key)
  value = networks.bins.decode(networks.q(fixed(q_params), batch.obs, action)[0])
  kl = networks.kl(old_logits, logits)
  near = kl < config.kl_bound
  policy_loss = jnp.where(near, fixed(alpha) * log_prob - value, fixed(beta) * kl).mean()
  entropy = -log_prob.mean()
  temperature_loss = alpha * fixed(entropy - config.target_entropy * networks.action_size)
  multiplier_loss = -beta * fixed(kl.mean() - config.kl_bound)
  parts = jnp.stack([policy_loss, entropy, kl.mean(), 1.0 - near.mean(), alpha, beta])
  return policy_loss + temperature_loss + multiplier_loss, parts
