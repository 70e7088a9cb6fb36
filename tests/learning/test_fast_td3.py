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


@pytest.fixture(scope="module")
def params(networks: FastTD3Networks) -> tuple[Any, Any]:
  """Of the networks, and of their targets."""
  init = jax.jit(networks.init)
  return init(jax.random.PRNGKey(0)), init(jax.random.PRNGKey(9))


def batch(networks: FastTD3Networks, size: int = 16, **changes: Any) -> Transition:
  """Made by NumPy, which compiles nothing."""
  draw: Any = lambda i, *shape: np.random.default_rng(i).normal(size=(size, *shape)).astype(np.float32)
  obs = {key: draw(0, *shape) for key, shape in networks.obs_sizes.items()}
  one: Any = np.ones(size, np.float32)
  action: Any = np.tanh(draw(1, networks.action_size))
  return Transition(obs, obs, action, draw(2), one, 0 * one).replace(**changes)


@pytest.fixture(scope="module")
def critic(networks: FastTD3Networks, params: tuple[Any, Any]) -> Any:
  """The critics' loss on a batch, for a configuration."""
  loss = jax.jit(critic_loss, static_argnums=(5, 6))
  one, target = params
  return lambda data, config=SMALL: float(
    loss(one.q, target.q, one.policy, data, jax.random.PRNGKey(1), networks, config)[0]
  )


@pytest.fixture(scope="module")
def log_probs(networks: FastTD3Networks, params: tuple[Any, Any]) -> np.ndarray:
  """Of the critics' atoms [2, 16, 21] for the steps of `batch`."""
  data = batch(networks)
  return np.asarray(
    jax.jit(lambda q: jax.nn.log_softmax(networks.q(q, data.obs, data.action)))(params[0].q), np.float64
  )


@pytest.mark.parametrize("smaller", [True, False])
def test_the_critics_learn_from_one_whole_distribution(
  networks: FastTD3Networks, params: tuple[Any, Any], critic: Any, log_probs: np.ndarray, smaller: bool
) -> None:
  config = dataclasses.replace(SMALL, use_smaller_q=smaller, policy_noise=0.0)
  data = batch(networks, discount=np.tile(np.array([0.0, 1.0], np.float32), 8))

  @jax.jit
  def following(policy: Any, q: Any) -> jax.Array:
    return jax.nn.softmax(networks.q(q, data.next_obs, networks.mode(policy, data.next_obs)))

  after = np.asarray(following(params[0].policy, params[1].q), np.float64)
  expected = 0.0
  for i in range(16):
    discount = config.discounting * float(data.discount[i])
    each = [projected(after[k, i], float(data.reward[i]), discount, -3, 3) for k in (0, 1)]
    values = [(one * np.linspace(-3, 3, 21)).sum() for one in each]
    for k in (0, 1):
      target_k = each[0 if values[0] < values[1] else 1] if smaller else each[k]
      expected -= (target_k * log_probs[k, i]).sum() / 16
  assert critic(data, config) == pytest.approx(expected, rel=1e-4)


def test_a_terminal_step_is_worth_its_reward(networks: FastTD3Networks, critic: Any, log_probs: np.ndarray) -> None:
  data = batch(networks, discount=np.zeros(16, np.float32), reward=np.full(16, 0.3, np.float32))
  assert critic(data) == pytest.approx(float(-log_probs[..., 11].mean(axis=1).sum()), rel=1e-4)


def test_broken_steps_teach_nothing(networks: FastTD3Networks, critic: Any) -> None:
  assert critic(batch(networks, nonfinite=np.ones(16, np.float32))) == 0


def test_the_actor_begins_near_0_and_climbs(networks: FastTD3Networks, params: tuple[Any, Any]) -> None:
  data, (policy, q) = batch(networks), (params[0].policy, params[0].q)

  @jax.jit
  def climbed(policy: Any) -> tuple[jax.Array, ...]:
    value = lambda policy, config=SMALL: -policy_loss(policy, q, data, networks, config)
    before, slope = jax.value_and_grad(value)(policy)
    moved = jax.tree.map(lambda p, g: p + 0.05 * g, policy, slope)
    either = value(policy, dataclasses.replace(SMALL, use_smaller_q=False))
    return jnp.abs(networks.mode(policy, data.obs)).max(), before, value(moved), either

  action, before, after, either = climbed(policy)
  assert action < 0.2
  assert after > before
  assert before < either


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
