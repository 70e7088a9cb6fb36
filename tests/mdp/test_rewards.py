"""Each reward term's formula on one case computed by hand."""

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from ml_collections import ConfigDict

from playground.errors import ConfigError, UnknownNameError
from playground.mdp.legged import Context
from playground.mdp.rewards import PARITY_REWARDS, REWARDS, bind

SENSORS = {
  "linvel": jnp.array([0.5, 0.1, 0.0]),
  "gyro": jnp.array([0.0, 0.0, 0.3]),
  "global_linvel": jnp.array([0.0, 0.0, 0.2]),
  "global_angvel": jnp.array([0.3, -0.4, 5.0]),
  "upvector": jnp.array([0.1, -0.2, 0.9]),
}
PARAMETERS = {
  "tracking_sigma": 0.25,
  "soft_limit_factor": 0.9,
  "max_foot_height": 0.1,
  "min_air_time": 0.1,
  "pose_weights": [1.0, 0.5],
}


def context(command: tuple[float, float, float] = (1.0, 0.1, 0.3), **changes: Any) -> Context:
  """Two joints at 0.2 and -0.95 (range: -1 to 1 and -1 to -0.5; default: 0 and -0.75) and two feet."""
  robot = SimpleNamespace(
    default_pose=jnp.array([0.0, -0.75]),
    joint_range=jnp.array([[-1.0, -1.0], [1.0, -0.5]]),
    base_site=0,
    feet=np.array([1, 2]),
    sensor=lambda data, key: SENSORS[key],
    feet_velocity=lambda data: jnp.array([[0.3, 0.4, 9.0], [0.0, 0.04, 9.0]]),
  )
  data = SimpleNamespace(
    qpos=jnp.array([0, 0, 0.3, 1, 0, 0, 0, 0.2, -0.99]),
    qvel=jnp.array([0, 0, 0, 0, 0, 0, 2.0, -1.0]),
    actuator_force=jnp.array([3.0, -4.0]),
    site_xpos=jnp.array([[0, 0, 0.3], [0, 0, 0.15], [0, 0, 0.02]]),
  )
  info = {
    "command": jnp.array(command),
    "last_act": jnp.array([0.5, 0.0]),
    "feet_air_time": jnp.array([0.3, 0.06]),
    "swing_peak": jnp.array([0.12, 0.2]),
  }
  fields = {
    "robot": robot,
    "data": data,
    "info": info,
    "action": jnp.array([0.1, -0.3]),
    "contact": jnp.array([True, False]),
    "first_contact": jnp.array([True, False]),
    "done": jnp.array(True),
  }
  return Context(**(fields | changes))


CASES = {
  "tracking_lin_vel": np.exp(-0.25 / 0.25),
  "tracking_ang_vel": 1.0,
  "lin_vel_z": 0.04,
  "ang_vel_xy": 0.25,
  "orientation": 0.05,
  "dof_pos_limits": 0.015,  # the second joint's soft range is -0.75 +- 0.225
  "pose": np.exp(-(0.2**2 + 0.5 * 0.24**2)),
  "termination": 1.0,
  "stand_still": 0.0,
  "torques": 5.0 + 7.0,
  "action_rate": 0.16 + 0.09,
  "energy": 2 * 3 + 1 * 4,
  "feet_clearance": 0.05 * 0.5**0.5 + 0.08 * 0.2,
  "feet_height": 0.2**2,
  "feet_slip": 0.25,
  "feet_air_time": 0.2,
}


def evaluate(name: str, c: Context, functions: Any = REWARDS, **parameters: Any) -> float:
  config = ConfigDict({"scales": {name: 1.0}, **PARAMETERS, **parameters})
  weight, term = bind(config, functions)[name]
  assert weight == 1.0
  return float(term(c))


def test_every_term_has_a_case() -> None:
  assert set(CASES) == set(REWARDS)


@pytest.mark.parametrize("name", REWARDS)
def test_formula(name: str) -> None:
  np.testing.assert_allclose(evaluate(name, context()), CASES[name], rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("name", ["feet_height", "feet_slip", "feet_air_time"])
def test_feet_are_free_when_standing(name: str) -> None:
  assert evaluate(name, context(command=(0.0, 0.005, 0.0))) == 0


def test_stand_still() -> None:
  np.testing.assert_allclose(evaluate("stand_still", context(command=(0.0, 0.005, 0.0))), 0.44, rtol=1e-5)


def test_pose_without_weights() -> None:
  unweighted = evaluate("pose", context(), pose_weights=None)
  np.testing.assert_allclose(unweighted, np.exp(-(0.2**2 + 0.24**2)), rtol=1e-5)


def test_parity_soft_limits_scale_the_bounds() -> None:
  """-0.9 and -0.45: the lower bound moves in, the upper one moves out past the hard limit."""
  penalty = evaluate("dof_pos_limits", context(), PARITY_REWARDS)
  np.testing.assert_allclose(penalty, 0.09, rtol=1e-5)


def test_bind_leaves_out_weight_zero() -> None:
  config = ConfigDict({"scales": {"energy": 0, "torques": -1.0}})
  assert set(bind(config, REWARDS)) == {"torques"}


def test_bind_errors() -> None:
  with pytest.raises(UnknownNameError, match=r"env\.reward\.scales: 'energi' is unknown.*Did you mean 'energy'\?"):
    bind(ConfigDict({"scales": {"energi": 1.0}}), REWARDS)
  with pytest.raises(ConfigError, match=r"env\.reward\.tracking_sigma is missing: term 'tracking_lin_vel' needs it"):
    bind(ConfigDict({"scales": {"tracking_lin_vel": 1.0}}), REWARDS)
