"""FastTD3 (arXiv 2505.22642) on batched environments: off-policy, a deterministic actor, large batches.

Twin critics give distributions over returns (C51), fitted to the projected distribution of the critic with the smaller
value. Environments explore with different amounts of noise. One training step is one step of all environments and
`grad_updates_per_step` gradient steps.

Differences from the published code: actions are clipped before they are stored; observation statistics count each
observation once, when it is collected; environments change their amount of noise every `episode_length` steps together
rather than at each one's end, so that it follows from the step alone; returns are of one step.
"""

import math

import jax
import jax.numpy as jnp
import optax
from brax.training import networks as brax_networks
from brax.training.acme import running_statistics
from flax import struct
from jax.flatten_util import ravel_pytree

from playground.envs.base import PIXELS, Env, Observation
from playground.errors import ConfigError
from playground.hardware.mesh import AXIS
from playground.learning.algorithm import Algorithm, AlgorithmState, Metrics, Policy, gradient_step
from playground.learning.hyperparameters import FastTD3Config
from playground.learning.networks import Actor, normalize
from playground.learning.replay import ReplayBuffer
from playground.learning.rollout import Environments
from playground.pytree import PyTree

PARTS = ("critic_loss", "policy_loss", "q_mean", "targets_at_edge", "critic_grad_norm", "grad_norm")  # what is logged


class FastTD3Params(struct.PyTreeNode):
  """What is learned: parameters of the actor, and of the twin critics, each array [2, ...]."""

  policy: PyTree
  q: PyTree


class FastTD3State(AlgorithmState):
  """Also the parameters of the target critics, each array [2, ...]."""

  target_q: PyTree = None


class Transition(struct.PyTreeNode):
  """Steps of N environments, each [N, ...].

  Attributes:
    obs: observation entries that actor or critics read.
    next_obs: the same after the step; where an episode ended, its last ones.
    action: in [-1, 1].
    reward: unscaled.
    bootstrap: 0 where the task ended the episode, else 1.
    valid: 0 for a step with a number that is not finite, else 1.
    done: 1 where an episode ended, by the task or by time; only with `num_steps` above 1, else None.
  """

  obs: dict[str, jax.Array]
  next_obs: dict[str, jax.Array]
  action: jax.Array
  reward: jax.Array
  bootstrap: jax.Array
  valid: jax.Array
  done: jax.Array | None = None


class Atoms:
  """Values as distributions over evenly spaced atoms (C51; Bellemare et al., 2017)."""

  def __init__(self, low: float, high: float, count: int):
    self.low, self.high, self.step = low, high, (high - low) / (count - 1)
    self.values = jnp.linspace(low, high, count)

  def mean(self, probabilities: jax.Array) -> jax.Array:
    """Mean values, [...], of distributions [..., K]."""
    return (probabilities * self.values).sum(axis=-1)

  def project(self, probabilities: jax.Array, reward: jax.Array, discount: jax.Array) -> jax.Array:
    """Distributions of `reward + discount * value`, [..., K], on the atoms; beyond them it is the nearest atom.

    Args:
      probabilities: of the values, [..., K].
      reward: [...].
      discount: of the values, 0 where there are none to come, [...].
    """
    moved = jnp.clip(reward[..., None] + discount[..., None] * self.values, self.low, self.high)
    place = (moved - self.low) / self.step  # in atoms, [..., K]
    # Each atom's share goes to its two neighbours. One after the other: [..., K, K] would be gigabytes.
    share = lambda atom: (probabilities * jax.nn.relu(1 - jnp.abs(place - atom))).sum(axis=-1)
    return jnp.moveaxis(jax.lax.map(share, jnp.arange(len(self.values), dtype=jnp.float32)), 0, -1)


