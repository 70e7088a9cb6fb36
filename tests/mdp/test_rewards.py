"""Each reward term's formula on one case computed by hand."""

import jax.numpy as jnp
import numpy as np
import pytest

from playground.mdp.rewards import REWARDS
from tests.mdp.context import SENSORS, UPRIGHT, context, evaluate

CASES = {
  "tracking_lin_vel": np.exp(-0.25 / 0.25),
  "tracking_ang_vel": 1.0,
  "tracking": np.exp(-0.25 / 0.25) + 0.5,
  "lin_vel_z": 0.04,
  "lin_vel_z_local": 0.0,
  "lin_vel_z_with_torso": 0.04 + 0.01,
  "lin_vel_z_in_level_gaits": 0.04,
  "lin_vel_z_in_other_gaits": 0.0,
  "lin_vel_xy": 0.0,
  "ang_vel": 25.25,
  "ang_vel_xy": 0.25,
  "ang_vel_xy_local": 0.0,
  "ang_vel_xy_of_torso": 0.05,
  "orientation": 0.05,
  "orientation_as": 0.04 + 0.01,
  "base_height": 0.09,
  "collision": 1.0,
  "alive": 1.0,
  "alive_until_done": 0.0,
  "dof_pos_limits": 0.015,  # the second joint's soft range is -0.75 +- 0.225
  "dof_pos_limits_scaled": 0.09,  # -0.9 and -0.45: the lower bound moves in, the upper one out past the hard limit
  "pose": np.exp(-(0.2**2 + 0.5 * 0.24**2)),
  "pose_deviation": 0.2**2 + 0.5 * 0.24**2,
  "pose_deviation_by_command": 0.2**2 + 0.24**2,
  "pose_when_still": 1.0,
  "hip_splay": 0.2**2 + 0.24**2,
  "joint_deviation_knee": 0.24,
  "joint_deviation_hip": 0.44,
  "joint_deviation_hip_sideways": 0.0,
  "joint_deviation_hip_crossed": 4 * 0.44,
  "termination": 1.0,
  "termination_early": 1.0,
  "stand_still": 0.44,
  "stand_still_unless_left": 0.44,  # 0.1 / |(1, 0.1)| is just below 0.1
  "torques": 5.0 + 7.0,
  "torques_sum": 7.0,
  "torques_squared": 25.0,
  "action_rate": 0.16 + 0.09,
  "action_rate_and_change": 0.16 + 0.09 + 0.5**2 + 0.1**2,
  "action_rate_and_change_lagged": 0.1**2 + 0.2**2 + 0.2**2 + 0.7**2,
  "action_size": 0.1**2 + 0.3**2,
  "energy": 2 * 3 + 1 * 4,
  "energy_share": 2 * 3 / 6 + 1 * 4 / 8,
  "dof_acc": 13.0,
  "dof_vel": 4.0 + 1.0,
  "dof_vel_excess": 0.25,
  "feet_clearance": 0.05 * 0.5**0.5 + 0.08 * 0.2,
  "feet_height": 0.2**2,
  "feet_slip": 0.25,
  "feet_slip_of_base": 0.0,
  "feet_air_time": 0.2,
  "feet_air_time_unless_turning": 0.2,
  "feet_air_time_capped": 0.15,
  "feet_phase": np.exp(-(0.05**2 + 0.03**2) / 0.01),  # they should be at 0.1 and 0.05
  "feet_phase_unless_at_rest": np.exp(-(0.05**2 + 0.03**2) / 0.01),
  "feet_distance": 0.05,  # the heading is +x, the feet are 0.15 apart in y
  "contact_force": 30.0,
  "upright": np.exp(-2 * 0.06),
  "torso_height": np.exp(0.3) - 1,
  "torso_height_share": 0.75,
  "upright_pose": 0.0,
  "calm": 0.0,
  "height_deficit": np.exp(-0.1),
  "alignment": 0.9**2,  # the forward axis is (0.6, 0, -0.8)
  "lifted_contact": 0.0,
  "drift": 0.01 + 0.04 + 0.09,
}


def test_every_term_has_a_case() -> None:
  assert set(CASES) == set(REWARDS)


@pytest.mark.parametrize("name", REWARDS)
def test_formula(name: str) -> None:
  np.testing.assert_allclose(evaluate(name, context()), CASES[name], rtol=1e-5, atol=1e-7)


