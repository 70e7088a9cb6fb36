"""Each reward and termination term's formula on one case computed by hand."""

import inspect
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from playground.errors import ConfigError, UnknownNameError
from playground.mdp import rewards, terminations
from playground.mdp.manipulators import ArmContext, HandContext
from playground.mdp.terms import registered
from tests.mdp.context import SENSORS, UPRIGHT, context

POSE = 0.2**2 + 0.5 * 0.24**2
PHASE = np.exp(-(0.05**2 + 0.03**2) / 0.01)  # the feet should be at 0.1 and 0.05 m
CASES: list[tuple[str, dict[str, Any], float]] = [
  ("is_terminated", {}, 1.0),
  ("is_alive", {}, 0.0),
  ("constant", {}, 1.0),
  ("action_l2", {}, 0.1),
  ("action_norm", {}, np.sqrt(0.1)),
  ("action_rate_norm", {}, 0.5),
  ("action_rate_l2", {}, 0.16 + 0.09),
  ("action_smoothness_l2", {}, 0.16 + 0.09 + 0.5**2 + 0.1**2),
  ("joint_pos_limits", {"soft_limit_factor": 0.9}, 0.015),  # the second joint's soft range is -0.75 +- 0.225
  ("joint_deviation_l1", {}, 0.44),
  ("joint_deviation_l1", {"joints": "knees"}, 0.24),
  ("joint_deviation_l2", {"joints": "hips"}, 0.2**2 + 0.24**2),
  ("joint_torques_l1", {}, 7.0),
  ("joint_torques_l2", {}, 25.0),
  ("joint_torques_norms", {}, 5.0 + 7.0),
  ("joint_power_l1", {}, 2 * 3 + 1 * 4),
  ("joint_power_qfrc_l1", {}, 2 * 3 + 1 * 4),
  ("joint_acc_l2", {}, 13.0),
  ("joint_vel_l2", {}, 5.0),
  ("joint_vel_limits_l2", {"limit": 1.5}, 0.25),
  ("track_linear_velocity_exp", {"std": 0.5}, np.exp(-0.25 / 0.25)),
  ("track_angular_velocity_exp", {"std": 0.5}, 1.0),
  ("lin_vel_z_l2", {}, 0.04),
  ("lin_vel_z_l2", {"sensors": ["global_linvel", "torso_linvel"]}, 0.04 + 0.01),
  ("lin_vel_z_l2_in_gaits", {"gaits": ["trot"]}, 0.04),
  ("lin_vel_z_l2_in_gaits", {"gaits": ["bound"]}, 0.0),
  ("lin_vel_xy_l2", {}, 0.25),
  ("ang_vel_l2", {}, 25.25),
  ("ang_vel_xy_l2", {}, 0.25),
  ("ang_vel_xy_l2", {"sensor": "torso_angvel"}, 0.05),
  ("flat_orientation_l2", {}, 0.05),
  ("orientation_l2", {"target": [0.1, 0.0, 1.0]}, 0.04 + 0.01),
  ("upright_exp", {}, np.exp(-2 * 0.06)),
  ("forward_alignment", {"target": [0.0, 0.0, -1.0]}, 0.9**2),  # the forward axis is (0.6, 0, -0.8)
  ("base_height_l2", {"target": 0.5}, 0.09),
  ("base_height_exp", {"target": 0.4}, np.exp(-0.1)),
  ("base_height_exp", {"target": 0.25}, 1.0),  # beyond the target earns no more
  ("base_height_expm1", {"target": 0.4}, np.exp(0.3) - 1),
  ("base_height_expm1", {"target": 0.25}, np.exp(0.25) - 1),
  ("root_height_ratio", {"target": 0.4}, 0.5),
  ("root_height_ratio", {"target": 0.1}, 1.0),
  ("self_contact", {}, 1.0),
  ("pose_l2", {}, POSE),
  ("pose_exp", {}, np.exp(-POSE)),
  ("pose_l2_by_command", {}, 0.2**2 + 0.24**2),
  ("pose_exp_when_still", {"sharpness": 2.0}, 1.0),
  ("pose_exp_when_upright", {"tilt": 0.01}, 0.0),
  ("hip_deviation_l1", {}, 0.44),
  ("action_exp_when_up", {"tilt": 0.01, "height": 0.29}, 0.0),
  ("action_exp_when_root_up", {"tilt": 0.01, "height": 0.19}, 0.0),
  ("feet_clearance", {"target": 0.1}, 0.05 * 0.5**0.5 + 0.08 * 0.2),
  ("feet_swing_height_l2", {"target": 0.1}, 0.5**2),  # the peak is this step's height
  ("feet_slip_l2", {}, 0.25),
  ("base_speed_times_contacts", {}, 0.5),
  ("feet_air_time", {"threshold": 0.1}, 0.2),
  ("feet_air_time", {"threshold": 0.1, "limit": 0.25}, 0.15),
  ("feet_phase_exp", {"std": 0.1, "peak": 0.1}, PHASE),
  ("feet_phase_exp_unless_at_rest", {"std": 0.1, "peak": 0.1}, PHASE),
  ("feet_distance", {"minimum": 0.2}, 0.05),  # the heading is +x, the feet are 0.15 apart in y
  ("feet_contact_force", {"limit": 100.0}, 30.0),
  ("feet_contact", {"feet": ["right"]}, 0.0),
  ("feet_contact", {"feet": ["right", "left"]}, 1.0),
]
ENDINGS: list[tuple[str, dict[str, Any], bool]] = [
  ("nonfinite_state", {}, False),
  ("upvector_below", {"limit": 0.85}, False),
  ("upvector_below", {"limit": 0.95}, True),
  ("power_above", {"limit": 9.9}, True),  # 2 * 3 + 1 * 4 W
  ("power_above", {"limit": 10.1}, False),
  ("joint_pos_out_of_limit", {}, False),
  ("joint_pos_out_of_target_range", {}, True),
  ("joint_pos_out_of_target_range", {"margin": 0.11}, False),
  ("base_height_below", {"limit": 0.31}, True),
  ("base_height_below", {"limit": 0.29}, False),
  ("joint_pos_out_of_soft_limits", {"soft_limit_factor": 0.9}, True),
  ("joint_pos_out_of_soft_limits", {"soft_limit_factor": 1.0}, False),
  ("fatal_contact", {}, True),
  ("fatal_contact", {"count": 1}, False),
  ("leg_contact", {}, True),
]


