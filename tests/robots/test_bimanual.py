"""ALOHA 2: its arms hold their pose, and its sensors see fingers on the table."""

import mujoco
import numpy as np
import pytest

from playground.robots.tabletop import build_tabletop


@pytest.fixture(params=("handover", "peg_insertion"), scope="module")
def model(request: pytest.FixtureRequest) -> mujoco.MjModel:
  return build_tabletop(request.param).compile()


@pytest.fixture
def data(model: mujoco.MjModel) -> mujoco.MjData:
  """At the keyframe `home`."""
  result = mujoco.MjData(model)
  mujoco.mj_resetDataKeyframe(model, result, model.key("home").id)
  return result


def test_arms_hold_and_parts_lie_still(model: mujoco.MjModel, data: mujoco.MjData) -> None:
  home = data.qpos.copy()
  for _ in range(round(2.0 / model.opt.timestep)):
    mujoco.mj_step(model, data)
  np.testing.assert_allclose(data.qpos, home, atol=0.04)  # servos without integrators sag a little
  np.testing.assert_allclose(data.qvel, 0, atol=0.01)
  assert not data.sensordata.any()


@pytest.mark.parametrize("side", ["left", "right"])
def test_fingers_on_the_table(model: mujoco.MjModel, data: mujoco.MjData, side: str) -> None:
  data.joint(f"{side}/shoulder").qpos += 0.75
  mujoco.mj_forward(model, data)
  found = {model.sensor(i).name for i in range(model.nsensor) if data.sensor(i).data > 0}
  assert found
  assert all(name.startswith(f"table_{side}/") for name in found)


def test_handover_leaves_a_gap_in_the_left_gripper() -> None:
  model = build_tabletop("handover").compile()
  assert model.actuator("left/gripper").ctrlrange[0] == 0.01
  assert model.actuator("right/gripper").ctrlrange[0] == 0.002
