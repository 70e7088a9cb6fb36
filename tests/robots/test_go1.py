"""The Go1 scene against the figures of the reference model, number by number and as dynamics (C MuJoCo)."""

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import yaml

from playground.robots.scene import build_scene

TESTS = Path(__file__).parents[1]
ROBOT = yaml.safe_load((TESTS.parent / "configs/robot/go1.yaml").read_text())
FIGURES = json.loads((TESTS / "figures/go1_feetonly_flat.json").read_text())
ENUMS = {
  "joint": mujoco.mjtJoint,
  "geom": mujoco.mjtGeom,
  "sensor": mujoco.mjtSensor,
  "object": mujoco.mjtObj,
}


def enum(kind: str, name: str) -> Any:
  """The MuJoCo constant that the figures call by its bare name."""
  members = ENUMS[kind].__members__.values()
  return next(m for m in members if m.name.split("_", 1)[1].lower() == name)


def close(actual: Any, figure: Any, key: object = None) -> None:
  # Figures have nine significant digits.
  np.testing.assert_allclose(np.ravel(actual), np.ravel(figure), rtol=2e-8, atol=1e-12, err_msg=str(key))


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
  return build_scene("go1", floor_contacts=ROBOT["floor_contacts"]).compile()


@pytest.fixture(scope="module")
def reference() -> mujoco.MjModel:
  """A model rebuilt from the figures alone."""
  spec = mujoco.MjSpec()
  spec.compiler.degree = False
  spec.option.timestep = FIGURES["option"]["timestep"]
  spec.option.iterations, spec.option.ls_iterations = 1, 5
  spec.option.ccd_iterations = FIGURES["option"]["ccd_iterations"]
  spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_EULERDAMP
  bodies = {"world": spec.worldbody}
  for b in FIGURES["bodies"][1:]:
    bodies[b["name"]] = bodies[b["parent"]].add_body(
      name=b["name"], pos=b["pos"], quat=b["quat"], mass=b["mass"], ipos=b["ipos"], iquat=b["iquat"],
      inertia=b["inertia"], explicitinertial=True,
    )  # fmt: skip
  for j in FIGURES["joints"]:
    if j["type"] == "free":
      bodies[j["body"]].add_freejoint()
      continue
    bodies[j["body"]].add_joint(
      name=j["name"], type=enum("joint", j["type"]), axis=j["axis"], range=j["range"], damping=[j["damping"], 0, 0],
      armature=j["armature"], frictionloss=j["frictionloss"], limited=True,
    )  # fmt: skip
  for g in FIGURES["collision_geoms"]:
    bodies[g["body"]].add_geom(
      type=enum("geom", g["type"]),
      **{k: g[k] for k in ("name", "size", "pos", "quat", "contype", "conaffinity", "condim", "friction", "solref")},
      **{k: g[k] for k in ("solimp", "solmix", "margin", "gap", "priority")},
    )
  for s in FIGURES["sites"]:
    bodies[s["body"]].add_site(name=s["name"], pos=s["pos"], quat=s["quat"])
  for a in FIGURES["actuators"]:
    spec.add_actuator(
      name=a["name"], target=a["target"], trntype=mujoco.mjtTrn.mjTRN_JOINT, gainprm=a["gainprm"] + [0] * 9,
      biastype=mujoco.mjtBias.mjBIAS_AFFINE, biasprm=a["biasprm"] + [0] * 8, ctrllimited=True,
      ctrlrange=a["ctrlrange"], forcelimited=True, forcerange=a["forcerange"],
    )  # fmt: skip
  return spec.compile()


def test_counts(model: mujoco.MjModel) -> None:
  figures = {k: n for k, n in FIGURES["counts"].items() if k not in ("ngeom", "nmesh")}  # ours is drawn otherwise
  assert {k: getattr(model, k) for k in figures} == figures
  close(model.body_mass.sum(), FIGURES["total_mass"])
  close(model.qpos0, FIGURES["qpos0"])


def test_options(model: mujoco.MjModel) -> None:
  option, figures = model.opt, FIGURES["option"]
  for key in ("timestep", "iterations", "ls_iterations", "tolerance", "ls_tolerance", "ccd_iterations", "gravity"):
    close(getattr(option, key), figures[key], key)
  for key in ("ccd_tolerance", "noslip_iterations", "impratio", "wind", "density", "viscosity", "o_solref", "o_solimp"):
    close(getattr(option, key), figures[key], key)
  assert option.integrator == mujoco.mjtIntegrator.mjINT_EULER
  assert option.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
  assert option.solver == mujoco.mjtSolver.mjSOL_NEWTON
  assert option.jacobian == mujoco.mjtJacobian.mjJAC_AUTO
  assert option.disableflags == mujoco.mjtDisableBit.mjDSBL_EULERDAMP
  assert option.enableflags == 0
  for key, value in FIGURES["statistic"].items():
    close(getattr(model.stat, key), value, key)
  for key in ("offwidth", "offheight", "fovy", "azimuth", "elevation"):
    close(getattr(model.vis.global_, key), FIGURES["visual"][key], key)


