"""The Go1 beside a recorded state of the reference. (Its figures: test_figures.py.)"""

import mujoco
import numpy as np

from tests.robots.figures import TESTS, Scene, build, figures


def test_sensordata_of_a_golden_record() -> None:
  """Record 0 of the recorded roll is a state after forward (float32 MJX, one solver iteration)."""
  model = build(Scene("go1"), figures("go1_feetonly_flat"))
  golden = np.load(TESTS / "golden/Go1JoystickFlatTerrain.npz")
  data = mujoco.MjData(model)
  data.qpos, data.qvel, data.ctrl = (golden[f"data/{key}"][0] for key in ("qpos", "qvel", "ctrl"))
  mujoco.mj_forward(model, data)
  recorded = golden["data/sensordata"][0]
  accelerometer, free = slice(6, 9), np.r_[0:6, 9:52]
  np.testing.assert_allclose(data.sensordata[free], recorded[free], rtol=1e-4, atol=1e-5)
  np.testing.assert_allclose(data.sensordata[accelerometer], recorded[accelerometer], rtol=1e-3, atol=1e-3)
  np.testing.assert_array_equal(data.sensordata[52:] > 0, recorded[52:] > 0)
  np.testing.assert_allclose(data.actuator_force, golden["data/actuator_force"][0], rtol=1e-4, atol=1e-4)
  np.testing.assert_allclose(data.qacc, golden["data/qacc"][0], rtol=1e-3, atol=1e-2)