SIDEWAYS = (0.0, -0.5, 0.0)
LEFT = (0.0, 0.5, 0.0)
STILL = (0.0, 0.005, 0.0)


@pytest.mark.parametrize(
  ("name", "command", "value"),
  [
    ("joint_deviation_hip", SIDEWAYS, 0.2),  # the second joint is a roll
    ("joint_deviation_hip", LEFT, 0.2),
    ("joint_deviation_hip_sideways", SIDEWAYS, 0.44),
    ("joint_deviation_hip_crossed", SIDEWAYS, 4 * 0.44),
    ("joint_deviation_hip_crossed", LEFT, 2 * 0.44),
    ("pose_deviation_by_command", SIDEWAYS, 0.2**2 + 0.01 * 0.24**2),
    ("pose_deviation_by_command", STILL, 0.2**2 + 0.24**2),
    ("pose_when_still", STILL, np.exp(-2 * (0.2**2 + 0.24**2))),
    ("stand_still_unless_left", LEFT, 0.0),
    ("stand_still_unless_left", SIDEWAYS, 0.44),
    ("stand_still_unless_left", (0.0, 0.0, 0.5), 0.0),
    ("feet_air_time_unless_turning", (0.0, 0.04, 0.5), 0.0),
  ],
)
def test_terms_that_depend_on_the_command(name: str, command: tuple[float, float, float], value: float) -> None:
  np.testing.assert_allclose(evaluate(name, context(command=command)), value, rtol=1e-5)


def test_the_phase_is_free_at_rest_only() -> None:
  at_rest = SENSORS | {"global_linvel": jnp.array([0.05, 0.0, 0.2]), "global_angvel": jnp.array([3.0, 0.0, 0.05])}
  turning = at_rest | {"global_angvel": jnp.array([0.0, 0.0, -0.2])}
  name = "feet_phase_unless_at_rest"
  assert evaluate(name, context(STILL, at_rest)) == 0
  assert evaluate(name, context(STILL, turning)) > 0 and evaluate(name, context(sensors=at_rest)) > 0


def test_gaits_that_fly_may_go_up_and_down() -> None:
  c = context()
  flying = context(info={**c.info, "gait": jnp.array(0)})
  assert evaluate("lin_vel_z_in_level_gaits", flying) == 0
  np.testing.assert_allclose(evaluate("lin_vel_z_in_other_gaits", flying), 0.04, rtol=1e-5)


def test_late_terminations_cost_nothing() -> None:
  c = context()
  assert evaluate("termination_early", context(info={**c.info, "step": jnp.array(500)})) == 0


def test_the_gaits_own_swing_height() -> None:
  c = context()
  c = context(info={**c.info, "foot_height": jnp.array(0.2)})  # the feet should be at 0.2 and 0.1
  np.testing.assert_allclose(evaluate("feet_phase", c), np.exp(-(0.05**2 + 0.08**2) / 0.01), rtol=1e-5)


def test_feet_far_apart_cost_nothing_and_crossed_ones_no_more_than_a_tenth() -> None:
  feet = np.array([1, 2])
  c = context()
  for y, cost in ((0.3, 0.0), (-0.05, 0.1)):
    c.data.site_xpos = c.data.site_xpos.at[feet[0], 1].set(y)
    np.testing.assert_allclose(evaluate("feet_distance", c), cost, atol=1e-6)


def test_upright_pose() -> None:
  value = evaluate("upright_pose", context(sensors=UPRIGHT))
  np.testing.assert_allclose(value, np.exp(-0.5 * (0.2**2 + 0.24**2)), rtol=1e-5)


def test_calm_is_for_the_upright_and_high() -> None:
  np.testing.assert_allclose(evaluate("calm", context(sensors=UPRIGHT)), np.exp(-0.5 * 0.1), rtol=1e-5)
  assert evaluate("calm", context(sensors=UPRIGHT), height_tolerance=0.09) == 0
  assert evaluate("calm", context(sensors=UPRIGHT), height_of="root_joint") == 0  # 0.1 m lower than the site


def test_heights_beyond_the_target_earn_no_more() -> None:
  reached = {"target_height": 0.25}
  np.testing.assert_allclose(evaluate("torso_height", context(), **reached), np.exp(0.25) - 1, rtol=1e-5)
  assert evaluate("torso_height_share", context(), **reached) == evaluate("height_deficit", context(), **reached) == 1


def test_lifted_contact() -> None:
  assert evaluate("lifted_contact", context(contact=jnp.array([False, True]))) == 1
