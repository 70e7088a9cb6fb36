"""FastTD3's parts against their formulas."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.errors import ConfigError
from playground.learning.fast_td3 import Atoms, FastTD3Networks, Transition, critic_loss, n_step, policy_loss
from playground.learning.hyperparameters import FastTD3Config, FastTD3NetworkConfig
from tests.dummy import PointTask

SMALL = FastTD3Config(
  num_timesteps=1000,
  network=FastTD3NetworkConfig(policy_hidden_layer_sizes=(16, 16), q_hidden_layer_sizes=(16, 16)),
  num_atoms=21,
  min_value=-3,
  max_value=3,
)


@pytest.fixture(scope="module")
def networks() -> FastTD3Networks:
  return FastTD3Networks(PointTask(), SMALL, None)


def batch(networks: FastTD3Networks, size: int = 16, **changes: Any) -> Transition:
  draw = lambda i, *shape: jax.random.normal(jax.random.PRNGKey(i), (size, *shape))
  obs = {key: draw(0, *shape) for key, shape in networks.obs_sizes.items()}
  action = jnp.tanh(draw(1, networks.action_size))
  return Transition(obs, obs, action, draw(2), jnp.ones(size), jnp.ones(size)).replace(**changes)


def projected(p: np.ndarray, reward: float, discount: float, low: float, high: float) -> np.ndarray:
  """By a loop, as Bellemare et al. have it."""
  count = len(p)
  step = (high - low) / (count - 1)
  out = np.zeros(count)
  for i, share in enumerate(p):
    place = (np.clip(reward + discount * (low + i * step), low, high) - low) / step
    lower, upper = int(np.floor(place)), int(np.ceil(place))
    if lower == upper:
      out[lower] += share
    else:
      out[lower] += share * (upper - place)
      out[upper] += share * (place - lower)
  return out


def test_projections_have_the_published_values() -> None:
  atoms, at_1 = Atoms(-10, 10, 101), jnp.zeros(101).at[55].set(1.0)
  project = lambda p, *x: np.asarray(atoms.project(p, *map(jnp.float32, x)))
  one = project(at_1, 0.05, 0.97)
  assert one[[55, 56]] == pytest.approx([0.9, 0.1], abs=1e-4)
  assert project(at_1, 0.4, 0.0)[52] == pytest.approx(1, abs=1e-4)
  assert project(at_1, -50.0, 1.0)[0] == pytest.approx(1, abs=1e-6)
  small = Atoms(-1, 1, 5).project(jnp.array([0.1, 0.2, 0.3, 0.25, 0.15]), jnp.float32(0.1), jnp.float32(0.9))
  np.testing.assert_allclose(small, [0.06, 0.18, 0.30, 0.285, 0.175], atol=1e-6)


def test_projections_equal_a_loop() -> None:
  rng = np.random.default_rng(0)
  p = rng.dirichlet(np.ones(21), size=60)
  reward = np.concatenate([rng.normal(size=40), np.zeros(10), rng.choice([-9.0, 9.0, 0.3], 10)])
  discount = np.concatenate([rng.random(40), np.ones(10), rng.choice([0.0, 1.0], 10)])
  found = Atoms(-3, 3, 21).project(jnp.asarray(p), jnp.asarray(reward), jnp.asarray(discount))
  expected = [projected(*row, -3, 3) for row in zip(p, reward, discount, strict=True)]
  np.testing.assert_allclose(found, expected, atol=2e-6)
  np.testing.assert_allclose(found.sum(axis=-1), 1, atol=1e-5)


def loss_of(networks: FastTD3Networks, config: FastTD3Config, data: Transition) -> float:
  params, target = networks.init(jax.random.PRNGKey(0)), networks.init(jax.random.PRNGKey(9))
  return float(critic_loss(params.q, target.q, params.policy, data, jax.random.PRNGKey(1), networks, config)[0])


@pytest.mark.parametrize("smaller", [True, False])
def test_the_critics_learn_from_one_whole_distribution(networks: FastTD3Networks, smaller: bool) -> None:
  config = dataclasses.replace(SMALL, use_smaller_q=smaller, policy_noise=0.0)
  data = batch(networks, bootstrap=jnp.tile(jnp.array([0.0, 1.0]), 8))
  params, target = networks.init(jax.random.PRNGKey(0)), networks.init(jax.random.PRNGKey(9))
  action = networks.mode(params.policy, data.next_obs)
  following = np.asarray(jax.nn.softmax(networks.q(target.q, data.next_obs, action)), np.float64)
  log = np.asarray(jax.nn.log_softmax(networks.q(params.q, data.obs, data.action)), np.float64)
  expected = 0.0
  for i in range(16):
    discount = config.discounting * float(data.bootstrap[i])
    each = [projected(following[k, i], float(data.reward[i]), discount, -3, 3) for k in (0, 1)]
    values = [(one * np.linspace(-3, 3, 21)).sum() for one in each]
    for k in (0, 1):
      target_k = each[0 if values[0] < values[1] else 1] if smaller else each[k]
      expected -= (target_k * log[k, i]).sum() / 16
  assert loss_of(networks, config, data) == pytest.approx(expected, rel=1e-4)


def test_a_terminal_step_is_worth_its_reward(networks: FastTD3Networks) -> None:
  data = batch(networks, bootstrap=jnp.zeros(16), reward=jnp.full(16, 0.3))
  params = networks.init(jax.random.PRNGKey(0))
  log = jax.nn.log_softmax(networks.q(params.q, data.obs, data.action))
  assert loss_of(networks, SMALL, data) == pytest.approx(float(-log[..., 11].mean(axis=1).sum()), rel=1e-4)


def test_broken_steps_teach_nothing(networks: FastTD3Networks) -> None:
  assert loss_of(networks, SMALL, batch(networks, valid=jnp.zeros(16))) == 0


def test_the_actor_begins_near_0_and_climbs(networks: FastTD3Networks) -> None:
  params, data = networks.init(jax.random.PRNGKey(0)), batch(networks)
  assert float(jnp.abs(networks.mode(params.policy, data.obs)).max()) < 0.2
  value = lambda policy: -policy_loss(policy, params.q, data, networks, SMALL)
  slope = jax.grad(value)(params.policy)
  moved = jax.tree.map(lambda p, g: p + 0.05 * g, params.policy, slope)
  assert value(moved) > value(params.policy)
  either = -policy_loss(params.policy, params.q, data, networks, dataclasses.replace(SMALL, use_smaller_q=False))
  assert value(params.policy) < either


def test_returns_of_several_steps_equal_a_loop() -> None:
  rng, discounting = np.random.default_rng(0), 0.9
  done, cut = (rng.random((4, 200)) < 0.3).astype(np.float32), (rng.random((4, 200)) < 0.5).astype(np.float32)
  reward, valid = rng.normal(size=(4, 200)).astype(np.float32), (rng.random((4, 200)) < 0.9).astype(np.float32)
  obs = {"state": np.arange(4 * 200, dtype=np.float32).reshape(4, 200, 1)}
  bootstrap = 1 - done * (1 - cut)
  found = n_step(Transition(obs, {"state": obs["state"] + 0.5}, obs["state"], reward, bootstrap, valid, done), 0.9)  # pyright: ignore[reportArgumentType]
  for i in range(200):
    length = next((k for k in range(4) if done[k, i]), 3) + 1
    expected = sum(discounting**k * reward[k, i] for k in range(length))
    assert float(found.reward[i]) == pytest.approx(expected, rel=1e-5, abs=1e-6)
    assert float(found.bootstrap[i]) == pytest.approx(bootstrap[length - 1, i] * discounting ** (length - 1), rel=1e-5)
    assert float(found.valid[i]) == valid[:length, i].prod()
    assert float(found.next_obs["state"][i, 0]) == obs["state"][length - 1, i, 0] + 0.5
  np.testing.assert_array_equal(found.obs["state"], obs["state"][0])
  np.testing.assert_array_equal(found.action, obs["state"][0])


@pytest.mark.parametrize(
  ("changes", "sentence"),
  [
    ({"max_replay_size": 1000}, "agent.max_replay_size=1000 must not be below agent.num_envs=1024"),
    ({"min_noise": 1.0}, "agent.max_noise=0.4 must not be below agent.min_noise=1.0"),
    ({"max_value": -1.0}, "must hold 0 between them"),
    ({"num_steps": 11}, "agent.num_steps=11: agent.min_replay_size=10240"),
    ({"batch_size": 32_769}, "must be a multiple of the number of devices, 2"),
  ],
)
def test_sizes_that_do_not_go_together(changes: dict[str, Any], sentence: str) -> None:
  with pytest.raises(ConfigError, match=sentence):
    dataclasses.replace(FastTD3Config(num_timesteps=1000), **changes).check(2)
