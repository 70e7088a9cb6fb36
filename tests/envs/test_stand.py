"""Handstand and footstand: which legs mean what, what actions mean, and what ends an episode."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground import registry
from playground.config import compose
from playground.envs.base import State
from playground.envs.locomotion.stand import Stand
from playground.errors import UnknownNameError
from tests.envs.golden import golden, load_task, terms

FEET = ["FR", "FL", "RR", "RL"]


@pytest.fixture(scope="module")
def hand() -> Stand:
  return load_task("Go1Handstand")


@pytest.fixture(scope="module")
def state() -> State:
  """A recorded state, its robot in the air: sensors of contact are silent."""
  recording = golden("Go1Handstand")
  state = jax.tree.map(lambda x: x[4], recording.states)
  assert not touching(state, recording.env)
  return state


def touching(state: State, env: Any) -> list[str]:
  """Geoms of which a sensor says that they touch the floor."""
  sensors = [env.mj_model.sensor(i) for i in range(env.mj_model.nsensor)]
  found = {s.name.removesuffix("_floor_found"): s.adr[0] for s in sensors if s.name.endswith("_floor_found")}
  return [geom for geom, address in found.items() if state.data.sensordata[address] > 0]


def touch(env: Stand, state: State, geom: str) -> State:
  """The state after a step in which the geom touches the floor (both stands have equally many sensors)."""
  address = env.mj_model.sensor(f"{geom}_floor_found").adr[0]
  return evaluate(env, state, sensordata=state.data.sensordata.at[address].set(1.0))


def evaluate(env: Stand, state: State, **data: Any) -> State:
  return env.post_step(state.data.replace(**data), state.info, jnp.zeros(12))


@pytest.mark.parametrize(
  ("task", "support", "lifted"), [("Go1Handstand", FEET[:2], FEET[2:]), ("Go1Footstand", FEET[2:], FEET[:2])]
)
def test_which_legs_mean_what(task: str, support: list[str], lifted: list[str], state: State) -> None:
  env = load_task(task)
  for foot in FEET:
    after = touch(env, state, foot)
    np.testing.assert_allclose(after.metrics["reward/feet_contact"], -0.1 if foot in lifted else 0, rtol=1e-6)
    assert after.done == 0
  for i, joint in enumerate(env.config.robot.joints):
    moved = evaluate(env, state, qpos=env.robot.init_qpos.at[7 + i].add(0.1))
    cost = moved.metrics["reward/lifted_leg_deviation_l2"]
    np.testing.assert_allclose(cost, -0.001 if joint[:2] in lifted else 0, rtol=1e-4)
  for foot in support:
    for part in ("hip", "thigh1", "thigh2", "thigh3", "calf1", "calf2"):
      assert touch(env, state, f"{foot.lower()}_{part}").done == 1
  assert len(env.leg_geoms) == 12


def test_0_2_0_watches_the_front_legs_and_all_feet(state: State) -> None:
  env = load_task("v020/Go1Footstand")
  assert touch(env, state, "fl_calf1").done == 1
  assert [round(float(touch(env, state, foot).metrics["reward/feet_contact"]), 6) for foot in FEET] == [-0.1] * 4


def test_targets_move_on_from_the_last(hand: Stand, state: State) -> None:
  action = jnp.linspace(-1, 1, 12)
  np.testing.assert_allclose(hand.action_to_ctrl(state, action), state.data.ctrl + 0.3 * action, rtol=1e-6)


@pytest.mark.parametrize(("task", "down"), [("Go1Handstand", 1.0), ("Go1Footstand", -1.0)])
def test_rewards_of_a_robot_that_stands(task: str, down: float, state: State) -> None:
  env = load_task(task)
  nose = jnp.array([[0.0, 0, down], [0, 1, 0], [-down, 0, 0]])  # the forward axis points down, or up
  site = env.robot.base_site
  pose = {
    "site_xpos": state.data.site_xpos.at[site, 2].set(env.config.rewards.base_height_exp.params.target),
    "site_xmat": state.data.site_xmat.at[site].set(nose),
    "qpos": env.robot.init_qpos,
  }
  after = evaluate(env, state, **pose)
  rewards = {name.removeprefix("reward/"): float(value) for name, value in terms(after).items()}
  assert rewards == pytest.approx(
    {
      **{"base_height_exp": 1.0, "forward_alignment": 1.0},
      **{"feet_contact": 0.0, "lifted_leg_deviation_l2": 0.0, "joint_pos_limits": 0.0},
    },
    abs=1e-6,
  )
  np.testing.assert_allclose(after.reward, 0.02 * 2, rtol=1e-5)


def test_a_fall_ends_the_episode(hand: Stand, state: State) -> None:
  address = hand.mj_model.sensor("upvector").adr[0] + 2
  for up, done in ((-0.2, 0), (-0.3, 1)):
    assert evaluate(hand, state, sensordata=state.data.sensordata.at[address].set(up)).done == done


def test_finetuning(state: State) -> None:
  """The paper's later stages: costs of energy and acceleration, a power budget of 400 W that falls to 200 W."""
  force, velocity = jnp.full(12, 10.0), jnp.zeros(18).at[6:].set(2.5)  # 300 W
  costs = {"rewards.joint_power_l1": {"weight": -0.003}, "rewards.joint_acc_l2": {"weight": -2.5e-7}}
  for power, done in ((400.0, 0), (200.0, 1)):
    env = load_task("Go1Handstand", {"terminations.power_above": {"params": {"limit": power}}, **costs})
    after = evaluate(env, state, actuator_force=force, qvel=velocity, qacc=jnp.full(18, 100.0))
    assert after.done == done
    np.testing.assert_allclose(after.metrics["reward/joint_power_l1"], -0.9, rtol=1e-5)
    np.testing.assert_allclose(after.metrics["reward/joint_acc_l2"], -2.5e-7 * 12e4, rtol=1e-5)


