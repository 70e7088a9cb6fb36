"""FastTD3's parts against their formulas."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.errors import ConfigError
from playground.learning.fast_td3 import FastTD3Networks, critic_loss, policy_loss
from playground.learning.hyperparameters import C51NetworkConfig, FastTD3Config
from playground.learning.off_policy import Transition
from tests.dummy import PointTask
from tests.learning.test_c51 import projected

SMALL = FastTD3Config(
  num_timesteps=1000,
  network=C51NetworkConfig(policy_hidden_layer_sizes=(16, 16), q_hidden_layer_sizes=(16, 16)),
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
  return Transition(obs, obs, action, draw(2), jnp.ones(size), jnp.zeros(size)).replace(**changes)


def loss_of(networks: FastTD3Networks, config: FastTD3Config, data: Transition) -> float:
  params, target = networks.init(jax.random.PRNGKey(0)), networks.init(jax.random.PRNGKey(9))
  return float(critic_loss(params.q, target.q, params.policy, data, jax.random.PRNGKey(1), networks, config)[0])


@pytest.mark.parametrize("smaller", [True, False])
def test_the_critics_learn_from_one_whole_distribution(networks: FastTD3Networks, smaller: bool) -> None:
  config = dataclasses.replace(SMALL, use_smaller_q=smaller, policy_noise=0.0)
  data = batch(networks, discount=jnp.tile(jnp.array([0.0, 1.0]), 8))
  params, target = networks.init(jax.random.PRNGKey(0)), networks.init(jax.random.PRNGKey(9))
  action = networks.mode(params.policy, data.next_obs)
  following = np.asarray(jax.nn.softmax(networks.q(target.q, data.next_obs, action)), np.float64)
  log = np.asarray(jax.nn.log_softmax(networks.q(params.q, data.obs, data.action)), np.float64)
  expected = 0.0
  for i in range(16):
    discount = config.discounting * float(data.discount[i])
    each = [projected(following[k, i], float(data.reward[i]), discount, -3, 3) for k in (0, 1)]
    values = [(one * np.linspace(-3, 3, 21)).sum() for one in each]
    for k in (0, 1):
      target_k = each[0 if values[0] < values[1] else 1] if smaller else each[k]
      expected -= (target_k * log[k, i]).sum() / 16
  assert loss_of(networks, config, data) == pytest.approx(expected, rel=1e-4)


def test_a_terminal_step_is_worth_its_reward(networks: FastTD3Networks) -> None:
  data = batch(networks, discount=jnp.zeros(16), reward=jnp.full(16, 0.3))
  params = networks.init(jax.random.PRNGKey(0))
  log = jax.nn.log_softmax(networks.q(params.q, data.obs, data.action))
  assert loss_of(networks, SMALL, data) == pytest.approx(float(-log[..., 11].mean(axis=1).sum()), rel=1e-4)


def test_broken_steps_teach_nothing(networks: FastTD3Networks) -> None:
  assert loss_of(networks, SMALL, batch(networks, nonfinite=jnp.ones(16))) == 0


def test_the_actor_begins_near_0_and_climbs(networks: FastTD3Networks) -> None:
  params, data = networks.init(jax.random.PRNGKey(0)), batch(networks)
  assert float(jnp.abs(networks.mode(params.policy, data.obs)).max()) < 0.2
  value = lambda policy: -policy_loss(policy, params.q, data, networks, SMALL)
  slope = jax.grad(value)(params.policy)
  moved = jax.tree.map(lambda p, g: p + 0.05 * g, params.policy, slope)
  assert value(moved) > value(params.policy)
  either = -policy_loss(params.policy, params.q, data, networks, dataclasses.replace(SMALL, use_smaller_q=False))
  assert value(params.policy) < either


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
