"""Cartpole: rewards by hand, and what differs from 0.2.0."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.envs.dm_control.cartpole import Cartpole
from tests.envs.dm_control.states import state_at
from tests.envs.golden import load_task

TERMS = {
  "CartpoleBalance": {f"reward/{name}" for name in ("upright", "centered", "small_control", "small_velocity")},
  "CartpoleSwingupSparse": {"reward/cart_in_bounds", "reward/angle_in_bounds"},
}


@pytest.fixture(scope="module")
def balance() -> Cartpole:
  return load_task("CartpoleBalance")


@pytest.mark.parametrize("name", ["CartpoleBalance", "CartpoleBalanceSparse"])
def test_rewards_by_hand(name: str) -> None:
  env = load_task(name)
  upright = env.evaluate(state_at(env), {}, jnp.zeros(1)).reward
  np.testing.assert_allclose(upright, 1.0, atol=1e-6)
  # Every margin is reached: tolerance is 0.1, and 0 for the action.
  off = env.evaluate(state_at(env, qpos=[2.0, np.pi / 2], qvel=[0.0, 5.0]), {}, jnp.ones(1)).reward
  np.testing.assert_allclose(off, 0.0 if env.config.sparse else 0.5 * 0.55 * 0.8 * 0.55, atol=1e-6)


def test_the_terms_in_use_are_logged() -> None:
  tasks = {name: load_task(name) for name in TERMS}
  metrics = {name: env.evaluate(state_at(env), {}, jnp.zeros(1)).metrics for name, env in tasks.items()}
  assert {name: set(terms) for name, terms in metrics.items()} == TERMS


def test_numbers_that_are_not_finite_end_the_episode(balance: Cartpole) -> None:
  data = state_at(balance)
  broken = data.replace(qvel=data.qvel.at[0].set(jnp.nan))
  assert balance.evaluate(broken, {}, jnp.zeros(1)).done == 1
  assert balance.evaluate(data, {}, jnp.zeros(1)).done == 0


@pytest.mark.parametrize("parity", [False, True])
def test_initial_velocity_is_independent_of_the_position(parity: bool) -> None:
  env = load_task("CartpoleSwingup", {"parity": parity})
  start = jax.vmap(env.initial)(jax.random.split(jax.random.PRNGKey(0), 500))
  qpos, qvel = start["qpos"], start["qvel"]
  correlation = np.corrcoef(qpos[:, 0], qvel[:, 0])[0, 1]
  assert (correlation > 0.99) if parity else (abs(correlation) < 0.15)
  np.testing.assert_allclose([qpos[:, 1].mean(), qpos[:, 1].std()], [np.pi, 0.01], atol=2e-3)
