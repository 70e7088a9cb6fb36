"""Soft Actor-Critic (Haarnoja et al., 2018b) on batched environments, over a mesh of devices.

Names, meaning and defaults of the hyperparameters are Brax's (paper, Appendix E). One training step takes one step of
every environment and then `grad_updates_per_step` gradient steps on transitions drawn from the replay buffer.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from brax.training.acme import running_statistics
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh

from playground.envs.base import Env, State
from playground.envs.wrappers import ModelFields
from playground.errors import ConfigError
from playground.hardware.distributed import several
from playground.hardware.mesh import AXIS, device_memory
from playground.learning.checkpoints import Checkpoint
from playground.learning.hyperparameters import SACConfig
from playground.learning.learner import SPEC, Learner, Metrics, Policy, TrainState
from playground.learning.networks import SoftActorCritic, SoftActorCriticParams, normalize
from playground.learning.replay import REPLAY_SPEC, Replay, ReplayBuffer
from playground.learning.rollout import NonfiniteCapture, episode_sums, step_and_see
from playground.learning.sac_losses import PARTS, Transition, sac_loss


class SACState(TrainState):
  """A training state (params: `SoftActorCriticParams`) with target critics and experience."""

  target_q: Any
  replay: Replay


class SAC(Learner):
  """The algorithm for one task."""

  def __init__(self, env: Env, config: SACConfig, mesh: Mesh, network_precision: str | None = None):
    """Args:
      env: the task.
      config: hyperparameters.
      mesh: devices, one axis named "data".
      network_precision: matrix-product precision of the networks.

    Raises:
      ConfigError: sizes that do not go together, or networks that do not fit the task.
    """
    config.check(mesh.size)
    networks = SoftActorCritic(env.observation_size, env.action_size, config.network, network_precision)
    spec = SACState(**SPEC, target_q=SPEC["params"], replay=REPLAY_SPEC)
    super().__init__(env, config, mesh, networks, config.steps_per_update * env.action_repeat, spec)
    if config.prefill_updates * self.steps_per_update >= config.num_timesteps:
      raise ConfigError(
        f"agent.num_timesteps={config.num_timesteps} is over before agent.min_replay_size={config.min_replay_size} "
        "transitions are collected, so nothing would be learned."
      )
    self.optimizer = optax.scale_by_adam()
    self.loss = partial(
      sac_loss, networks=networks, discounting=config.discounting, reward_scaling=config.reward_scaling
    )
    obs = {key: jax.ShapeDtypeStruct(size, jnp.float32) for key, size in networks.obs_sizes.items()}
    scalar, action = jax.ShapeDtypeStruct((), jnp.float32), jax.ShapeDtypeStruct((env.action_size,), jnp.float32)
    example = Transition(obs, obs, action, reward=scalar, discount=scalar, nonfinite=scalar)  # pyright: ignore
    self.buffer = ReplayBuffer(config.max_replay_size, config.num_envs, example)
    if not config.checkpoint_replay:
      self.copy = self._make_copy(lambda state: state.replace(replay=state.replay.replace(data=None)))
    elif several():
      raise ConfigError("agent.checkpoint_replay=true needs one process for all devices: set it to false.")

  def _init(self, key: jax.Array, model: ModelFields) -> SACState:
    key, net_key, env_key = jax.random.split(key, 3)
    params = self.networks.init(net_key)
    env_state = self._fresh(env_key, model)
    return SACState(
      params=params,
      opt_state=self.optimizer.init(ravel_pytree(params)[0]),
      normalizer=self.networks.init_normalizer(),
      key=key,
      env_state=env_state,
      capture=NonfiniteCapture.empty(env_state, self.env.action_size, model),
      target_q=params.q,
      replay=self.buffer.init(self.config.num_envs // self.mesh.size),
    )

  def _training_step(self, state: SACState, model: ModelFields) -> tuple[SACState, Metrics]:
    config = self.config
    key, shared = jax.random.split(state.key)
    act_key, replay_key, noise_key = jax.random.split(jax.random.fold_in(shared, jax.lax.axis_index(AXIS)), 3)

    # Collect: one step of every environment.
    env_state, capture, transition = self._collect(state, act_key, model)
    normalizer = state.normalizer
    if config.normalize_observations:
      normalizer = running_statistics.update(normalizer, transition.obs, pmap_axis_name=AXIS)
    replay = self.buffer.insert(state.replay, transition)

    # Learn, once there is enough to learn from: what all gradient steps need is drawn and normalised in one go.
    shape = (config.grad_updates_per_step, config.batch_size // self.mesh.size)
    batches = self.buffer.sample(replay, replay_key, shape)
    if config.normalize_observations:
      obs, next_obs = normalize(batches.obs, normalizer), normalize(batches.next_obs, normalizer)
      batches = batches.replace(obs=obs, next_obs=next_obs)
    noise = jax.random.normal(noise_key, (shape[0], 2, shape[1], self.env.action_size))
    ready = state.replay.inserted >= config.prefill_updates
    start = (state.params, state.target_q, state.opt_state)
    idle = lambda start, *_: (start, jnp.zeros(len(PARTS) + 2))
    (params, target_q, opt_state), parts = jax.lax.cond(ready, self._learn, idle, start, batches, noise)

    report = dict(zip((*PARTS, "grad_norm", "nonfinite_updates"), jax.lax.pmean(parts, AXIS), strict=True))
    metrics = report | jax.lax.psum(episode_sums(env_state), AXIS) | {"learned": ready.astype(jnp.float32)}
    metrics["gradient_steps"] = metrics["learned"] * config.grad_updates_per_step
    metrics["nonfinite_updates"] *= metrics["gradient_steps"]
    after = SACState(
      params=params,
      opt_state=opt_state,
      normalizer=normalizer,
      key=key,
      env_state=env_state,
      capture=capture,
      target_q=target_q,
      replay=replay,
    )
    return after, metrics

  def _collect(self, state: SACState, key: jax.Array, model: ModelFields) -> tuple[State, NonfiniteCapture, Transition]:
    """Steps this device's environments once with sampled actions."""
    before = state.env_state
    action = self.act(self.policy(state), before.obs, key, deterministic=False)
    after, final_obs = step_and_see(self.env, before, action, model)
    transition = Transition(
      obs=self.networks.select(before.obs),
      next_obs=self.networks.select(final_obs),
      action=action,
      reward=after.reward,
      discount=1 - after.done * (1 - after.info["truncation"]),
      nonfinite=after.info["nonfinite"],
    )
    return after, state.capture.look(before, action, model, after), transition

  def _learn(self, start: tuple[Any, Any, Any], batches: Transition, noise: jax.Array) -> tuple[Any, jax.Array]:
    """Gradient steps, one for each batch. Parameters travel as one vector: a kernel for each array costs far more."""
    params, target_q, opt_state = start
    (flat, unravel), (flat_target, unravel_target) = ravel_pytree(params), ravel_pytree(target_q)
    config = self.config
    rates = jax.tree.broadcast(
      SoftActorCriticParams(config.learning_rate, config.learning_rate, config.alpha_learning_rate), params
    )
    rates = ravel_pytree(jax.tree.map(jnp.full_like, params, rates))[0]
    step = partial(self._sgd_step, unravel, unravel_target, rates)
    (flat, flat_target, opt_state), parts = jax.lax.scan(step, (flat, flat_target, opt_state), (batches, noise))
    return (unravel(flat), unravel_target(flat_target), opt_state), parts.mean(axis=0)

  def _sgd_step(
    self,
    unravel: Callable[[jax.Array], SoftActorCriticParams],
    unravel_target: Callable[[jax.Array], Any],
    rates: jax.Array,
    carry: tuple[Any, Any, Any],
    x: tuple[Transition, jax.Array],
  ) -> tuple[Any, jax.Array]:
    """One gradient step for critics, actor and temperature, and one of the target critics after them."""
    params, target, opt_state = carry
    grads, parts = jax.grad(self.loss, has_aux=True)(unravel(params), unravel_target(target), *x)
    grads = jax.lax.pmean(ravel_pytree(grads)[0], AXIS)
    norm = jnp.linalg.norm(grads)
    update, new_opt_state = self.optimizer.update(grads, opt_state)
    new_params = params - rates * cast(jax.Array, update)
    new_target = target + self.config.tau * (new_params[: target.size] - target)  # the critics come first
    finite = jnp.isfinite(norm)  # a bad gradient is counted and left out
    carry = jax.tree.map(lambda n, o: jnp.where(finite, n, o), (new_params, new_target, new_opt_state), carry)
    parts = jnp.where(finite, jnp.append(parts, norm), 0.0)
    return carry, jnp.append(parts, 1.0 - finite)

  # What goes on from a checkpoint

  def notices(self) -> list[str]:
    config, limit = self.config, device_memory(self.mesh)
    each = self.buffer.nbytes / self.mesh.size
    size = f"{self.buffer.size:,} transitions of {self.buffer.width} numbers, {each / 1e9:.2f} GB on each device"
    size += ", and as much again while a checkpoint is saved" * config.checkpoint_replay
    if limit is not None and each * (1 + config.checkpoint_replay) > limit:
      raise ConfigError(
        f"agent.max_replay_size={config.max_replay_size} is {size}, but a device has {limit / 1e9:.2f} GB: "
        "lower it, or set agent.checkpoint_replay=false."
      )
    return [f"Replay buffer: {size}."]

  def with_policy(self, state: SACState, policy: Policy) -> SACState:
    state = super().with_policy(state, policy)
    return state.replace(target_q=self.place_policy(policy).params.q)

  def split(self, state: SACState) -> tuple[Policy, SACState]:
    policy, rest = super().split(state)
    return policy, rest.replace(replay=rest.replay.replace(data=None))

  def restore(self, checkpoint: Checkpoint, template: SACState) -> tuple[SACState, str]:
    state, elsewhere = self.read(checkpoint, template)
    shape = template.replay.data.shape
    data, inserted, what = np.zeros(shape, np.float32), state.replay.inserted, "the whole training state"
    if checkpoint.has("replay"):
      held = min(int(inserted), self.buffer.slots)
      data[:held] = checkpoint.restore("replay", jax.ShapeDtypeStruct((held, *shape[1:]), jnp.float32))
    else:
      refill = f"{self.config.prefill_updates * self.config.num_envs:,} transitions are collected before it learns on"
      inserted, what = np.zeros_like(inserted), f"the training state without its replay buffer ({refill})"
    state = state.replace(replay=Replay(data, inserted))
    return self.place(state), f"Resuming {what} of {checkpoint.path} ({checkpoint.step:,} steps).{elsewhere}"

  def experience(self, state: SACState) -> np.ndarray | None:
    if not self.config.checkpoint_replay:
      return None
    return np.asarray(state.replay.data)[: int(self.buffer.held(state.replay))]
