"""What Playground 0.2.0 computes otherwise on legs, by hand where its recordings do not show it (test_golden.py)."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.compat020 import legs
from tests.envs.golden import golden, load_task, recorded
from tests.mdp.context import context

LEFT, SIDEWAYS = (0.0, 0.5, 0.0), (0.0, -0.5, 0.0)


@pytest.mark.parametrize(
  ("name", "params", "command", "value"),
  [
    ("joint_pos_limits_scaled", {"soft_limit_factor": 0.9}, LEFT, 0.09),  # the lower bound moves in, the upper one out
    ("hip_deviation_l1_sideways", {}, SIDEWAYS, 0.44),
    ("hip_deviation_l1_sideways", {}, (1.0, 0.0, 0.0), 0.0),
    ("hip_deviation_l1_crossed", {}, SIDEWAYS, 4 * 0.44),
    ("hip_deviation_l1_crossed", {}, LEFT, 2 * 0.44),
    ("stand_still_unless_left", {}, SIDEWAYS, 0.44),
    ("stand_still_unless_left", {}, LEFT, 0.0),
    ("stand_still_unless_left", {}, (0.0, 0.0, 0.5), 0.0),
    ("feet_air_time_unless_turning", {"threshold": 0.1}, LEFT, 0.2),
    ("feet_air_time_unless_turning", {"threshold": 0.1}, (0.0, 0.04, 0.5), 0.0),
    ("action_smoothness_l2_lagged", {}, LEFT, 0.1**2 + 0.2**2 + 0.2**2 + 0.7**2),
    ("lin_vel_z_l2_in_other_gaits", {"gaits": ["trot"]}, LEFT, 0.0),
    ("lin_vel_z_l2_in_other_gaits", {"gaits": ["bound"]}, LEFT, 0.04),
  ],
)
def test_reward(name: str, params: dict[str, Any], command: Any, value: float) -> None:
  np.testing.assert_allclose(getattr(legs, name)(context(command), **params), value, rtol=1e-5, atol=1e-7)


def test_late_terminations_cost_nothing() -> None:
  for left, cost in ((2, 1.0), (1, 0.0)):
    assert legs.is_terminated_early(context(command_steps_left=jnp.array(left))) == cost


def test_after_a_rest_feet_go_on_in_step() -> None:
  env = SimpleNamespace(dt=0.02, robot=SimpleNamespace(gait=lambda name: [0.0, 1.5 * np.pi]))
  gait = legs.GaitInStep(["walk"], rest_when_still=True)
  gait.bind(env)
  info = gait.reset(jax.random.PRNGKey(0))
  np.testing.assert_allclose(info["phase"], [0, 1.5 * np.pi])  # beyond the range of phases
  resting = info | gait.step(context((0.0, 0.0, 0.0), **info), jax.random.PRNGKey(0))
  assert (resting["phase"] == np.float32(np.pi)).all()
  phase = gait.step(context((1.0, 0.0, 0.0), **resting), jax.random.PRNGKey(0))["phase"]
  assert phase[0] == phase[1] < 0


@pytest.mark.parametrize("task", ["SpotFlatTerrainJoystick", "BarkourJoystick"])
def test_pushes_know_the_nominal_mass_only(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
  env = load_task(f"v020/{task}")
  heavy = env.mjx_model.replace(body_mass=2 * env.mjx_model.body_mass)
  monkeypatch.setattr(env.physics, "forward", lambda model, data: data)
  mass = jax.jit(lambda key: env.reset(key, heavy).info["push_mass"])(jax.random.PRNGKey(0))
  np.testing.assert_allclose(mass, env.robot.mass(env.mjx_model), rtol=1e-6)


def test_h1s_contacts_are_read_at_a_wrong_place() -> None:
  env: Any = golden("H1JoystickGaitTracking").env
  state = recorded("H1JoystickGaitTracking")
  feet = [env.mj_model.sensor(f"{geom}_floor_found").adr[0] for geom in env.config.robot.floor_contacts]
  lifted = state.data.replace(sensordata=state.data.sensordata.at[np.array(feet)].set(0.0))
  after = env.post_step(lifted, state.info, jnp.zeros(19))
  parts = env.observation_parts["state"]
  start = sum(parts[name] for name in list(parts)[: list(parts).index("contact")])
  assert after.obs[start : start + 2].tolist() == [1, 1]
  assert not env.robot.contact(lifted).any()