class FastTD3Networks(Actor):
  """A deterministic actor and two distributional critics, whose layers are one batched product each."""

  def __init__(self, env: Env, config: FastTD3Config, precision: str | None):
    """Builds the networks.

    Raises:
      ConfigError: a task with pictures, an unknown activation, or an observation entry that the task does not have.
    """
    sizes, network = env.observation_size, config.network
    if not isinstance(sizes, int) and any(key.startswith(PIXELS) for key in sizes):
      raise ConfigError("agent=fast_td3 reads no pictures: choose agent=ppo, or env.vision.enable=false.")
    super().__init__(sizes, env.action_size, network.policy_hidden_layer_sizes, network, precision)
    self.atoms = Atoms(config.min_value, config.max_value, config.num_atoms)
    self._critic = brax_networks.MLP([*network.q_hidden_layer_sizes, config.num_atoms], self.activation)
    self._output_scale = network.policy_output_scale

  def init(self, key: jax.Array) -> FastTD3Params:
    policy_key, output_key, q = jax.random.split(key, 3)
    policy = self.policy_network.init(policy_key)
    last = max(policy["params"], key=lambda name: int(name.rpartition("_")[2]))
    output = policy["params"][last]
    kernel = self._output_scale * jax.random.normal(output_key, output["kernel"].shape)
    policy = {"params": {**policy["params"], last: {"kernel": kernel, "bias": jnp.zeros_like(output["bias"])}}}
    length = math.prod(self.obs_sizes[self.value_obs_key]) + self.action_size
    return FastTD3Params(
      policy, jax.vmap(lambda key: self._critic.init(key, jnp.zeros((1, length))))(jax.random.split(q))
    )

  def mode(self, policy: PyTree, obs: dict[str, jax.Array]) -> jax.Array:
    """Actions in [-1, 1], [..., action_size], for normalised observations."""
    return self.distribution.mode(self.logits(policy, obs))

  def q(self, q_params: PyTree, obs: dict[str, jax.Array], action: jax.Array) -> jax.Array:
    """Logits of both critics' atoms, [2, ..., K], for normalised observations."""
    inputs = jnp.concatenate([obs[self.value_obs_key], action], axis=-1)
    with self.at_precision():
      return jax.vmap(self._critic.apply, (0, None))(q_params, inputs)  # pyright: ignore


