"""Tabletop scenes: they compile in silence, grippers grip, and what a camera sees can be randomised."""

import warnings

import mujoco
import numpy as np
import pytest

from playground.errors import UnknownNameError
from playground.mdp.manipulators import contact_addresses
from playground.robots.tabletop import TABLETOPS, build_tabletop
from tests.robots.figures import figures


def at(name: str, keyframe: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
  """A scene in one of its keyframes, before any step."""
  model = build_tabletop(name).compile()
  data = mujoco.MjData(model)
  mujoco.mj_resetDataKeyframe(model, data, model.key(keyframe).id)
  return model, data


def run(model: mujoco.MjModel, data: mujoco.MjData, seconds: float) -> None:
  for _ in range(round(seconds / model.opt.timestep)):
    mujoco.mj_step(model, data)


@pytest.mark.parametrize("name", TABLETOPS)
def test_compiles_without_a_word(name: str, capfd: pytest.CaptureFixture[str]) -> None:
  before = mujoco.get_mju_user_warning()
  with warnings.catch_warnings():
    warnings.simplefilter("error")
    model = build_tabletop(name).compile()
  assert capfd.readouterr() == ("", "")
  assert mujoco.get_mju_user_warning() == before
  assert model.geom("floor").type[0] == mujoco.mjtGeom.mjGEOM_PLANE


def test_unknown_scene() -> None:
  with pytest.raises(UnknownNameError, match="Did you mean 'panda_cabinet'"):
    build_tabletop("panda_cabinnet")


def test_hand_holds_the_cube() -> None:
  model, data = at("panda_single_cube_camera", "picked")
  run(model, data, 2.0)
  tip = data.site("gripper").xpos
  assert tip[2] > 0.06  # the servos give way a little
  assert np.linalg.norm(data.body("box").xpos - tip) < 0.02
  data.ctrl[7] = 0.04  # opens
  run(model, data, 1.0)
  assert data.body("box").xpos[2] < 0.04


def test_drawer_slides_between_its_stops() -> None:
  model, data = at("panda_cabinet", "upright")
  handle = model.joint(9)
  for force, stop in ((-5.0, -0.5), (5.0, 0.0)):
    data.qfrc_applied[handle.dofadr[0]] = force
    run(model, data, 3.0)
    np.testing.assert_allclose(data.qpos[handle.qposadr[0]], stop, atol=0.02)


def test_robotiq_opens_85_mm() -> None:
  """The four-bar linkage keeps both fingers parallel and mirrored; zero torque leaves the arm where it is."""
  model, data = at("panda_robotiq_cube", "home")
  arm = data.qpos[:7].copy()
  data.joint("box_joint").qpos[:2] += 0.3, 0.3  # out of the way
  data.ctrl[7] = 0.0
  run(model, data, 2.0)
  pads = [data.geom(f"{side}_finger_pad") for side in ("left", "right")]
  inner = np.linalg.norm(pads[0].xpos - pads[1].xpos) - 2 * model.geom("left_finger_pad").size[0]
  np.testing.assert_allclose(inner, 0.085, atol=0.003)
  normals = [np.abs(pad.xmat.reshape(3, 3)[:, 0]) for pad in pads]
  np.testing.assert_allclose(normals[0], normals[1], atol=0.02)
  np.testing.assert_allclose(data.qpos[:7], arm, atol=0.02)


def test_robotiq_feels_the_block() -> None:
  model, data = at("panda_robotiq_cube", "home")
  mujoco.mj_forward(model, data)
  assert not data.sensordata.any()
  data.joint("box_joint").qpos[:3] = data.geom("left_coupler_col_1").xpos - [0, 0, 0.05]
  mujoco.mj_forward(model, data)
  normal = data.sensor("left_coupler_col_1_box_normal").data
  np.testing.assert_allclose(np.linalg.norm(normal), 1, atol=1e-6)
  assert normal[2] < -0.9  # from the finger down to the block


def test_where_a_geoms_contacts_are() -> None:
  model = build_tabletop("panda_robotiq_cube").compile()
  assert contact_addresses(model, "wall").tolist() == [18, 19, 20]  # after six normals
  assert contact_addresses(model, "floor").tolist() == [21, 22, 23]
  assert contact_addresses(model, "box").tolist() == []  # those are normals
  assert contact_addresses(build_tabletop("panda_single_cube").compile(), "box").tolist() == [3]


def test_materials_and_light_to_randomise() -> None:
  """Randomisation of what the camera sees draws among materials by number and turns the one light there is."""
  model = build_tabletop("panda_single_cube_camera").compile()
  materials = figures("panda_single_cube_camera")["materials"]
  assert model.nmat == len(materials)
  for figure in materials:
    assert model.mat(figure["id"]).name.removeprefix("studio/") == figure["name"]
    np.testing.assert_allclose(model.mat(figure["id"]).rgba, figure["rgba"], atol=1e-6)
  (light,) = figures("panda_single_cube_camera")["lights"]
  assert (model.nlight, model.light(0).name) == (1, light["name"])
  assert model.light_mode[0] == mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM
  assert model.light_type[0] == mujoco.mjtLightType.mjLIGHT_SPOT
  for key in ("pos", "dir", "ambient", "diffuse", "specular"):
    np.testing.assert_allclose(getattr(model, f"light_{key}")[0], light[key], atol=1e-7, err_msg=key)