def test_bodies(model: mujoco.MjModel) -> None:
  for figure in FIGURES["bodies"]:
    body = model.body(figure["id"])
    assert body.name == figure["name"]
    if figure["parent"]:
      assert model.body(int(body.parentid[0])).name == figure["parent"]
    for key in ("pos", "quat", "mass", "inertia", "ipos", "iquat"):
      close(getattr(body, key), figure[key], (body.name, key))


def test_joints(model: mujoco.MjModel) -> None:
  for figure in FIGURES["joints"]:
    joint = model.joint(figure["id"])
    assert joint.type[0] == enum("joint", figure["type"])
    assert model.body(int(joint.bodyid[0])).name == figure["body"]
    assert (joint.qposadr[0], joint.dofadr[0]) == (figure["qposadr"], figure["dofadr"])
    if figure["type"] == "free":
      assert joint.name == ""
      continue
    assert joint.name == figure["name"]
    assert bool(joint.limited[0]) == figure["limited"]
    for key in ("pos", "axis", "range", "armature", "frictionloss"):
      close(getattr(joint, key), figure[key], (joint.name, key))
    close(model.dof_damping[figure["dofadr"]], figure["damping"])
    close(model.jnt_stiffness[figure["id"]], figure["stiffness"])
  assert not model.dof_damping[:6].any() and not model.dof_armature[:6].any()


def test_actuators(model: mujoco.MjModel) -> None:
  for figure in FIGURES["actuators"]:
    actuator = model.actuator(figure["id"])
    assert actuator.name == figure["name"]
    assert actuator.trntype[0] == mujoco.mjtTrn.mjTRN_JOINT
    assert model.joint(int(actuator.trnid[0])).name == figure["target"]
    assert actuator.gaintype[0] == mujoco.mjtGain.mjGAIN_FIXED
    assert actuator.biastype[0] == mujoco.mjtBias.mjBIAS_AFFINE
    assert actuator.dyntype[0] == mujoco.mjtDyn.mjDYN_NONE
    assert actuator.ctrllimited[0] and actuator.forcelimited[0]
    close(actuator.gainprm, figure["gainprm"] + [0] * 9)
    close(actuator.biasprm, figure["biasprm"] + [0] * 8)
    for key in ("gear", "ctrlrange", "forcerange"):
      close(getattr(actuator, key), figure[key], (actuator.name, key))


def test_sites(model: mujoco.MjModel) -> None:
  for figure in FIGURES["sites"]:
    site = model.site(figure["id"])
    assert site.name == figure["name"]
    assert model.body(int(site.bodyid[0])).name == figure["body"]
    assert site.group[0] == figure["group"]
    for key in ("pos", "quat"):
      close(getattr(site, key), figure[key], (site.name, key))


def test_sensors(model: mujoco.MjModel) -> None:
  for figure in FIGURES["sensors"]:
    i, sensor = figure["id"], model.sensor(figure["id"])
    assert sensor.name == figure["name"]
    assert sensor.type[0] == enum("sensor", figure["type"])
    assert (sensor.adr[0], sensor.dim[0], sensor.cutoff[0]) == (figure["adr"], figure["dim"], figure["cutoff"])
    objtype = enum("object", figure["objtype"])
    assert sensor.objtype[0] == objtype
    assert mujoco.mj_id2name(model, objtype, model.sensor_objid[i]) == figure["obj"]
    if "ref" in figure:
      reftype = enum("object", figure["reftype"])
      assert sensor.reftype[0] == reftype
      assert mujoco.mj_id2name(model, reftype, model.sensor_refid[i]) == figure["ref"]
    if "intprm" in figure:
      assert list(model.sensor_intprm[i]) == figure["intprm"]