def crouch(probability: float, keyframe: str) -> dict[str, Any]:
  params = {"probability": probability, "keyframe": keyframe}
  return {"events.reset_to_keyframe": {"mode": "reset", "params": params}}


def test_crouched_start() -> None:
  env = load_task("Go1Handstand", crouch(1.0, "pre_recovery"))
  env.physics.forward = lambda model, data: data  # nothing here reads what it computes
  start = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 4))
  pose = env.robot.keyframe("pre_recovery")
  np.testing.assert_array_equal(start.data.qpos[:, 7:], np.tile(pose[7:], (4, 1)))
  np.testing.assert_array_equal(start.data.ctrl, start.data.qpos[:, 7:])
  assert not start.data.qvel.any()
  assert len(np.unique(start.data.qpos[:, 0])) == 4


@pytest.mark.parametrize(
  ("overrides", "message"),
  [
    ({"support": ["FR", "FLL"]}, r"env\.support: 'FLL' is unknown.*Did you mean 'FL'\?"),
    (
      {"robot.feet": ["FR", "FL", "RX", "RL"]},
      r"^env\.robot\.feet: 'RX' is unknown; choose from .*Did you mean 'RR'\?",
    ),
    ({"robot.keyframe": "hom"}, r"the keyframe 'hom', which the model does not have.*Did you mean 'home'\?"),
    ({"rewards.lifted_leg_deviation_l2.func": "joint_deviation"}, "Did you mean 'joint_deviation_l"),
  ],
)
def test_unknown_names(overrides: dict[str, Any], message: str) -> None:
  with pytest.raises(UnknownNameError, match=message):
    load_task("Go1Handstand", overrides)


@pytest.mark.parametrize(
  ("params", "message"),
  [
    ({"rewards.feet_contact.params.feet": ["RX"]}, "feet: 'RX' is unknown"),
    ({"rewards.lifted_leg_deviation_l2.params.joints": "lifted_leg"}, "Did you mean 'lifted_legs'"),
  ],
)
def test_unknown_parts_of_the_robot(params: dict[str, Any], message: str, state: State) -> None:
  """They are looked up in the first step, while it is traced."""
  with pytest.raises(UnknownNameError, match=message):
    evaluate(load_task("Go1Handstand", params), state)


def test_any_robot_with_legs_can_be_named() -> None:
  env: Any = registry.build(compose(["env=stand", "robot=spot", "env.support=[HL,HR]"]).env)
  assert set(env.leg_geoms) == {"hl_uleg", "hl_lleg1", "hl_lleg2", "hr_uleg", "hr_lleg1", "hr_lleg2"}
