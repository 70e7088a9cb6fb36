"""ALOHA's tasks: what is rewarded, when an episode ends and what counts as success.

On recorded states of Playground 0.2.0, with poses replaced: no physics is computed.
"""

import functools
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from playground import registry
from playground.envs.base import State
from playground.errors import ConfigError
from tests.envs.golden import recorded, without_physics

HANDOVER, PEG = "AlohaHandOver", "AlohaSinglePegInsertion"

task = functools.cache(without_physics)


def step(name: str, state: State, sites: Any = None, bodies: Any = None, **info: Any) -> State:
  """The state after a step that ended with sites and bodies where they are said to be, m."""
  env, data = task(name), state.data
  for site, place in (sites or {}).items():
    data = data.replace(site_xpos=data.site_xpos.at[env.mj_model.site(site).id].set(jnp.asarray(place)))
  for body, place in (bodies or {}).items():
    data = data.replace(xpos=data.xpos.at[env.mj_model.body(body).id].set(jnp.asarray(place)))
  return env.post_step(data, state.info | info, jnp.zeros(env.action_size))


@pytest.mark.parametrize("name", [HANDOVER, PEG])
def test_actions_move_the_targets_within_their_range(name: str) -> None:
  env, state = task(name), recorded(name)
  lower, upper = env.mj_model.actuator_ctrlrange.T
  action = jnp.linspace(-1, 1, 14)
  moved = np.clip(state.data.ctrl + env.config.action_scale * action, lower, upper)
  np.testing.assert_allclose(env.action_to_ctrl(state, action), moved, rtol=1e-6)
  np.testing.assert_allclose(env.action_to_ctrl(state, 1e4 * action), np.where(action > 0, upper, lower), rtol=1e-6)


@pytest.mark.parametrize("name", [HANDOVER, PEG])
def test_a_finger_on_the_table_costs(name: str) -> None:
  state = recorded(name)
  for found in (jnp.zeros(8), *jnp.eye(8)):
    touching = state.replace(data=state.data.replace(sensordata=found))
    np.testing.assert_allclose(step(name, touching).metrics["reward/no_contact"], 0.0 if found.any() else 0.3)


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
def test_a_peg_in_the_socket(end: list[float], success: int, pays: float) -> None:
  after = step(PEG, recorded(PEG), INSERTED | {"peg_end2": end})
  assert after.metrics["success"] == success
  assert float(after.metrics["reward/peg_inserted"]) == pytest.approx(pays, abs=1e-4)
  gap = float(np.linalg.norm(np.subtract(end, [0, 0, 0.15])))
  assert float(after.metrics["position_error_cm"]) == pytest.approx(100 * gap, abs=1e-4)


def test_all_that_the_peg_task_pays_is_at_most_1() -> None:
  state = recorded(PEG)
  bodies = {"socket": [-0.05, 0, 0.15], "peg": [0.05, 0, 0.15]}
  grippers = {"left/gripper": bodies["socket"], "right/gripper": bodies["peg"]}
  axes = jnp.broadcast_to(jnp.eye(3), state.data.xmat.shape)
  home = state.data.qpos.at[:16].set(task(PEG).mj_model.key("home").qpos[:16])
  ideal = state.replace(data=state.data.replace(xmat=axes, qpos=home, sensordata=jnp.zeros(8)))
  after = step(PEG, ideal, INSERTED | grippers, bodies)
  assert float(after.reward) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("body", ["socket", "peg"])
def test_out_of_bounds_ends_the_episode(body: str) -> None:
  assert step(PEG, recorded(PEG)).done == 0
  after = step(PEG, recorded(PEG), bodies={body: [0.0, -1.1, 0.1]})
  assert (after.done, after.metrics[f"termination/{body}_out_of_bounds"]) == (1, 1)


# Handover

NEAR = {"left/gripper": [-0.1, 0.0, 0.22], "right/gripper": [0.2, 0.0, 0.18]}


def placed(box: Any, **sites: Any) -> dict[str, Any]:
  """Where things are with the box at `box`."""
  top, bottom = np.add(box, [0, 0, 0.02]), np.add(box, [0, 0, -0.02])
  return {"sites": NEAR | {"box_top": top, "box_bottom": bottom} | sites, "bodies": {"box": box}}


def test_only_progress_pays() -> None:
  state, there = recorded(HANDOVER), placed([-0.05, 0, 0.2])
  first = step(HANDOVER, state, **there, best_potential=jnp.zeros(()))
  assert first.reward > 0.05
  again = step(HANDOVER, state.replace(info=first.info), **there)
  assert float(again.reward) == pytest.approx(0, abs=1e-4)
  back = step(HANDOVER, state.replace(info=first.info), **placed([-0.3, 0, 0.1]))
  assert float(back.reward) == pytest.approx(0, abs=1e-4)
  assert back.info["best_potential"] == first.info["best_potential"]


def test_what_the_start_is_worth_is_no_progress() -> None:
  fresh = {"first_step": jnp.array(True), "best_potential": jnp.zeros(())}
  after = step(HANDOVER, recorded(HANDOVER), **placed([-0.05, 0, 0.2]), **fresh)
  assert after.reward == 0 and after.info["best_potential"] > 0.05 and not after.info["first_step"]


def test_a_dropped_box_costs_and_ends_the_episode() -> None:
  state, low = recorded(HANDOVER, best_potential=jnp.array(9.0)), placed([-0.15, 0, 0.04])
  assert step(HANDOVER, state, **low).done == 0
  lifted = step(HANDOVER, state, **placed([-0.15, 0, 0.2]))
  assert lifted.info["picked"] and lifted.done == 0
  dropped = step(HANDOVER, state.replace(info=lifted.info), **low)
  assert (dropped.done, dropped.metrics["termination/dropped"]) == (1, 1)
  assert float(dropped.reward) == pytest.approx(-0.1, abs=1e-3)


@pytest.mark.parametrize(("left_x", "success"), [(-0.2, 1), (0.05, 0)])
def test_success_is_the_box_at_the_goal_without_the_left_hand(left_x: float, success: int) -> None:
  state = recorded(HANDOVER)
  goal = np.asarray(state.data.mocap_pos[0])
  after = step(HANDOVER, state, **placed(goal + np.array([0.0, 0.03, 0.0]), **{"left/gripper": [left_x, 0, 0.2]}))
  assert after.metrics["success"] == success
  assert float(after.metrics["position_error_cm"]) == pytest.approx(3.0, abs=1e-3)


def test_the_right_hands_part_begins_where_the_box_is_passed() -> None:
  state = recorded(HANDOVER)
  held = lambda x: placed([x, 0, 0.2], **{"left/gripper": [x, 0, 0.22], "right/gripper": [x, 0, 0.18]})
  for x, pays in ((-0.15, 1.0), (-0.05, 2.0), (0.05, 2.0)):
    np.testing.assert_allclose(step(HANDOVER, state, **held(x)).metrics["reward/grippers_at_box_exp"], pays, rtol=1e-5)


def test_weights_without_a_mean_are_refused() -> None:
  names = registry.config(HANDOVER).rewards
  with pytest.raises(ConfigError, match="their weights must add up to more than 0"):
    registry.load(HANDOVER, overrides={f"rewards.{name}.weight": 0.0 for name in names})
