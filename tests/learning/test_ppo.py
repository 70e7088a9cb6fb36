"""What is PPO's own; what it shares with the other algorithms is in test_trainer.py."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.flatten_util import ravel_pytree
from jax.sharding import PartitionSpec as P

from playground.envs.wrappers import FINAL_OBS
from playground.errors import ConfigError
from playground.hardware.mesh import jit_on_mesh, make_mesh
from playground.learning.algorithm import gradient_step
from playground.learning.networks import NetworkConfig, normalize
from playground.learning.ppo import Batch, gae, pay_time_outs
from playground.learning.rollout import Environments, unroll
from playground.learning.trainer import Trainer
from tests.dummy import SMALL_PPO, PointTask, numbers, point_trainer


def test_a_bad_gradient_is_left_out() -> None:
  params, optimizer = jnp.arange(3.0), optax.adam(1e-3)
  start = (params, optimizer.init(params))
  step = lambda grads: gradient_step(optimizer, grads, *start)
  mapped = jit_on_mesh(step, make_mesh(1), (P(),), P())
  *after, norm, finite = mapped({"bad": jnp.array([1.0, jnp.nan]), "good": jnp.ones(1)})
  assert not finite and np.isnan(norm)
  for a, b in zip(numbers(start), numbers(tuple(after)), strict=True):
    np.testing.assert_array_equal(a, b)
  moved, _, norm, finite = mapped({"bad": jnp.ones(2), "good": jnp.ones(1)})
  assert finite and norm == pytest.approx(3**0.5) and (moved < params).all()


def test_gradients_of_a_part_of_the_parameters_are_refused() -> None:
  params, optimizer = jnp.arange(3.0), optax.adam(1e-3)
  with pytest.raises(ConfigError, match=r"^gradient_step got 2 gradients for 3 parameters: give it"):
    gradient_step(optimizer, {"policy": jnp.ones(2)}, params, optimizer.init(params))


@pytest.mark.parametrize(
  ("change", "words"),
  [
    ({"num_envs": 24}, ["agent.num_envs=24", "does not divide", "= 32"]),
    ({"num_eval_envs": 15}, ["agent.num_eval_envs=15", "devices, 2"]),
  ],
)
def test_sizes_that_do_not_divide_are_refused(change: dict[str, Any], words: list[str]) -> None:
  with pytest.raises(ConfigError) as error:
    dataclasses.replace(SMALL_PPO, **change).check(num_devices=2)
  assert all(word in str(error.value) for word in words)


def test_an_observation_entry_that_is_not_there_is_named() -> None:
  config = dataclasses.replace(SMALL_PPO, network=NetworkConfig(value_obs_key="priviledged_state"))
  with pytest.raises(ConfigError, match=r"agent.network.value_obs_key='priviledged_state'.*Did you mean 'privileged"):
    point_trainer(config)


def test_environments_can_start_at_all_ages() -> None:
  state = lambda trainer: trainer.init(jax.random.PRNGKey(0), {}, None, trainer.settings).env_state
  same_age, mixed = (
    state(point_trainer(dataclasses.replace(SMALL_PPO, init_at_random_ep_len=mix), num_devices=2))
    for mix in (False, True)
  )
  np.testing.assert_array_equal(same_age.info["steps"], 0)
  ages = np.asarray(mixed.info["steps"])
  assert ages.min() >= 0 and ages.max() < 20, "an episode is 20 steps"
  assert len(set(ages)) > 4
  assert set(ages[: len(ages) // 2]) != set(ages[len(ages) // 2 :]), "each device draws its own"
  np.testing.assert_array_equal(same_age.obs["state"], mixed.obs["state"])


def test_a_time_out_is_worth_what_its_true_last_observation_promises() -> None:
  config = dataclasses.replace(SMALL_PPO, init_at_random_ep_len=True, bootstrap_on_timeout=True)
  trainer: Any = point_trainer(config, episode_length=4)
  state = trainer.init(jax.random.PRNGKey(0), {}, None, trainer.settings)
  normalizer = jax.tree.map(lambda x: x + 0.25 if x.dtype == jnp.float32 else x, state.algorithm.normalizer)
  actor = (trainer.networks, state.algorithm.params.policy, normalizer)
  envs = lambda env_state: Environments(env_state, state.capture, {}, {}, trainer.env)
  value = functools.partial(trainer.networks.value, state.algorithm.params.value)
  roll = lambda env_state, key, length: unroll(envs(env_state), *actor, key, length, value)[1]
  data = jax.jit(roll, static_argnums=2)(state.env_state, jax.random.PRNGKey(1), 6)
  place, action = data.obs["state"], trainer.networks.distribution.postprocess(data.raw_action)
  last = {"state": place + 0.1 * action, "privileged_state": jnp.concatenate([place + 0.1 * action, action], -1)}
  value = trainer.networks.value(state.algorithm.params.value, normalize(last, normalizer))
  assert 0 < data.truncation[0].sum() < 16, "some of the environments"
  np.testing.assert_allclose(data.final_value, value * data.truncation, atol=1e-6)
  assert np.abs(data.final_value).max() > 1e-3


def test_paid_time_outs_are_ends_with_a_value() -> None:
  """The advantages are those of a plain sum over each episode's own steps, its last state's value at the end."""
  rng = np.random.default_rng(0)
  steps, count, scale, discount, decay = 7, 5, 0.5, 0.9, 0.8
  draw = lambda *shape: rng.normal(size=shape).astype(np.float32)
  done = rng.random((steps, count)) < 0.5
  truncation = (done & (rng.random(done.shape) < 0.6)).astype(np.float32)
  termination = done - truncation
  values, reward = jnp.asarray(draw(steps + 1, count)), draw(steps, count)
  final_value = jnp.asarray(draw(steps, count) * truncation)
  batch = Batch({}, {}, draw(0), draw(0), reward, termination, truncation)  # pyright: ignore
  config = dataclasses.replace(SMALL_PPO, reward_scaling=scale, discounting=discount, gae_lambda=decay)
  _, advantages = gae(pay_time_outs(batch, final_value, config), values, config)
  expected = np.zeros((steps, count))
  for b in range(count):
    # Brax's advantages are r + discount * (next value, with all that follows) - V, the sum of which is the target.
    target = values[-1, b]
    for t in reversed(range(steps)):
      follows = final_value[t, b] if done[t, b] else target
      expected[t, b] = reward[t, b] * scale + discount * follows - values[t, b]
      delta = reward[t, b] * scale + discount * (final_value[t, b] if done[t, b] else values[t + 1, b]) - values[t, b]
      target = values[t, b] + delta + (0 if done[t, b] else discount * decay * (target - values[t + 1, b]))
  np.testing.assert_allclose(advantages, expected, atol=1e-5)


def test_a_run_that_pays_time_outs_stores_no_more_and_learns() -> None:
  shapes, learned = [], []
  for pays in (False, True):
    trainer = point_trainer(dataclasses.replace(SMALL_PPO, bootstrap_on_timeout=pays), num_devices=2)
    state, metrics = trainer.train(trainer.init(jax.random.PRNGKey(0), {}, None, trainer.settings), {}, np.int32(4))
    assert metrics["episodes"] > 0 and FINAL_OBS not in state.env_state.info
    shapes.append(jax.eval_shape(lambda state=state: state))
    learned.append(ravel_pytree(state.algorithm.params)[0])
  assert jax.tree.structure(shapes[0]) == jax.tree.structure(shapes[1])
  assert np.isfinite(learned[1]).all() and (learned[0] != learned[1]).any()


def test_values_are_checked_before_sizes() -> None:
  with pytest.raises(ConfigError, match=r"agent\.num_envs=0 must be a whole number from 1 to "):
    Trainer(PointTask(), dataclasses.replace(SMALL_PPO, num_envs=0), make_mesh(1))