def test_collision_geoms(model: mujoco.MjModel) -> None:
  """Exactly the figures' geoms collide; all others are drawn only."""
  colliding = [i for i in range(model.ngeom) if model.geom_contype[i] or model.geom_conaffinity[i]]
  assert [model.geom(i).name for i in colliding] == [g["name"] for g in FIGURES["collision_geoms"]]
  assert colliding[0] == 0
  for figure in FIGURES["collision_geoms"]:
    geom = model.geom(figure["name"])
    assert model.body(int(geom.bodyid[0])).name == figure["body"]
    assert geom.type[0] == enum("geom", figure["type"])
    for key in ("size", "pos", "quat", "contype", "conaffinity", "condim", "friction", "solref", "solimp", "solmix"):
      close(getattr(geom, key), figure[key], (geom.name, key))
    for key in ("margin", "gap", "priority", "group"):
      close(getattr(geom, key), figure[key], (geom.name, key))


def test_keyframes_and_cameras(model: mujoco.MjModel) -> None:
  for figure in FIGURES["keyframes"]:
    key = model.key(figure["id"])
    assert key.name == figure["name"]
    np.testing.assert_allclose(key.qpos, figure["qpos"], rtol=1e-8, atol=1e-9)
    close(key.ctrl, figure["ctrl"])
    close(key.qvel, np.zeros(model.nv))
  for figure in FIGURES["cameras"]:
    camera = model.cam(figure["id"])
    assert camera.name == figure["name"]
    assert model.body(int(camera.bodyid[0])).name == figure["body"]
    assert camera.mode[0] == mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM
    for key in ("pos", "quat", "fovy"):
      np.testing.assert_allclose(getattr(camera, key).ravel(), np.ravel(figure[key]), rtol=1e-8, atol=1e-9)


def states(model: mujoco.MjModel, count: int) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
  """Random poses near `home`, low enough that feet touch, with random velocities and targets."""
  rng = np.random.default_rng(0)
  home = model.key("home")
  result = []
  for _ in range(count):
    qpos = home.qpos + np.concatenate([[0, 0, rng.uniform(-0.03, 0.01)], rng.normal(0, 0.05, 16)])
    qpos[3:7] /= np.linalg.norm(qpos[3:7])
    result.append((qpos, rng.normal(0, 1, model.nv), home.ctrl + rng.normal(0, 0.5, model.nu)))
  return result


def test_dynamics(model: mujoco.MjModel, reference: mujoco.MjModel) -> None:
  """Mass matrix, contacts and accelerations equal those of a model rebuilt from the figures."""
  ours, theirs = mujoco.MjData(model), mujoco.MjData(reference)
  touching = 0
  for qpos, qvel, ctrl in states(model, 10):
    full = []
    for m, d in ((model, ours), (reference, theirs)):
      mujoco.mj_resetData(m, d)
      d.qpos, d.qvel, d.ctrl = qpos, qvel, ctrl
      mujoco.mj_forward(m, d)
      full.append(np.zeros((m.nv, m.nv)))
      mujoco.mj_fullM(m, d, full[-1])
    touching += ours.ncon > 0
    assert (ours.ncon, ours.nefc) == (theirs.ncon, theirs.nefc)
    np.testing.assert_allclose(full[0], full[1], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(ours.qacc, theirs.qacc, rtol=1e-6, atol=1e-6 * np.abs(theirs.qacc).max())
  assert touching >= 8


def test_sensordata_of_a_golden_record(model: mujoco.MjModel) -> None:
  """Record 0 of the recorded roll is a state after forward (float32 MJX, one solver iteration)."""
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


def test_robot_yaml_names_exist(model: mujoco.MjModel) -> None:
  """Every name in configs/robot/go1.yaml is in the model, and lists over feet follow `feet`."""
  assert model.body(ROBOT["root"]).id == 1
  model.site(ROBOT["base_site"])
  model.key(ROBOT["keyframe"])
  assert [model.joint(i).name for i in range(1, model.njnt)] == ROBOT["joints"]
  assert [model.joint(int(j)).name for j in model.actuator_trnid[:, 0]] == ROBOT["joints"]
  for name in ROBOT["sensors"].values():
    model.sensor(name)
  for i, foot in enumerate(ROBOT["feet"]):
    assert model.geom(foot).bodyid == model.site(foot).bodyid
    for sensor in (ROBOT["foot_linvel"][i], ROBOT["foot_pos"][i]):
      assert model.sensor_objid[model.sensor(sensor).id] == model.site(foot).id
    for sensor in ROBOT["foot_contact"][i]:
      assert model.sensor_objid[model.sensor(sensor).id] == model.geom(foot).id
  np.testing.assert_allclose(model.actuator_gainprm[:, 0], ROBOT["pd"]["kp"])
  np.testing.assert_allclose(model.dof_damping[6:], ROBOT["pd"]["damping"])
