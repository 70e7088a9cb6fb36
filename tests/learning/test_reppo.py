"""REPPO's parts against their formulas."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import erf

from playground.errors import ConfigError
from playground.learning.hyperparameters import REPPOConfig, REPPONetworkConfig
from playground.learning.reppo import (
  ACTOR_LOSSES,
  HLGauss,
  REPPONetworks,
  Transition,
  actor_loss,
  critic_loss,
  lambda_returns,
)
from tests.dummy import PointTask

SMALL = REPPOConfig(
  num_timesteps=1000,
  network=REPPONetworkConfig(hidden_layer_sizes=(16, 16), q_hidden_layer_size=16),
  min_value=-10,
  max_value=10,
)


@pytest.fixture(scope="module")
def networks() -> REPPONetworks:
  return REPPONetworks(PointTask(), SMALL, None)


@pytest.fixture(scope="module")
def params(networks: REPPONetworks) -> Any:
  return jax.jit(networks.init)(jax.random.PRNGKey(0))


def batch(networks: REPPONetworks, size: int = 32, **changes: Any) -> Transition:
  """Made by NumPy, which compiles nothing."""
  draw: Any = lambda i, *shape: np.random.default_rng(i).normal(size=(size, *shape)).astype(np.float32)
  obs = {key: draw(0, *shape) for key, shape in networks.obs_sizes.items()}
  zero: Any = np.zeros(size, np.float32)
  action: Any = np.tanh(draw(1, networks.action_size))
  made = Transition(obs, obs, action, draw(2), zero, zero, zero + 1)
  made = made.replace(target=draw(3), next_embedding=draw(4, 16))
  return made.replace(**changes)


def test_histograms_have_the_published_values() -> None:
  bins = HLGauss(-10, 10, 151)
  for value, mean in ((0, 0), (1, 1), (10, 9.9508), (99, 9.9508)):
    probabilities = bins.encode(jnp.float32(value))
    assert float(bins.decode(jnp.log(probabilities))) == pytest.approx(mean, abs=1e-3)
  at_0 = np.asarray(bins.encode(jnp.float32(0)))
  assert at_0.max() == pytest.approx(0.4950, abs=1e-4)
  assert -(at_0 * np.log(np.maximum(at_0, 1e-30))).sum() == pytest.approx(1.2003, abs=1e-3)
  small = HLGauss(-1, 1, 11).encode(jnp.float32(0.1))
  expected = [0, 0, 3e-5, 0.0038, 0.08738, 0.40879, 0.40879, 0.08738, 0.0038, 3e-5, 0]
  np.testing.assert_allclose(small, expected, atol=2e-5)
  of_returns = HLGauss(0, 150, 151)
  assert float(of_returns.decode(jnp.log(of_returns.encode(jnp.float32(0))))) == pytest.approx(0.3688, abs=1e-3)
  assert float(of_returns.decode(jnp.log(of_returns.encode(jnp.float32(75.03))))) == pytest.approx(75.03, abs=1e-2)


def test_histograms_equal_the_error_function() -> None:
  bins = HLGauss(-3, 5, 33)
  values = np.linspace(-4, 6, 50)
  edges = np.linspace(-3 - 0.125, 5 + 0.125, 34)
  below = erf((edges - np.clip(values, -3, 5)[:, None]) / (np.sqrt(2) * 0.75 * 0.25))
  expected = np.diff(below) / (below[:, -1:] - below[:, :1])
  np.testing.assert_allclose(bins.encode(jnp.asarray(values)), expected, atol=2e-6)


@pytest.mark.parametrize("seed", range(5))
def test_returns_equal_a_loop(seed: int) -> None:
  rng = np.random.default_rng(seed)
  steps, envs, discounting, decay = 9, 40, 0.97, 0.9
  reward, value = rng.normal(size=(2, steps, envs))
  done = (rng.random((steps, envs)) < 0.3).astype(float)
  truncation = done * (rng.random((steps, envs)) < 0.5)
  expected = np.zeros((steps, envs))
  for env in range(envs):
    later = value[-1, env]
    for t in reversed(range(steps)):
      if truncation[t, env]:
        ahead = value[t, env]
      elif done[t, env]:
        ahead = 0.0
      else:
        ahead = decay * later + (1 - decay) * value[t, env]
      later = expected[t, env] = reward[t, env] + discounting * ahead
  steps = [jnp.asarray(x) for x in (reward, value, done, truncation)]
  found = lambda_returns(steps[0], steps[1], steps[2], steps[3], discounting, decay)
  np.testing.assert_allclose(found, expected, rtol=2e-5, atol=1e-5)


def test_the_critic_knows_nothing_at_first(networks: REPPONetworks, params: Any) -> None:
  data = batch(networks)
  value = jax.jit(lambda q: networks.bins.decode(networks.q(q, data.obs, data.action)[0]))(params.q)
  assert float(np.abs(value).max()) < 5e-3


def test_the_divergence_is_that_of_samples(networks: REPPONetworks) -> None:
  old, new = (0.3 * jax.random.normal(jax.random.PRNGKey(i), (1, 2 * networks.action_size)) for i in (0, 1))
  normal = networks.distribution.create_dist(old)
  raw = normal.loc + normal.scale * jax.random.normal(jax.random.PRNGKey(2), (200_000, networks.action_size))
  log_prob = lambda logits: networks.distribution.log_prob(jnp.broadcast_to(logits, (len(raw), logits.shape[1])), raw)
  sampled = (log_prob(old) - log_prob(new)).mean()
  assert float(networks.kl(old, new)[0]) == pytest.approx(float(sampled), rel=0.05)
  assert float(networks.kl(old, old)[0]) == pytest.approx(0, abs=1e-6)


@pytest.fixture(scope="module")
def actor_gradients(networks: REPPONetworks, params: Any) -> Any:
  """Gradients for the actor's parameters and the critic's, and what is logged; `shift` moves the old policy away."""
  data = batch(networks)

  @jax.jit
  def compiled(target_entropy: jax.Array, shift: jax.Array) -> Any:
    config = dataclasses.replace(SMALL, target_entropy=target_entropy)
    old = networks.logits(params.policy, data.obs) + shift
    loss = lambda actor, q: actor_loss(actor, q, data, old, jax.random.PRNGKey(1), networks, config)
    return jax.grad(loss, argnums=(0, 1), has_aux=True)((params.policy, params.log_alpha, params.log_beta), params.q)

  def gradients(target_entropy: float = SMALL.target_entropy, shift: float = 0.0) -> tuple[Any, Any, dict[str, Any]]:
    grads, log = compiled(jnp.float32(target_entropy), jnp.float32(shift))
    return grads[0], grads[1], dict(zip(ACTOR_LOSSES, log, strict=True))

  return gradients


def test_the_multipliers_move_towards_their_targets(networks: REPPONetworks, actor_gradients: Any) -> None:
  (_, alpha, beta), _, log = actor_gradients(-5.0)
  assert log["entropy"] > -5.0 * networks.action_size
  assert alpha > 0, "too random: the temperature falls"
  assert log["kl"] < SMALL.kl_bound
  assert beta > 0, "near: the multiplier falls"
  (_, alpha, beta), _, log = actor_gradients(5.0, shift=3.0)
  assert alpha < 0
  assert log["kl"] > SMALL.kl_bound
  assert beta < 0
  entropy = float(log["entropy"]) / networks.action_size
  (_, alpha, _), _, _ = actor_gradients(entropy)
  assert float(alpha) == pytest.approx(0, abs=1e-8), "at the target it stays"


def test_the_actor_does_not_teach_the_critic(actor_gradients: Any) -> None:
  _, q, _ = actor_gradients()
  assert all(float(jnp.abs(leaf).max()) == 0 for leaf in jax.tree.leaves(q))


def test_too_far_away_only_the_divergence_counts(networks: REPPONetworks, params: Any, actor_gradients: Any) -> None:
  data = batch(networks)

  @jax.jit
  def divergence(policy: Any) -> tuple[jax.Array, Any]:
    old = networks.logits(params.policy, data.obs) + 3.0
    kl = lambda policy: networks.kl(old, networks.logits(policy, data.obs))
    return kl(policy).min(), jax.grad(lambda policy: jnp.exp(params.log_beta) * kl(policy).mean())(policy)

  smallest, expected = divergence(params.policy)
  assert float(smallest) > SMALL.kl_bound
  (ours, _, _), _, _ = actor_gradients(shift=3.0)
  jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-7), ours, expected)


@pytest.fixture(scope="module")
def critic(networks: REPPONetworks, params: Any) -> Any:
  """Gradients of the critic's loss on a batch, and what is logged."""
  return jax.jit(lambda data: jax.grad(critic_loss, has_aux=True)(params.q, data, networks, SMALL))


def test_the_critic_learns_nothing_from_broken_steps(networks: REPPONetworks, critic: Any) -> None:
  grads, _ = critic(batch(networks, valid=np.zeros(32, np.float32)))
  assert all(float(np.abs(leaf).max()) == 0 for leaf in jax.tree.leaves(grads))


def test_the_auxiliary_loss_ends_with_the_episode(networks: REPPONetworks, critic: Any) -> None:
  _, log = critic(batch(networks, done=np.ones(32, np.float32)))
  assert float(log[2]) == 0
  assert float(critic(batch(networks))[1][2]) > 0


@pytest.mark.parametrize(
  ("changes", "sentence"),
  [
    ({"num_minibatches": 63}, "must be a multiple of agent.num_minibatches=63"),
    ({"min_value": 1.0}, "must hold 0 between them"),
    ({"num_envs": 1001}, "must be a multiple of the number of devices, 2"),
  ],
)
def test_sizes_that_do_not_go_together(changes: dict[str, Any], sentence: str) -> None:
  with pytest.raises(ConfigError, match=sentence):
    dataclasses.replace(REPPOConfig(num_timesteps=1000), **changes).check(2)
