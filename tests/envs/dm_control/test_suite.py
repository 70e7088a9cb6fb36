"""Every task of the suite: it is there, resets and steps in a batch, and its shapes and types never change."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground import registry
from playground.config import compose
from playground.errors import UnknownNameError
from tests.envs.dm_control.states import state_at
from tests.envs.dm_control.suite import COSTLY, DOMAIN, facts_of
from tests.envs.golden import BATCH, KEYS, compiled_task

OBSERVATION_SIZE = {
  "AcrobotSwingup": 6, "AcrobotSwingupSparse": 6, "BallInCup": 8, "CartpoleBalance": 5, "CartpoleBalanceSparse": 5,
  "CartpoleSwingup": 5, "CartpoleSwingupSparse": 5, "CheetahRun": 17, "FingerSpin": 9, "FingerTurnEasy": 12,
  "FingerTurnHard": 12, "FishSwim": 24, "HopperHop": 15, "HopperStand": 15, "HumanoidStand": 67, "HumanoidWalk": 67,
  "HumanoidRun": 67, "PendulumSwingup": 3, "PointMass": 4, "ReacherEasy": 6, "ReacherHard": 6, "SwimmerSwimmer6": 25,
  "WalkerRun": 24, "WalkerStand": 24, "WalkerWalk": 24,
}  # fmt: skip


def test_the_25_tasks() -> None:
  of_the_suite = lambda name: str(registry.config(name).task).startswith("playground.envs.dm_control.")
  ours = {name for name in registry.names() if of_the_suite(name) and name != "CartpoleBalanceVision"}
  assert ours == OBSERVATION_SIZE.keys() == DOMAIN.keys()


class Roll:
  """A batch of one task: its states after reset, after a step of full force and after one of none."""

  def __init__(self, name: str):
    self.name = name
    self.env: Any = compiled_task(name)
    self.first: Any = jax.vmap(self.env.reset)(KEYS)
    shape = (BATCH, self.env.action_size)
    self.second: Any = jax.vmap(self.env.step)(self.first, jnp.ones(shape))
    self.third: Any = jax.vmap(self.env.step)(self.second, jnp.zeros(shape))


TASKS = [pytest.param(name, marks=[pytest.mark.slow] * (DOMAIN[name] in COSTLY)) for name in OBSERVATION_SIZE]


@pytest.fixture(params=TASKS, scope="module")
def roll(request: pytest.FixtureRequest) -> Roll:
  return Roll(request.param)


def test_sizes(roll: Roll) -> None:
  env, size = roll.env, OBSERVATION_SIZE[roll.name]
  assert roll.first.obs.shape == (BATCH, size)
  assert env.observation_size == sum(env.observation_parts["state"].values()) == size
  assert env.action_size == facts_of(roll.name)["counts"]["nu"]
  assert roll.first.reward.shape == roll.first.done.shape == (BATCH,)


def test_structure_and_types_stay(roll: Roll) -> None:
  for state in (roll.second, roll.third):
    assert jax.tree.structure(state) == jax.tree.structure(roll.first)  # the keys of metrics and info
    assert jax.tree.map(jax.typeof, state) == jax.tree.map(jax.typeof, roll.first)  # weak types included


def test_numbers(roll: Roll) -> None:
  for steps, state in enumerate((roll.first, roll.second, roll.third)):
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state))
    assert not state.done.any()
    assert ((state.reward >= 0) & (state.reward <= 1)).all()
    np.testing.assert_allclose(state.data.time, steps * roll.env.dt, rtol=1e-5)
  assert not any(leaf.any() for leaf in jax.tree.leaves((roll.first.reward, roll.first.metrics)))
  assert (roll.second.data.qvel != roll.first.data.qvel).any(axis=1).all()


def test_the_first_observation_shows_the_drawn_state(roll: Roll) -> None:
  """Targets included. C MuJoCo says what there is to see, but for touch: its solver goes on where ours stops."""
  seen = np.concatenate([[part != "touch"] * n for part, n in roll.env.observation_parts["state"].items()])
  for i in range(BATCH):
    data = jax.tree.map(lambda x, i=i: x[i], roll.first.data)
    expected = roll.env.observe(state_at(roll.env, qpos=data.qpos, qvel=data.qvel, mocap_pos=data.mocap_pos))
    np.testing.assert_allclose(roll.first.obs[i, seen], expected[seen], rtol=1e-5, atol=1e-5)


def test_the_reward_is_fixed() -> None:
  with pytest.raises(UnknownNameError, match=r"^env.rewards.upright has no func: the reward of DM Control"):
    registry.check(compose(["env=WalkerWalk", "env.rewards.upright.weight=2"]).env)
  with pytest.raises(UnknownNameError, match=r"^env.observations.state does not exist: .* no terms"):
    compose(["env=WalkerWalk", "env.observations.state=null"])
