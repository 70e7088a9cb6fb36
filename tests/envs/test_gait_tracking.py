"""Gait tracking on recorded states, without compiling physics: observations, rewards, starts, and 0.2.0's slips."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground import registry
from playground.config import compose
from playground.envs.base import State
from playground.errors import UnknownNameError
from tests.envs.golden import load_task, recorded, terms

SPOT, H1, INPLACE = "SpotJoystickGaitTracking", "H1JoystickGaitTracking", "H1InplaceGaitTracking"


def evaluate(env: Any, state: State, **data: Any) -> State:
  """A step to `data`, as the first of an episode."""
  state = env.disturb(state.replace(obs=jnp.zeros(env.observation_size)))
  return env.evaluate(state.data.replace(**data), state.info, jnp.zeros(env.action_size))


def part(env: Any, state: State, name: str) -> np.ndarray:
  """A part of the observation."""
  parts = env.observation_parts["state"]
  start = sum(parts[other] for other in list(parts)[: list(parts).index(name)])
  return np.asarray(state.obs)[start : start + parts[name]]


@pytest.mark.parametrize("parity", [False, True])
def test_spot_sees_the_command(parity: bool) -> None:
  env = load_task(SPOT, {"parity": parity, "noise.level": 0.0})
  state = recorded(SPOT)
  assert env.observation_size == sum(env.observation_parts["state"].values()) == (69 if parity else 72)
  assert ("command" in env.observation_parts["state"]) != parity
  if not parity:
    np.testing.assert_array_equal(part(env, evaluate(env, state), "command"), state.info["command"])


def test_the_gait_is_observed() -> None:
  env = load_task(SPOT)
  after = evaluate(env, recorded(SPOT, gait=jnp.array(4), gait_freq=jnp.array(2.5), foot_height=jnp.array(0.3)))
  assert [part(env, after, name)[0] for name in ("gait", "gait_frequency")] == [4, 2.5]
  np.testing.assert_allclose(part(env, after, "foot_height"), 0.3)


@pytest.mark.parametrize("parity", [False, True])
def test_spots_base_stays_level_but_in_gaits_that_fly(parity: bool) -> None:
  env = load_task(SPOT, {"parity": parity})
  address = env.mj_model.sensor("global_linvel").adr[0] + 2
  for gait, flies in enumerate((False, False, False, True, True)):
    state = recorded(SPOT, gait=jnp.array(gait))
    after = evaluate(env, state, sensordata=state.data.sensordata.at[address].set(2.0))
    assert after.metrics["reward/lin_vel_z"] == (-2.0 if flies == parity else 0.0)


def test_costs_diminish_the_reward_but_never_take_its_sign() -> None:
  env = load_task(SPOT)
  state = recorded(SPOT)
  rewards = terms(evaluate(env, state))
  gains = sum(value for value in rewards.values() if value > 0)
  costs = sum(value for value in rewards.values() if value < 0)
  assert gains > 0 > costs
  np.testing.assert_allclose(evaluate(env, state).reward, 0.02 * gains * np.exp(0.2 * costs), rtol=1e-5)


@pytest.mark.parametrize("parity", [False, True])
def test_h1s_contacts_are_those_of_its_feet(parity: bool) -> None:
  env = load_task(H1, {"parity": parity})
  state = recorded(H1)
  addresses = [env.mj_model.sensor(f"{geom}_floor_found").adr[0] for geom in env.config.robot.floor_contacts]
  lifted = state.data.sensordata.at[np.array(addresses)].set(0.0)
  for left in (0.0, 1.0):
    after = evaluate(env, state, sensordata=lifted.at[addresses[1]].set(left))
    assert part(env, after, "contact").tolist() == ([1, 1] if parity else [left, 0])


@pytest.mark.parametrize("parity", [False, True])
def test_h1_starts_with_its_targets_where_its_joints_are(parity: bool, monkeypatch: pytest.MonkeyPatch) -> None:
  env = load_task(H1, {"parity": parity})
  monkeypatch.setattr(env.physics, "forward", lambda model, data: data)
  state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))  # sensors are those of fresh data
  assert state.obs.shape == (113,)  # pyright: ignore[reportAttributeAccessIssue]
  start = env.reset(jax.random.PRNGKey(0))
  first = env.control(start, jnp.zeros(19))
  np.testing.assert_array_equal(first, np.zeros(19) if parity else env.robot.default_pose)
  np.testing.assert_allclose(env.control(start, jnp.full(19, 0.1)) - first, 0.03, atol=1e-6)
  assert part(env, start, "target_error_history").any() == parity


def test_in_place_nothing_is_commanded() -> None:
  env = load_task(INPLACE)
  after = evaluate(env, recorded(INPLACE))
  assert "command" not in env.observation_parts["state"]
  assert not after.info["command"].any()
  assert set(terms(after)) == {f"reward/{name}" for name in ("feet_phase", "pose", "ang_vel", "lin_vel")}


def test_other_robots_walk_in_their_gaits() -> None:
  env: Any = registry.build(compose(["env=gait_tracking", "robot=go1", "env.gait.modes=[trot]"]).env)
  assert env.observation_parts["state"]["phase"] == 8
  with pytest.raises(UnknownNameError, match=r"env\.gait\.modes: 'walk' is unknown; choose from trot"):
    registry.build(compose(["env=gait_tracking", "robot=go1"]).env)