def not_of_manipulators(kind: str) -> set[str]:
  """Terms of a kind but those that read an arm or a hand, which are compared with recordings of their tasks."""
  context = lambda func: next(iter(inspect.signature(func).parameters.values())).annotation
  return {name for name, func in registered(kind).items() if context(func) not in (ArmContext, HandContext)}


def test_every_term_has_a_case() -> None:
  assert {name for name, *_ in CASES} == not_of_manipulators("rewards")
  with_a_model = {"terrain_out_of_bounds"}  # has its own test
  assert {name for name, *_ in ENDINGS} | with_a_model == not_of_manipulators("terminations")


def reward(name: str, c: Any, **params: Any) -> float:
  return float(getattr(rewards, name)(c, **params))


@pytest.mark.parametrize(("name", "params", "value"), CASES)
def test_reward(name: str, params: dict[str, Any], value: float) -> None:
  np.testing.assert_allclose(reward(name, context(), **params), value, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize(("name", "params", "ends"), ENDINGS)
def test_termination(name: str, params: dict[str, Any], ends: bool) -> None:
  assert getattr(terminations, name)(context(), **params) == ends


def test_nonfinite_state() -> None:
  for field in ("qpos", "qvel"):
    assert terminations.nonfinite_state(context(data={field: jnp.array([0.0, jnp.nan])}))


SIDEWAYS, LEFT, STILL = (0.0, -0.5, 0.0), (0.0, 0.5, 0.0), (0.0, 0.005, 0.0)


@pytest.mark.parametrize(
  ("name", "params", "command", "value"),
  [
    ("track_angular_velocity_exp", {"std": 0.5}, (1.0, 0.1, 0.8), np.exp(-1)),
    ("hip_deviation_l1", {}, SIDEWAYS, 0.2),  # the second joint is a roll
    ("hip_deviation_l1", {}, LEFT, 0.2),
    ("pose_l2_by_command", {}, SIDEWAYS, 0.2**2 + 0.01 * 0.24**2),
    ("pose_l2_by_command", {}, STILL, 0.2**2 + 0.24**2),
    ("pose_exp_when_still", {"sharpness": 2.0}, STILL, np.exp(-2 * (0.2**2 + 0.24**2))),
  ],
)
def test_terms_that_depend_on_the_command(name: str, params: Any, command: Any, value: float) -> None:
  np.testing.assert_allclose(reward(name, context(command), **params), value, rtol=1e-5)


def test_the_phase_is_free_at_rest_only() -> None:
  at_rest = SENSORS | {"global_linvel": jnp.array([0.05, 0.0, 0.2]), "global_angvel": jnp.array([3.0, 0.0, 0.05])}
  turning = at_rest | {"global_angvel": jnp.array([0.0, 0.0, -0.2])}
  value = lambda *where: reward("feet_phase_exp_unless_at_rest", context(*where), std=0.1, peak=0.1)
  assert value(STILL, at_rest) == 0
  assert value(STILL, turning) > 0 and value((1.0, 0.0, 0.0), at_rest) > 0


def test_the_gaits_own_swing_height() -> None:
  c = context(foot_height=jnp.array(0.2))  # the feet should be at 0.2 and 0.1
  np.testing.assert_allclose(reward("feet_phase_exp", c, std=0.1), np.exp(-(0.05**2 + 0.08**2) / 0.01), rtol=1e-5)


def test_gaits_that_a_robot_has_not() -> None:
  c = context()
  for gaits in (["trt"], ["bound", "trt"]):
    with pytest.raises(UnknownNameError, match=r"^params\.gaits: 'trt' is unknown.* 'trot'"):
      rewards.lin_vel_z_l2_in_gaits(c, gaits)
  assert rewards.lin_vel_z_l2_in_gaits(c, ["walk"]) == 0  # one that the command does not draw
  c.env.config.commands.gait = None
  with pytest.raises(ConfigError, match=r"^it needs env\.commands\.gait"):
    rewards.lin_vel_z_l2_in_gaits(c, ["trot"])


def test_feet_far_apart_cost_nothing_and_crossed_ones_no_more_than_a_tenth() -> None:
  for y, cost in ((0.3, 0.0), (-0.05, 0.1)):
    c = context()
    c.data.site_xpos = c.data.site_xpos.at[1, 1].set(y)  # pyright: ignore[reportAttributeAccessIssue]
    np.testing.assert_allclose(reward("feet_distance", c, minimum=0.2), cost, atol=1e-6)


def test_a_foot_has_landed_if_it_touched_in_the_step_before() -> None:
  landed = context(last_contact=jnp.array([False, True])).first_contact
  assert landed.tolist() == [True, True]
  assert context(feet_air_time=jnp.zeros(2)).first_contact.tolist() == [False, False]


def test_pose_and_calm_are_for_the_upright_and_high() -> None:
  upright = context(sensors=UPRIGHT)
  value = reward("pose_exp_when_upright", upright, tilt=0.01)
  np.testing.assert_allclose(value, np.exp(-0.5 * (0.2**2 + 0.24**2)), rtol=1e-5)
  for name, low in (("action_exp_when_up", 0.29), ("action_exp_when_root_up", 0.19)):
    np.testing.assert_allclose(reward(name, upright, tilt=0.01, height=low), np.exp(-0.5 * 0.1), rtol=1e-5)
    assert reward(name, upright, tilt=0.01, height=low + 0.02) == 0


@pytest.mark.parametrize(
  ("ground", "place", "buffer", "ends"),
  [("hfield", 8.9, 1.0, False), ("hfield", -9.1, 1.0, True), ("hfield", -9.1, 0.5, False), ("plane", 99.0, 1.0, False)],
)
def test_the_edge_of_the_terrain(ground: str, place: float, buffer: float, ends: bool) -> None:
  shape = 'type="hfield" hfield="terrain"' if ground == "hfield" else 'type="plane" size="0 0 1"'
  model = mujoco.MjModel.from_xml_string(
    f"""<mujoco><asset><hfield name="terrain" nrow="2" ncol="2" size="10 10 1 1"/></asset><worldbody>
    <geom name="floor" {shape}/><body><freejoint/><geom size="0.1"/></body></worldbody></mujoco>"""
  )
  robot = SimpleNamespace(mj_model=model, find=lambda kind, name: getattr(model, kind)(name).id)
  data = SimpleNamespace(qpos=jnp.array([0.0, place, 0.3, 1.0, 0.0, 0.0, 0.0]))
  c: Any = SimpleNamespace(robot=robot, data=data, env=SimpleNamespace(mj_model=model))
  assert terminations.terrain_out_of_bounds(c, buffer) == ends
