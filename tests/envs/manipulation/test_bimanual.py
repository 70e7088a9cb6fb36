"""ALOHA's tasks: what is rewarded, when an episode ends and what counts as success.

On recorded states of Playground 0.2.0, with poses replaced: no physics is computed.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.envs.base import State
from playground.envs.manipulation.bimanual import Bimanual
from playground.envs.manipulation.handover import HandOver
from playground.envs.manipulation.peg import SinglePegInsertion
from tests.envs.golden import golden, load_task

HANDOVER, PEG = "AlohaHandOver", "AlohaSinglePegInsertion"


@pytest.fixture(scope="module")
def peg() -> SinglePegInsertion:
  return compiled(PEG)


@pytest.fixture(scope="module")
def handover() -> HandOver:
  return compiled(HANDOVER)


@functools.cache
def compiled(name: str) -> Any:
  env = load_task(name)
  env.evaluate = jax.jit(env.evaluate)
  return env


def step(env: Bimanual, state: State, sites: Any = None, bodies: Any = None, **info: Any) -> State:
  """The state after a step that ended with sites and bodies where they are said to be, m."""
  data = state.data
  for name, place in (sites or {}).items():
    data = data.replace(site_xpos=data.site_xpos.at[env.mj_model.site(name).id].set(jnp.asarray(place)))
  for name, place in (bodies or {}).items():
    data = data.replace(xpos=data.xpos.at[env.mj_model.body(name).id].set(jnp.asarray(place)))
  return env.evaluate(data, state.info | info, jnp.zeros(env.action_size))


def amid(name: str) -> State:
  return jax.tree.map(lambda x: x[4], golden(name).states)


@pytest.mark.parametrize(("name", "size"), [(HANDOVER, 83), (PEG, 82)])
def test_observations_have_the_parts_that_they_say(name: str, size: int) -> None:
  assert sum(compiled(name).observation_parts["state"].values()) == size == golden(name).states.obs.shape[-1]


@pytest.mark.parametrize("name", [HANDOVER, PEG])
def test_actions_move_the_targets_within_their_range(name: str) -> None:
  env, state = compiled(name), amid(name)
  lower, upper = env.mj_model.actuator_ctrlrange.T
  action = jnp.linspace(-1, 1, 14)
  moved = np.clip(state.data.ctrl + env.config.action_scale * action, lower, upper)
  np.testing.assert_allclose(env.control(state, action), moved, rtol=1e-6)
  np.testing.assert_allclose(env.control(state, 1e4 * action), np.where(action > 0, upper, lower), rtol=1e-6)


@pytest.mark.parametrize("name", [HANDOVER, PEG])
@pytest.mark.parametrize("finger", range(8))
def test_a_finger_on_the_table_costs(name: str, finger: int, request: pytest.FixtureRequest) -> None:
  env = request.getfixturevalue("handover" if name == HANDOVER else "peg")
  state = amid(name)
  clear, touching = (
    env.evaluate(state.data.replace(sensordata=jnp.zeros(8).at[finger].set(found)), state.info, jnp.zeros(14))
    for found in (0.0, 1.0)
  )
  term = "reward/no_table_collision"
  assert (float(clear.metrics[term]), float(touching.metrics[term])) == (pytest.approx(0.3), 0)


@pytest.mark.parametrize("name", [HANDOVER, PEG])
def test_numbers_that_are_not_finite_end_an_episode(name: str) -> None:
  env, state = compiled(name), amid(name)
  for field in ("qpos", "qvel"):
    spoilt = state.data.replace(**{field: getattr(state.data, field).at[3].set(jnp.inf)})
    assert env.evaluate(spoilt, state.info, jnp.zeros(14)).done == 1


# Peg

INSERTED = {"socket_entrance": [0.048, 0, 0.15], "socket_rear": [0, 0, 0.15], "peg_end2": [0, 0, 0.15]}


@pytest.mark.parametrize(
  ("end", "success", "pays"),
  [
    ([0.0, 0.0, 0.15], 1, 8.0),
    ([0.005, 0.0, 0.15], 1, 8.0 * (1 - 0.9 * 0.04)),
    ([0.02, 0.0, 0.15], 0, 8.0 * (1 - 0.9 * 0.19)),  # on the way in
    ([0.0, 0.006, 0.15], 0, 0.0),  # beside the socket
  ],
)
def test_a_peg_in_the_socket(peg: SinglePegInsertion, end: list[float], success: int, pays: float) -> None:
  after = step(peg, amid(PEG), INSERTED | {"peg_end2": end})
  assert after.metrics["success"] == success
  assert float(after.metrics["reward/peg_insertion_reward"]) == pytest.approx(pays, abs=1e-4)
  gap = float(np.linalg.norm(np.subtract(end, [0, 0, 0.15])))
  assert float(after.metrics["position_error_cm"]) == pytest.approx(100 * gap, abs=1e-4)


def test_all_that_the_peg_task_pays_is_at_most_1(peg: SinglePegInsertion) -> None:
  state = amid(PEG)
  bodies = {"socket": [-0.05, 0, 0.15], "peg": [0.05, 0, 0.15]}
  grippers = {"left/gripper": bodies["socket"], "right/gripper": bodies["peg"]}
  axes = jnp.broadcast_to(jnp.eye(3), state.data.xmat.shape)
  home = state.data.qpos.at[:16].set(peg.mj_model.key("home").qpos[:16])
  ideal = state.replace(data=state.data.replace(xmat=axes, qpos=home, sensordata=jnp.zeros(8)))
  after = step(peg, ideal, INSERTED | grippers, bodies)
  assert float(after.reward) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("body", ["socket", "peg"])
def test_out_of_bounds_ends_the_episode(peg: SinglePegInsertion, body: str) -> None:
  assert step(peg, amid(PEG)).done == 0
  after = step(peg, amid(PEG), bodies={body: [0.0, -1.1, 0.1]})
  assert (after.done, after.metrics["out_of_bounds"]) == (1, 1)


# Handover

NEAR = {"left/gripper": [-0.1, 0.0, 0.22], "right/gripper": [0.2, 0.0, 0.18]}


def placed(box: Any, state: State, **sites: Any) -> dict[str, Any]:
  """Where things are with the box at `box`."""
  top, bottom = np.add(box, [0, 0, 0.02]), np.add(box, [0, 0, -0.02])
  return {"sites": NEAR | {"box_top": top, "box_bottom": bottom} | sites, "bodies": {"box": box}}


def test_only_progress_pays(handover: HandOver) -> None:
  state = amid(HANDOVER)
  there = placed([-0.05, 0, 0.2], state)
  first = step(handover, state, **there, best_potential=jnp.zeros(()))
  assert first.reward > 0.05
  again = step(handover, state.replace(info=first.info), **there)
  assert float(again.reward) == pytest.approx(0, abs=1e-4)
  back = step(handover, state.replace(info=first.info), **placed([-0.3, 0, 0.1], state))
  assert float(back.reward) == pytest.approx(0, abs=1e-4)
  assert back.info["best_potential"] == first.info["best_potential"]


def test_what_the_start_is_worth_is_no_progress(handover: HandOver) -> None:
  state = amid(HANDOVER)
  fresh = state.replace(data=state.data.replace(time=jnp.array(handover.dt)))
  assert step(handover, fresh, **placed([-0.05, 0, 0.2], state), best_potential=jnp.zeros(())).reward == 0
  beginning = state.replace(data=state.data.replace(time=jnp.zeros(())), info=state.info | {"picked": jnp.array(True)})
  assert not handover.disturb(beginning).info["picked"]
  assert handover.disturb(beginning).info["best_potential"] == 0


def test_a_dropped_box_costs_and_ends_the_episode(handover: HandOver) -> None:
  state = amid(HANDOVER)
  state = state.replace(info=state.info | {"best_potential": jnp.array(9.0)})
  low = placed([-0.15, 0, 0.04], state)
  assert step(handover, state, **low).done == 0
  lifted = step(handover, state, **placed([-0.15, 0, 0.2], state))
  assert lifted.info["picked"] and lifted.done == 0
  dropped = step(handover, state.replace(info=lifted.info), **low)
  assert dropped.done == 1
  assert float(dropped.reward) == pytest.approx(-0.1, abs=1e-3)


@pytest.mark.parametrize(("left_x", "success"), [(-0.2, 1), (0.05, 0)])
def test_success_is_the_box_at_the_target_without_the_left_hand(
  handover: HandOver, left_x: float, success: int
) -> None:
  state = amid(HANDOVER)
  target = np.asarray(state.data.mocap_pos[0])
  at_target = placed(target + np.array([0.0, 0.03, 0.0]), state, **{"left/gripper": [left_x, 0, 0.2]})
  after = step(handover, state, **at_target)
  assert after.metrics["success"] == success
  assert float(after.metrics["position_error_cm"]) == pytest.approx(3.0, abs=1e-3)


def test_the_right_hands_part_begins_where_the_box_is_passed(handover: HandOver) -> None:
  state = amid(HANDOVER)
  held = lambda x: placed([x, 0, 0.2], state, **{"left/gripper": [x, 0, 0.22], "right/gripper": [x, 0, 0.18]})
  pays = {x: float(step(handover, state, **held(x)).metrics["reward/gripper_box"]) for x in (-0.15, -0.05, 0.05)}
  assert pays == {-0.15: pytest.approx(1.0), -0.05: pytest.approx(2.0), 0.05: pytest.approx(2.0)}
