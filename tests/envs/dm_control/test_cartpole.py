"""Cartpole: rewards by hand, and what differs from 0.2.0."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground import registry
from playground.envs.dm_control.cartpole import Cartpole, CartpoleVision
from playground.errors import ConfigError
from tests.envs.dm_control.states import state_at
from tests.envs.golden import load_task, terms

UNSEEN = {"vision.enable": False}

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
  upright = env.post_step(state_at(env), {}, jnp.zeros(1)).reward
  np.testing.assert_allclose(upright, 1.0, atol=1e-6)
  # Every margin is reached: tolerance is 0.1, and 0 for the action.
  off = env.post_step(state_at(env, qpos=[2.0, np.pi / 2], qvel=[0.0, 5.0]), {}, jnp.ones(1)).reward
  np.testing.assert_allclose(off, 0.0 if env.config.sparse else 0.5 * 0.55 * 0.8 * 0.55, atol=1e-6)


@pytest.mark.parametrize(
  ("cart", "cosine", "reward"), [(0.24, 1.0, 1), (-0.26, 1.0, 0), (0.26, 1.0, 0), (0.0, 0.996, 1), (0.0, 0.994, 0)]
)
def test_the_sparse_reward_is_paid_near_the_middle_upright(cart: float, cosine: float, reward: int) -> None:
  env = load_task("CartpoleSwingupSparse")
  assert env.post_step(state_at(env, qpos=[cart, np.arccos(cosine)]), {}, jnp.zeros(1)).reward == reward


def test_the_terms_in_use_are_logged() -> None:
  tasks = {name: load_task(name) for name in TERMS}
  states = {name: env.post_step(state_at(env), {}, jnp.zeros(1)) for name, env in tasks.items()}
  assert {name: set(terms(state)) for name, state in states.items()} == TERMS


def test_numbers_that_are_not_finite_end_the_episode(balance: Cartpole) -> None:
  data = state_at(balance)
  broken = data.replace(qvel=data.qvel.at[0].set(jnp.nan))
  assert balance.post_step(broken, {}, jnp.zeros(1)).done == 1
  assert balance.post_step(data, {}, jnp.zeros(1)).done == 0


@pytest.mark.parametrize("name", ["CartpoleSwingup", "v020/CartpoleSwingup"])
def test_initial_velocity_is_independent_of_the_position(name: str) -> None:
  env = load_task(name)
  start = jax.vmap(env.initial)(jax.random.split(jax.random.PRNGKey(0), 500))
  qpos, qvel = start["qpos"], start["qvel"]
  correlation = np.corrcoef(qpos[:, 0], qvel[:, 0])[0, 1]
  assert (correlation > 0.99) if name.startswith("v020") else (abs(correlation) < 0.15)
  np.testing.assert_allclose([qpos[:, 1].mean(), qpos[:, 1].std()], [np.pi, 0.01], atol=2e-3)


@pytest.mark.parametrize(
  ("fields", "action", "reward", "done"),
  [
    ({}, 0.0, 0.1, 0),
    ({"qpos": [1.0, 0.0], "qvel": [-2.0, 3.0]}, -0.5, 0.1 - 0.02 - 0.02 - 0.015 - 0.0025, 0),
    ({"qpos": [0.0, np.pi / 3]}, 0.0, 0.1 - 0.25, 0),
    ({"qpos": [0.0, -1.6]}, 0.0, 0.1 - (1 - np.cos(1.6)) ** 2, 1),
    ({"qpos": [-3.1, 0.0]}, 0.0, 0.1 - 0.02 * 3.1**2, 1),
  ],
)
def test_what_the_task_for_pixels_pays(fields: dict[str, list[float]], action: float, reward: float, done: int) -> None:
  env = load_task("CartpoleBalanceVision", UNSEEN)
  state = env.post_step(state_at(env, **fields), {}, jnp.array([action]))
  np.testing.assert_allclose(state.reward, reward, atol=1e-6)
  np.testing.assert_allclose(sum(terms(state).values()), reward, atol=1e-6)
  assert state.done == done


def test_a_control_step_of_the_task_for_pixels() -> None:
  tasks = [load_task(name, UNSEEN) for name in ("CartpoleBalanceVision", "v020/CartpoleBalanceVision")]
  assert [(env.dt, env.n_substeps, env.episode_length) for env in tasks] == [(0.02, 2, 250), (0.01, 1, 250)]


def test_a_hanging_pole_would_end_the_task_for_pixels() -> None:
  assert registry.task_class(str(registry.config("CartpoleBalanceVision").task)) is CartpoleVision
  with pytest.raises(ConfigError, match=r"env.swing_up and env.sparse must be false"):
    registry.load("CartpoleBalanceVision", overrides={**UNSEEN, "swing_up": True})