class FastTD3(Algorithm[FastTD3Config, FastTD3Networks, FastTD3State]):
  """FastTD3 for one task."""

  samples = False

  def __init__(self, env: Env, config: FastTD3Config, network_precision: str | None = None):
    networks = FastTD3Networks(env, config, network_precision)
    obs = {key: jax.ShapeDtypeStruct(size, jnp.float32) for key, size in networks.obs_sizes.items()}
    scalar, action = jax.ShapeDtypeStruct((), jnp.float32), jax.ShapeDtypeStruct((env.action_size,), jnp.float32)
    done = scalar if config.num_steps > 1 else None
    example = Transition(obs, obs, action, reward=scalar, bootstrap=scalar, valid=scalar, done=done)  # pyright: ignore
    self.buffer = ReplayBuffer(config.max_replay_size, config.num_envs, example, config.checkpoint_replay)
    super().__init__(config, networks, self.buffer)
    self._noise_for = env.episode_length

  @property
  def optimizer(self) -> optax.GradientTransformation:
    return optax.adamw(self.config.learning_rate, weight_decay=self.config.weight_decay)

  def init(self, key: jax.Array, policy: Policy | None) -> FastTD3State:
    policy = policy or self.new_policy(key)
    params = policy.params
    return FastTD3State(
      params=params,
      opt_state=tuple(self.optimizer.init(ravel_pytree(part)[0]) for part in (params.policy, params.q)),
      normalizer=policy.normalizer,
      replay=self.buffer.init(self.config.num_envs // jax.lax.axis_size(AXIS)),
      target_q=params.q,
    )

  def act(self, policy: Policy, obs: Observation, key: jax.Array, deterministic: bool | None = None) -> jax.Array:
    """Returns actions in [-1, 1], [..., action_size]: the actor's own, without exploration."""
    return super().act(policy, obs, key, deterministic=True)

  def train_step(
    self, state: FastTD3State, envs: Environments, key: jax.Array
  ) -> tuple[FastTD3State, Environments, Metrics]:
    config, networks = self.config, self.networks
    act_key, replay_key, noise_key = jax.random.split(key, 3)
    assert state.replay is not None

    # Collect: one step of every environment.
    before = networks.select(envs.state.obs)
    action = self.act(self.policy(state), envs.state.obs, act_key)
    noise = self._noise_levels(state.replay.inserted, len(action))[:, None] * jax.random.normal(act_key, action.shape)
    action = jnp.clip(action + noise, -1, 1)
    envs, final_obs = envs.step(action)
    after = envs.state
    bootstrap, valid = 1 - after.done * (1 - after.info["truncation"]), 1 - after.info["nonfinite"]
    done = after.done if config.num_steps > 1 else None
    transition = Transition(before, networks.select(final_obs), action, after.reward, bootstrap, valid, done)
    normalizer = state.normalizer
    if config.normalize_observations:
      normalizer = running_statistics.update(normalizer, before, pmap_axis_name=AXIS)
    replay = self.buffer.insert(state.replay, transition)

    # Learn, once there is enough to learn from.
    ready = state.replay.inserted >= config.prefill_updates
    seen = normalizer if config.normalize_observations else None
    start = (state.params, state.target_q, state.opt_state)

    def learn(start: PyTree) -> tuple[PyTree, jax.Array]:
      shape = (config.grad_updates_per_step, config.batch_size // jax.lax.axis_size(AXIS))
      if config.num_steps > 1:
        windows = self.buffer.sample_windows(replay, replay_key, shape, config.num_steps)
        batches = n_step(windows, config.discounting)
      else:
        batches = self.buffer.sample(replay, replay_key, shape)
      batches = batches.replace(obs=normalize(batches.obs, seen), next_obs=normalize(batches.next_obs, seen))
      return self._learn(start, batches, replay.inserted, noise_key)

    idle = lambda start: (start, jnp.zeros(len(PARTS) + 1))
    (params, target_q, opt_state), parts = jax.lax.cond(ready, learn, idle, start)

    metrics: Metrics = dict(zip((*PARTS, "nonfinite_updates"), jax.lax.pmean(parts, AXIS), strict=True))
    metrics["learned"] = ready.astype(jnp.float32)
    metrics["gradient_steps"] = metrics["learned"] * config.grad_updates_per_step
    metrics["nonfinite_updates"] *= metrics["gradient_steps"]
    learned = {"params": params, "target_q": target_q, "opt_state": opt_state}
    return state.replace(**learned, normalizer=normalizer, replay=replay), envs, metrics

  def _noise_levels(self, step: jax.Array, count: int) -> jax.Array:
    """Deviation of the noise of this device's environments, [count], which changes every `episode_length` steps."""
    key = jax.random.fold_in(jax.random.PRNGKey(0), step // self._noise_for)
    key = jax.random.fold_in(key, jax.lax.axis_index(AXIS))
    return jax.random.uniform(key, (count,), minval=self.config.min_noise, maxval=self.config.max_noise)

  def _learn(
    self, start: tuple[PyTree, PyTree, PyTree], batches: Transition, step: jax.Array, key: jax.Array
  ) -> tuple[PyTree, jax.Array]:
    """Gradient steps, one for each batch: of the critics, at times of the actor, then of the target critics."""
    config, networks = self.config, self.networks
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
      critic, critic_opt, critic_norm, good = gradient_step(self.optimizer, grads, critic, critic_opt)

      def move(actor: jax.Array, actor_opt: PyTree) -> PyTree:
        loss_and_grad = jax.value_and_grad(policy_loss)
        loss, grads = loss_and_grad(unravel_actor(actor), unravel_critic(critic), batch, networks, config)
        return *gradient_step(self.optimizer, grads, actor, actor_opt), loss

      stay = lambda actor, actor_opt: (actor, actor_opt, jnp.zeros(()), jnp.array(True), jnp.zeros(()))
      turn = (i if count > 1 else step) % config.policy_frequency == (config.policy_frequency > 1 and count > 1)
      actor, actor_opt, norm, good_too, actor_loss = jax.lax.cond(turn, move, stay, actor, actor_opt)
      target += config.tau * (critic - target)
      finite = good & good_too
      log = jnp.where(finite, jnp.stack([loss, actor_loss, mean, edge, critic_norm, norm]), 0.0)
      return (actor, critic, target, (actor_opt, critic_opt)), jnp.append(log, 1.0 - finite)

    carry = (actor, critic, ravel_pytree(target_q)[0], opt_state)
    carry, log = jax.lax.scan(update, carry, (batches, jax.random.split(key, count), jnp.arange(count)))
    actor, critic, target, opt_state = carry
    learned = FastTD3Params(unravel_actor(actor), unravel_critic(critic))
    return (learned, unravel_critic(target), opt_state), log.mean(axis=0)  # of the actor's also where it rested


def n_step(windows: Transition, discounting: float) -> Transition:
  """Makes one transition of several: rewards add up, discounted, until the episode or the window ends.

  Args:
    windows: successive steps, each [n, ..., ] with `done`.
    discounting: discount of one step.

  Returns:
    From the first observation and action to the last `next_obs`, where `bootstrap` also holds the discount of all steps
    but one; it is valid where all of its steps are.
  """
  assert windows.done is not None
  whole = jax.tree.map(lambda x: x[0], windows)
  alive, discount = 1 - whole.done, jnp.ones_like(whole.reward)
  for k in range(1, len(windows.reward)):
    step = jax.tree.map(lambda x, k=k: x[k], windows)
    goes_on = alive > 0
    discount = jnp.where(goes_on, discount * discounting, discount)
    latest = lambda new, old, on=goes_on: jnp.where(on.reshape(on.shape + (1,) * (new.ndim - on.ndim)), new, old)
    whole = whole.replace(
      reward=whole.reward + alive * discount * step.reward,
      next_obs=jax.tree.map(latest, step.next_obs, whole.next_obs),
      bootstrap=latest(step.bootstrap, whole.bootstrap),
      valid=whole.valid * latest(step.valid, jnp.ones_like(step.valid)),
    )
    alive *= 1 - step.done
  return whole.replace(bootstrap=whole.bootstrap * discount)


def critic_loss(
  params: PyTree,
  target_params: PyTree,
  policy: PyTree,
  batch: Transition,
  key: jax.Array,
  networks: FastTD3Networks,
  config: FastTD3Config,
) -> tuple[jax.Array, tuple[jax.Array, jax.Array, jax.Array]]:
  """Cross-entropy of both critics to the projected distribution of the target critic with the smaller value.

  Args:
    params: the critics'.
    target_params: the target critics'.
    policy: the actor's.
    batch: B normalised transitions.
    key: for the noise on next actions.
    networks: the networks the parameters belong to.
    config: `discounting`, `reward_scaling`, `policy_noise`, `noise_clip`, `use_smaller_q`.

  Returns:
    The loss, and loss, mean value, and share of the targets at the first and last atom.
  """
  atoms = networks.atoms
  noise = config.policy_noise * jax.random.normal(key, batch.action.shape)
  next_action = networks.mode(policy, batch.next_obs) + jnp.clip(noise, -config.noise_clip, config.noise_clip)
  following = jax.nn.softmax(networks.q(target_params, batch.next_obs, jnp.clip(next_action, -1, 1)))
  reward, discount = config.reward_scaling * batch.reward, config.discounting * batch.bootstrap
  target = atoms.project(following, *jnp.broadcast_arrays(reward, discount, following[..., 0])[:2])
  if config.use_smaller_q:
    value = atoms.mean(target)
    target = jnp.broadcast_to(jnp.where((value[0] < value[1])[:, None], target[0], target[1]), target.shape)
  logits = networks.q(params, batch.obs, batch.action)
  cross_entropy = -(jax.lax.stop_gradient(target) * jax.nn.log_softmax(logits)).sum(axis=-1)
  loss = (cross_entropy * batch.valid).mean(axis=1).sum()
  at_edge = (target[..., 0] + target[..., -1]).mean()  # what was moved there, above all
  return loss, (loss, atoms.mean(jax.nn.softmax(logits)).mean(), at_edge)


def policy_loss(
  policy: PyTree, q_params: PyTree, batch: Transition, networks: FastTD3Networks, config: FastTD3Config
) -> jax.Array:
  """Minus the mean value of the actor's actions, by the smaller critic or by both."""
  logits = networks.q(q_params, batch.obs, networks.mode(policy, batch.obs))
  values = networks.atoms.mean(jax.nn.softmax(logits))
  return -(values.min(axis=0) if config.use_smaller_q else values.mean(axis=0)).mean()
