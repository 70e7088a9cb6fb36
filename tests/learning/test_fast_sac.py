"""FastSAC's parts against their formulas."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.scipy.stats import norm
from jax.sharding import PartitionSpec as P

from playground.errors import ConfigError
from playground.hardware.mesh import jit_on_mesh, make_mesh
from playground.learning.c51 import c51_loss, updates_actor
from playground.learning.fast_sac import (
  BoundedNormalTanh,
  FastSAC,
  FastSACNetworks,
  alpha_loss,
  policy_loss,
)
from playground.learning.hyperparameters import FastSACConfig, FastSACNetworkConfig
from playground.learning.off_policy import Transition
from tests.dummy import PointTask
from tests.learning.test_c51 import projected

SMALL = FastSACConfig(
  num_timesteps=10**6,
  network=FastSACNetworkConfig(policy_hidden_layer_sizes=(16, 16), q_hidden_layer_sizes=(16, 16)),
  num_atoms=21,
  min_value=-3,
  max_value=3,
)


@pytest.fixture(scope="module")
def networks() -> FastSACNetworks:
  return FastSACNetworks(PointTask(), SMALL, None)


def batch(networks: FastSACNetworks, size: int = 16, **changes: Any) -> Transition:
  draw = lambda i, *shape: jax.random.normal(jax.random.PRNGKey(i), (size, *shape))
  obs, next_obs = ({key: draw(i, *shape) for key, shape in networks.obs_sizes.items()} for i in (0, 3))
  action = jnp.tanh(draw(1, networks.action_size))
  return Transition(obs, next_obs, action, draw(2), jnp.ones(size), jnp.zeros(size)).replace(**changes)


def test_the_policy_begins_at_0_with_a_small_deviation(networks: FastSACNetworks) -> None:
  params, data = jax.jit(networks.init)(jax.random.PRNGKey(0)), batch(networks)
  logits = jax.jit(networks.logits)(params.policy, data.obs)
  np.testing.assert_array_equal(networks.distribution.mode(logits), 0)
  np.testing.assert_allclose(networks.distribution.create_dist(logits).scale, np.exp(-2.5), rtol=1e-6)
  assert float(params.log_alpha) == pytest.approx(np.log(0.001))
  extreme = networks.distribution.create_dist(jnp.array([0.0, 0.0, -99.0, 99.0])).scale
  np.testing.assert_allclose(extreme, [np.exp(-5), 1.0], rtol=1e-5)


def test_log_probabilities_are_those_of_the_squashed_actions() -> None:
  distribution, logits = BoundedNormalTanh(1, -5.0, 0.0), jnp.array([0.3, 0.8])
  std = np.exp(-5 + 2.5 * (np.tanh(0.8) + 1))
  for raw in (-0.5, 0.1, 1.2):
    action, step = np.tanh(raw), 1e-3
    below = norm.cdf(np.arctanh(np.array([action - step, action + step])), 0.3, std)
    found = distribution.log_prob(logits, jnp.array([raw]))
    assert float(found) == pytest.approx(float(np.log((below[1] - below[0]) / (2 * step))), abs=2e-3)


def test_each_critic_learns_soft_values_from_its_own_target(networks: FastSACNetworks) -> None:
  data = batch(networks, discount=jnp.tile(jnp.array([0.0, 1.0]), 8))
  params, target = (jax.jit(networks.init)(jax.random.PRNGKey(seed)) for seed in (0, 9))
  action, log_prob = jax.jit(networks.sample)(networks.logits(params.policy, data.next_obs), jax.random.PRNGKey(1))
  alpha = 0.2
  following = np.asarray(jax.nn.softmax(networks.q(target.q, data.next_obs, action)), np.float64)
  log = np.asarray(jax.nn.log_softmax(networks.q(params.q, data.obs, data.action)), np.float64)
  expected = 0.0
  for i in range(16):
    discount = SMALL.discounting * float(data.discount[i])
    reward = float(data.reward[i]) - discount * alpha * float(log_prob[i])
    for k in (0, 1):
      expected -= (projected(following[k, i], reward, discount, -3, 3) * log[k, i]).sum() / 16
  rest = False, networks, SMALL
  loss = jax.jit(lambda data, alpha: c51_loss(params.q, target.q, data, action, -alpha * log_prob, *rest)[0])
  assert float(loss(data, alpha)) == pytest.approx(expected, rel=1e-4)
  over = data.replace(discount=jnp.zeros(16))
  assert loss(over, alpha) == loss(over, 9.0), "no entropy bonus after the end"
  assert loss(data.replace(nonfinite=jnp.ones(16)), alpha) == 0


def test_the_temperature_follows_the_entropy() -> None:
  log_alpha, target = jnp.log(jnp.array([0.3])), -0.48 * 2
  slope = lambda entropy: float(jax.grad(alpha_loss)(log_alpha, jnp.full(5, -entropy), target)[0])
  assert slope(-2.0) == pytest.approx(0.3 * (-2.0 - target), rel=1e-5), "too little: the temperature rises"
  assert slope(-2.0) < 0 < slope(1.0)
  assert slope(target) == pytest.approx(0, abs=1e-7)


def test_the_actor_climbs_the_mean_of_both_critics_and_keeps_its_entropy(networks: FastSACNetworks) -> None:
  params, data, key = jax.jit(networks.init)(jax.random.PRNGKey(0)), batch(networks), jax.random.PRNGKey(1)
  action, log_prob = jax.jit(networks.sample)(networks.logits(params.policy, data.obs), key)
  values = networks.atoms.mean(jax.nn.softmax(jax.jit(networks.q)(params.q, data.obs, action)))
  loss = jax.jit(lambda policy, alpha: policy_loss(policy, params.q, alpha, data, key, networks))
  expected = float((0.5 * log_prob - values.mean(axis=0)).mean())
  assert float(loss(params.policy, 0.5)) == pytest.approx(expected, rel=1e-5)
  slope = jax.jit(jax.grad(loss))(params.policy, 0.0)
  moved = jax.tree.map(lambda p, g: p - 0.05 * g, params.policy, slope)
  assert loss(moved, 0.0) < loss(params.policy, 0.0)


def test_critics_and_temperature_move_in_each_update_and_the_actor_in_every_nth() -> None:
  config = dataclasses.replace(SMALL, grad_updates_per_step=8, policy_frequency=4)
  algorithm = FastSAC(PointTask(), config)
  params = algorithm.new_policy(jax.random.PRNGKey(0)).params
  start = (params, params.q, algorithm.init_optimizer(params))
  batches = jax.tree.map(lambda x: jnp.stack([x] * 8), batch(algorithm.networks))
  learn = jit_on_mesh(algorithm.learn, make_mesh(1), (P(),) * 4, P())
  (learned, target, (actor, critic, alpha)), log = learn(start, batches, jax.random.PRNGKey(0), np.int32(0))
  assert [int(part[0].count) for part in (actor, critic, alpha)] == [2, 8, 8]
  assert np.isfinite(log).all() and log[-1] == 0
  slope = jax.grad(policy_loss)(
    params.policy, params.q, 0.001, batch(algorithm.networks), jax.random.PRNGKey(0), algorithm.networks
  )
  logged = dict(zip(algorithm.logged, log, strict=False))
  assert logged["grad_norm"] == pytest.approx(float(optax.global_norm(slope)), rel=0.4), (
    "a mean over the actor's updates"
  )
  assert float(jnp.abs(learned.log_alpha - params.log_alpha)) <= 8 * config.alpha_learning_rate * 1.01
  for now, before, slow in zip(*map(jax.tree.leaves, (learned.q, params.q, target)), strict=True):
    assert 0 < jnp.abs(slow - before).max() < jnp.abs(now - before).max()


@pytest.mark.parametrize(("updates", "frequency"), [(1, 3), (2, 4), (3, 2), (8, 2), (8, 16), (5, 1)])
def test_the_actor_is_updated_with_every_nth_of_all_critic_updates(updates: int, frequency: int) -> None:
  config = dataclasses.replace(SMALL, grad_updates_per_step=updates, policy_frequency=frequency)
  steps, indices = np.divmod(np.arange(48 * updates), updates)
  turns = np.flatnonzero(updates_actor(config, jnp.asarray(indices), jnp.asarray(steps)))
  assert len(turns) == 48 * updates // frequency and set(np.diff(turns)) == {frequency}


def test_a_deviation_without_a_range_is_refused() -> None:
  with pytest.raises(ConfigError, match=r"agent.network.max_log_std=-6.0 must not be below agent.network.min_log_std"):
    dataclasses.replace(SMALL, network=FastSACNetworkConfig(max_log_std=-6.0)).check(1)
