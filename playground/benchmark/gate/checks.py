"""Builds the checks of the gate: small pieces of our code on the CPU, each with a reference."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from playground import registry
from playground.config import compose
from playground.envs.base import State
from playground.envs.wrappers import wrap_for_training
from playground.hardware.mesh import make_mesh
from playground.learning.trainer import Trainer
from playground.physics.backend import mjx
from playground.pytree import PyTree

jax.config.update("jax_platforms", "cpu")

Timed = Callable[[], object]  # runs and waits for the result
Pair = tuple[Timed, Timed]  # ours and the reference, both compiled
LENGTH = 20  # control steps of one call


def env_step(task: str, num_envs: int) -> Pair:
  """Compares a task's wrapped environment step with the same number of MJX steps of the same model."""
  env = registry.load(task, overrides={"impl": "jax"})
  wrapped = wrap_for_training(env)

  @jax.jit
  def ours(state: State) -> State:
    action = jnp.zeros((num_envs, env.action_size))
    return jax.lax.scan(lambda s, _: (wrapped.step(s, action, {}), None), state, None, LENGTH)[0]

  @jax.jit
  def plain(data: mjx.Data) -> mjx.Data:
    step = jax.vmap(lambda d: mjx.step(env.mjx_model, d))
    return jax.lax.scan(lambda d, _: (step(d), None), data, None, LENGTH * env.n_substeps)[0]

  state = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), num_envs), {})
  one = mjx.make_data(env.mj_model, impl="jax")
  data = jax.vmap(lambda qpos, qvel: one.replace(qpos=qpos, qvel=qvel))(state.data.qpos, state.data.qvel)
  return _waits(ours, state), _waits(plain, data)


def training_step(agent: str, overrides: tuple[str, ...], layers: tuple[int, int, int]) -> Pair:
  """Compares a training step on CartpoleBalance, mostly gradient steps, with matrix products of a network's size.

  Args:
    agent: ppo or sac.
    overrides: overrides of the agent's sizes.
    layers: rows, width and number of the products.
  """
  config = compose(["env=CartpoleBalance", f"agent={agent}", "env.impl=jax", *overrides])
  trainer = Trainer(registry.load("CartpoleBalance", config=config.env), config.agent, make_mesh(1))
  state = trainer.init(jax.random.PRNGKey(0), {}, None, trainer.settings)
  state, _ = trainer.train(state, {}, np.int32(trainer.config.prefill_updates))

  def ours() -> PyTree:
    nonlocal state
    state, metrics = trainer.train(state, {}, np.int32(1))
    return jax.block_until_ready(metrics)

  rows, width, count = layers

  @jax.jit
  def products(x: jax.Array, weights: jax.Array) -> jax.Array:
    return jax.lax.scan(lambda x, w: (jax.nn.swish(x @ w), None), x, weights)[0]

  x, weights = jnp.ones((rows, width)), jnp.zeros((count, width, width))
  return ours, _waits(partial(products, x), weights)


def _waits(function: Callable[[PyTree], PyTree], argument: PyTree) -> Timed:
  return lambda: jax.block_until_ready(function(argument))


_PPO = ("agent.num_envs=64", "agent.unroll_length=8", "agent.batch_size=64", "agent.num_minibatches=4")
_PPO += ("agent.num_updates_per_batch=8", "agent.num_eval_envs=1")
_SAC = ("agent.num_envs=16", "agent.min_replay_size=512", "agent.max_replay_size=4096", "agent.num_eval_envs=1")

CHECKS: dict[str, Callable[[], Pair]] = {
  "env_step_cartpole": partial(env_step, "CartpoleBalance", 256),
  "env_step_go1": partial(env_step, "Go1JoystickFlatTerrain", 16),
  "ppo_update": partial(training_step, "ppo", _PPO, (512, 256, 300)),
  "sac_update": partial(training_step, "sac", _SAC, (512, 256, 100)),
}
