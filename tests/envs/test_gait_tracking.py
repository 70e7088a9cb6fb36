"""Gait tracking on recorded states, without compiling physics: observations, rewards and starts."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground import registry
from playground.config import compose
from playground.envs.base import State
from playground.errors import UnknownNameError
from tests.envs.golden import recorded, terms, without_physics

SPOT, H1, INPLACE = "SpotJoystickGaitTracking", "H1JoystickGaitTracking", "H1InplaceGaitTracking"


@pytest.fixture(scope="module")
def spot() -> Any:
  return without_physics(SPOT, noise_level=0.0)


@pytest.fixture(scope="module")
def h1() -> Any:
  return without_physics(H1)


def evaluate(env: Any, state: State, **data: Any) -> State:
  return env.post_step(state.data.replace(**data), state.info, jnp.zeros(env.action_size))


def part(env: Any, state: State, name: str) -> np.ndarray:
  """A part of the observation."""
  parts = env.observation_parts["state"]
  start = sum(parts[other] for other in list(parts)[: list(parts).index(name)])
  return np.asarray(state.obs)[start : start + parts[name]]


def test_what_spot_observes(spot: Any) -> None:
  frequency = {"gait": jnp.array(4), "gait_freq": jnp.array(2.5), "foot_height": jnp.array(0.3)}
  state = recorded(SPOT, **frequency)
  after = evaluate(spot, state)
  assert spot.observation_size == sum(spot.observation_parts["state"].values()) == 72
  np.testing.assert_array_equal(part(spot, after, "command"), state.info["command"])
  expected = state.data.qpos[7:] - spot.robot.default_pose
  np.testing.assert_allclose(part(spot, after, "joint_pos_rel"), expected, rtol=1e-6)
  assert [part(spot, after, name)[0] for name in ("gait", "gait_frequency")] == [4, 2.5]
  np.testing.assert_allclose(part(spot, after, "foot_height"), 0.3)


def test_spots_base_stays_level_but_in_gaits_that_fly(spot: Any) -> None:
  address = spot.mj_model.sensor("global_linvel").adr[0] + 2
  for gait, flies in enumerate((False, False, False, True, True)):
    state = recorded(SPOT, gait=jnp.array(gait))
    after = evaluate(spot, state, sensordata=state.data.sensordata.at[address].set(2.0))
    assert after.metrics["reward/lin_vel_z_l2_in_gaits"] == (0.0 if flies else -2.0)


def test_costs_diminish_the_reward_but_never_take_its_sign(spot: Any) -> None:
  after = evaluate(spot, recorded(SPOT))
  gains = sum(value for value in terms(after).values() if value > 0)
  costs = sum(value for value in terms(after).values() if value < 0)
  assert gains > 0 > costs
  np.testing.assert_allclose(after.reward, 0.02 * gains * np.exp(0.2 * costs), rtol=1e-5)


def test_h1s_contacts_are_those_of_its_feet(h1: Any) -> None:
  state = recorded(H1)
  addresses = [h1.mj_model.sensor(f"{geom}_floor_found").adr[0] for geom in h1.config.robot.floor_contacts]
  lifted = state.data.sensordata.at[np.array(addresses)].set(0.0)
  for left in (0.0, 1.0):
    after = evaluate(h1, state, sensordata=lifted.at[addresses[1]].set(left))
    assert part(h1, after, "contact").tolist() == [left, 0]


def test_h1_starts_with_its_targets_where_its_joints_are(h1: Any) -> None:
  assert h1.observation_size == 113
  start = h1.reset(jax.random.PRNGKey(0))
  first = h1.action_to_ctrl(start, jnp.zeros(19))
  np.testing.assert_array_equal(first, h1.robot.default_pose)
  np.testing.assert_allclose(h1.action_to_ctrl(start, jnp.full(19, 0.1)) - first, 0.03, atol=1e-6)
  assert not part(h1, start, "target_error").any()


def test_in_place_nothing_is_commanded() -> None:
  env = without_physics(INPLACE)
  after = evaluate(env, recorded(INPLACE))
  assert "command" not in env.observation_parts["state"]
  assert not after.info["command"].any()
  names = {name.removeprefix("reward/") for name in terms(after)}
  assert names == {"feet_phase_exp", "pose_l2", "ang_vel_l2", "lin_vel_xy_l2"}


def test_other_robots_walk_in_their_gaits() -> None:
  modes = "env.commands.gait.params.modes"
  env: Any = registry.build(compose(["env=gait_tracking", "robot=go1", f"{modes}=[trot]"]).env)
  assert env.observation_parts["state"]["phase"] == 8
  with pytest.raises(UnknownNameError, match=rf"{modes}: 'walk' is unknown; choose from trot"):
    registry.build(compose(["env=gait_tracking", "robot=go1"]).env)
