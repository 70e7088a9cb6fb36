"""What is PPO's own; what it shares with the other algorithms is in test_learner.py."""

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from jax.sharding import PartitionSpec as P

from playground.errors import ConfigError
from playground.hardware.mesh import jit_on_mesh
from playground.learning.losses import Batch
from playground.learning.networks import NetworkConfig
from playground.learning.ppo import PPO
from tests.dummy import SMALL_PPO, numbers, point_learner


def test_a_bad_gradient_is_left_out() -> None:
  learner = point_learner(SMALL_PPO)
  assert isinstance(learner, PPO)
  flat, unravel = ravel_pytree(learner.networks.init(jax.random.PRNGKey(0)))
  start = (flat, learner.optimizer.init(flat))
  rng = np.random.default_rng(0)
  obs = {"state": rng.normal(size=(5, 8, 2)), "privileged_state": rng.normal(size=(5, 8, 4))}
  zeros = np.zeros((5, 8), np.float32)
  last_obs = jax.tree.map(lambda x: x[0], obs)
  batch: Any = Batch(obs, last_obs, rng.normal(size=(5, 8, 2)), zeros, zeros * np.nan, zeros, zeros)  # pyright: ignore
  step = lambda batch, carry, x: learner._sgd_step(batch, unravel, carry, x)
  mapped = jit_on_mesh(step, learner.mesh, (P(), P(), P()), P())
  columns = np.arange(8)
  after, log = mapped(batch, start, (columns, jax.random.PRNGKey(0)))
  np.testing.assert_array_equal(log, [*np.zeros(len(log) - 1), 1.0])
  for a, b in zip(numbers(start), numbers(after), strict=True):
    np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
  ("change", "words"),
  [
    ({"num_envs": 24}, ["agent.num_envs=24", "multiple", "32"]),
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
    point_learner(config)


def test_environments_can_start_at_all_ages() -> None:
  state = lambda learner: learner.init(jax.random.PRNGKey(0), {}).env_state
  same_age, mixed = (
    state(point_learner(dataclasses.replace(SMALL_PPO, init_at_random_ep_len=mix), num_devices=2))
    for mix in (False, True)
  )
  np.testing.assert_array_equal(same_age.info["steps"], 0)
  ages = np.asarray(mixed.info["steps"])
  assert ages.min() >= 0 and ages.max() < 20, "an episode is 20 steps"
  assert len(set(ages)) > 4
  assert set(ages[: len(ages) // 2]) != set(ages[len(ages) // 2 :]), "each device draws its own"
  np.testing.assert_array_equal(same_age.obs["state"], mixed.obs["state"])
