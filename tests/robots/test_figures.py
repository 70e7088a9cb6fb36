"""Every robot's scenes against the figures of the reference models: number by number, and as dynamics (C MuJoCo)."""

import copy
import functools
from typing import Any

import mujoco
import numpy as np
import pytest

from playground.robots.scene import set_gains
from playground.robots.tabletop import build_tabletop
from tests.robots.figures import (
  Scene,
  build,
  close,
  enum,
  figures,
  flags,
  floor_contacts,
  forward,
  in_hand_scene,
  named,
  padded,
  reaching,
  rebuild,
  states,
)
from tests.robots.figures import robot_config as config_of

BARKOUR_LEGS = ("front_left", "hind_left", "front_right", "hind_right")
G1_RANGES = {"right_hip_roll_joint": (-2.9671, 0.5236)}  # in 0.2.0 that of the left one, not mirrored
SCENES = {
  "go1_feetonly_flat": Scene("go1"),
  "go1_full_flat": Scene("go1", collision="full_self", no_sensors=("head_pos",)),
  "go1_standard_flat": Scene("go1", collision="full_floor", no_sensors=("head_pos",)),
  "spot_feetonly_flat": Scene("spot"),
  "spot_full_flat": Scene(
    "spot",
    collision="full_floor",
    pd={"kp": 400.0, "kv": 0.0, "damping": 20.0},
    more_sensors=("FR_pos", "FL_pos", "HR_pos", "HL_pos"),
    no_geom_fields=("solimp",),  # the floor's counts: it has priority
  ),
  "barkour": Scene(
    "barkour",
    more_sensors=(
      *("upvector", "local_linvel", "base_gyro", "base_linvel", "base_accelerometer"),
      *(f"foot_{leg}_global_linvel" for leg in BARKOUR_LEGS),
      *(f"foot_{leg}_pos" for leg in BARKOUR_LEGS),
    ),
  ),
  "h1_feetonly": Scene("h1"),
  "op3_feetonly": Scene("op3"),
  "go1_feetonly_rough": Scene("go1", terrain="white_noise"),
  **{f"{name}_feetonly_flat": Scene(name) for name in ("berkeley_humanoid", "t1")},
  **{f"{name}_feetonly_rough": Scene(name, terrain="white_noise") for name in ("berkeley_humanoid", "t1")},
  "g1_feetonly_flat": Scene("g1", ranges=G1_RANGES),
  "g1_feetonly_rough": Scene("g1", terrain="white_noise", ranges=G1_RANGES),
  "apollo_feetonly_flat": Scene(
    "apollo",
    more_sensors=("l_foot_global_linvel", "r_foot_global_linvel"),
    no_geom_fields=("solref", "margin"),  # contact pairs have their own
  ),
  "aero_hand_cube": Scene(
    "aero_hand",
    spec=functools.partial(in_hand_scene, "aero_hand"),
    no_tendon_lengths=("if_tendon1", "mf_tendon1", "rf_tendon1", "pf_tendon1"),  # which have no spring and no servo
  ),
  "leap_cube": Scene("leap_hand", spec=functools.partial(in_hand_scene, "leap_hand")),
  **{
    name: Scene(
      "panda",
      spec=functools.partial(build_tabletop, name),
      no_excludes=(("link0", "link1"),) if name != "panda_robotiq_cube" else (),
      no_keyframes=unused,
    )
    for name, unused in (
      ("panda_single_cube", ("pickup", "pickup1")),
      ("panda_single_cube_camera", ()),
      ("panda_cabinet", ("home",)),
      ("panda_robotiq_cube", ()),
    )
  },
  "aloha_peg": Scene("aloha", spec=functools.partial(build_tabletop, "peg_insertion")),
  "aloha_handover": Scene("aloha", spec=functools.partial(build_tabletop, "handover")),
}

GEOM_FIELDS = (
  "pos", "contype", "conaffinity", "condim", "friction", "solref", "solimp", "solmix", "margin", "gap", "priority",
  "group",
)  # fmt: skip


# A joint's solver fields in the figures, in the model, and what they are where the figures do not have them.
JOINT_SOLVER = (
  ("solreflimit", "jnt_solref", (0.02, 1)),
  ("solimplimit", "jnt_solimp", (0.9, 0.95, 0.001, 0.5, 2)),
)


class Subject:
  """One scene: `model` is ours, `facts` its figures, `reference` the model rebuilt from them."""

  def __init__(self, name: str):
    self.name, self.scene, self.facts = name, SCENES[name], figures(name)
    for joint, reach in self.scene.ranges.items():
      self.facts = copy.deepcopy(self.facts)
      for figure in (*self.facts["joints"], *self.facts["actuators"]):
        if joint in (figure["name"], figure.get("target")):
          figure["ctrlrange" if "target" in figure else "range"] = reach
    self.model = build(self.scene, self.facts)
    set_gains(self.model, **self.scene.pd)
    self.reference = rebuild(self.facts, self.model.hfield_data)
    self.sensors = [s for s in self.facts["sensors"] if s["name"] not in self.scene.no_sensors]

  def names(self, kind: Any, count: int) -> list[str]:
    return [mujoco.mj_id2name(self.model, kind, i) or "" for i in range(count)]


@pytest.fixture(params=SCENES, scope="module")
def subject(request: pytest.FixtureRequest) -> Subject:
  return Subject(request.param)


def test_counts(subject: Subject) -> None:
  model, facts = subject.model, subject.facts
  ours = {"ngeom", "nmesh", "nlight"}  # we draw otherwise
  ours |= {"nsensor", "nsensordata"}  # have a test of their own
  if subject.scene.terrain != "flat":
    ours |= {"nkey"}  # one file serves all terrains
  if not facts["counts"]["ncam"]:
    ours |= {"ncam"}  # ours have one, for env.vision
  counts = {key: count for key, count in facts["counts"].items() if key not in ours}
  counts["nexclude"] -= len(subject.scene.no_excludes)
  if "nkey" in counts:
    counts["nkey"] -= len(subject.scene.no_keyframes)
  assert {key: getattr(model, key) for key in counts} == counts
  close(model.body_mass.sum(), facts["total_mass"])
  close(model.qpos0, facts["qpos0"])
  numerics = {figure["name"]: figure["data"] for figure in facts["numerics"]}
  assert {model.numeric(i).name: list(model.numeric(i).data) for i in range(model.nnumeric)} == numerics


def test_options(subject: Subject) -> None:
  option, figure = subject.model.opt, subject.facts["option"]
  for key in ("timestep", "iterations", "ls_iterations", "tolerance", "ls_tolerance", "ccd_iterations", "gravity"):
    close(getattr(option, key), figure[key], key)
  for key in ("ccd_tolerance", "noslip_iterations", "impratio", "wind", "density", "viscosity", "o_solref", "o_solimp"):
    close(getattr(option, key), figure[key], key)
  assert option.integrator == enum(mujoco.mjtIntegrator, figure["integrator"])
  assert option.cone == enum(mujoco.mjtCone, figure["cone"])
  assert option.solver == enum(mujoco.mjtSolver, figure["solver"])
  assert option.jacobian == enum(mujoco.mjtJacobian, figure["jacobian"])
  assert option.disableflags == flags(mujoco.mjtDisableBit, figure["disableflags"])
  assert option.enableflags == flags(mujoco.mjtEnableBit, figure["enableflags"])
  drawn = () if subject.scene.terrain == "flat" else ("extent", "center", "azimuth")  # one file serves all terrains
  for key, value in subject.facts["statistic"].items():
    if key not in drawn:
      close(getattr(subject.model.stat, key), value, key)
  for key in {"offwidth", "offheight", "fovy", "azimuth", "elevation"}.difference(drawn):
    close(getattr(subject.model.vis.global_, key), subject.facts["visual"][key], key)


def test_bodies(subject: Subject) -> None:
  for figure in subject.facts["bodies"]:
    body = subject.model.body(figure["id"])
    assert body.name == named(figure["name"])
    if figure["parent"]:
      assert subject.model.body(int(body.parentid[0])).name == named(figure["parent"])
    for key in ("pos", "quat", "mass", "inertia", "ipos", "iquat") if figure["mass"] else ("pos", "quat", "mass"):
      close(getattr(body, key), figure[key], (body.name, key))
    close(subject.model.body_gravcomp[figure["id"]], figure.get("gravcomp", 0), (body.name, "gravcomp"))


def test_joints(subject: Subject) -> None:
  model = subject.model
  for figure in subject.facts["joints"]:
    joint, dof = model.joint(figure["id"]), figure["dofadr"]
    assert joint.name == named(figure["name"])
    assert joint.type[0] == enum(mujoco.mjtJoint, figure["type"])
    assert model.body(int(joint.bodyid[0])).name == figure["body"]
    assert (joint.qposadr[0], joint.dofadr[0]) == (figure["qposadr"], dof)
    for key in ("damping", "armature", "frictionloss"):
      close(getattr(model, f"dof_{key}")[dof], figure[key], (joint.name, key))
    if figure["type"] == "free":
      continue
    assert bool(joint.limited[0]) == figure["limited"]
    for key in ("pos", "axis", "range", "stiffness"):
      close(getattr(joint, key), figure[key], (joint.name, key))
    close(model.qpos_spring[figure["qposadr"]], figure["springref"], (joint.name, "springref"))
    for key, field, default in JOINT_SOLVER:
      close(getattr(model, field)[figure["id"]], figure.get(key, default), (joint.name, key))
    assert bool(model.jnt_actfrclimited[figure["id"]]) == ("actfrcrange" in figure)
    if "actfrcrange" in figure:
      close(model.jnt_actfrcrange[figure["id"]], figure["actfrcrange"], (joint.name, "actfrcrange"))


def test_actuators(subject: Subject) -> None:
  for figure in subject.facts["actuators"]:
    actuator = subject.model.actuator(figure["id"])
    assert actuator.name == figure["name"]
    assert actuator.trntype[0] == enum(mujoco.mjtTrn, figure["trntype"])
    target = mujoco.mjtObj.mjOBJ_TENDON if figure["trntype"] == "tendon" else mujoco.mjtObj.mjOBJ_JOINT
    assert mujoco.mj_id2name(subject.model, target, int(actuator.trnid[0])) == figure["target"]
    for key, kind in (("gaintype", mujoco.mjtGain), ("biastype", mujoco.mjtBias), ("dyntype", mujoco.mjtDyn)):
      assert getattr(actuator, key)[0] == enum(kind, figure[key]), (actuator.name, key)
    for key in ("gainprm", "biasprm"):
      close(getattr(actuator, key), padded(figure[key]), (actuator.name, key))
    for key in ("gear", "ctrllimited", "ctrlrange", "forcelimited", "forcerange"):
      close(getattr(actuator, key), figure[key], (actuator.name, key))


def test_sites(subject: Subject) -> None:
  for figure in subject.facts["sites"]:
    site = subject.model.site(figure["id"])
    assert site.name == figure["name"]
    assert subject.model.body(int(site.bodyid[0])).name == named(figure["body"])
    assert site.group[0] == figure["group"]
    for key in ("pos", "quat"):
      close(getattr(site, key), figure[key], (site.name, key))


def test_sensors(subject: Subject) -> None:
  """The figures' sensors, and only those that we say we have besides; the feet-only scenes also in their order."""
  model, scene = subject.model, subject.scene
  ours = subject.names(mujoco.mjtObj.mjOBJ_SENSOR, model.nsensor)
  assert sorted(ours) == sorted([*(figure["name"] for figure in subject.sensors), *scene.more_sensors])
  in_order = scene.collision == "feet"
  if in_order:
    assert [name for name in ours if name not in scene.more_sensors] == [figure["name"] for figure in subject.sensors]
  for figure in subject.sensors:
    sensor = model.sensor(figure["name"])
    assert sensor.type[0] == enum(mujoco.mjtSensor, figure["type"])
    assert (sensor.dim[0], sensor.cutoff[0]) == (figure["dim"], figure["cutoff"])
    if in_order and not scene.more_sensors:
      assert sensor.adr[0] == figure["adr"]
    objtype = enum(mujoco.mjtObj, figure["objtype"])
    assert sensor.objtype[0] == objtype
    assert mujoco.mj_id2name(model, objtype, int(sensor.objid[0])) == figure["obj"]
    if "ref" in figure:
      reftype = enum(mujoco.mjtObj, figure["reftype"])
      assert sensor.reftype[0] == reftype
      assert mujoco.mj_id2name(model, reftype, int(sensor.refid[0])) == figure["ref"]
    if "intprm" in figure:
      assert list(model.sensor_intprm[sensor.id]) == figure["intprm"]


def test_collision_geoms(subject: Subject) -> None:
  """Exactly the figures' geoms collide, in their order; all others are drawn only."""
  model = subject.model
  in_pairs = {*model.pair_geom1, *model.pair_geom2}
  colliding = [i for i in range(model.ngeom) if model.geom_contype[i] or model.geom_conaffinity[i] or i in in_pairs]
  assert colliding[0] == 0
  for i, figure in zip(colliding, subject.facts["collision_geoms"], strict=True):
    geom = model.geom(i)
    assert named(figure["name"]) in ("", geom.name)
    assert model.body(int(geom.bodyid[0])).name == figure["body"]
    assert geom.type[0] == enum(mujoco.mjtGeom, figure["type"])
    np.testing.assert_allclose(orientation(geom.quat, figure), orientation(figure["quat"], figure), atol=1e-8)
    for key in GEOM_FIELDS:
      if key not in subject.scene.no_geom_fields:
        close(getattr(geom, key), figure[key], (geom.name, key))
    if figure["type"] != "plane":  # whose size is how it is drawn
      used = {"sphere": 1, "capsule": 2, "cylinder": 2}.get(figure["type"], 3)
      close(geom.size[:used], figure["size"][:used], (geom.name, "size"))


def orientation(quat: Any, figure: dict[str, Any]) -> np.ndarray:
  """How a geom of the figure's type stands: its axes, its axis if it is round about that and the same both ways."""
  axes = np.zeros(9)
  mujoco.mju_quat2Mat(axes, np.array(quat, float))
  axis = axes.reshape(3, 3)[:, 2]
  return np.outer(axis, axis) if figure["type"] in ("capsule", "cylinder") else axes


def test_pairs_and_excludes(subject: Subject) -> None:
  model = subject.model
  for figure in subject.facts["contact_pairs"]:
    pair = model.pair(figure["id"])
    assert pair.name == figure["name"]
    assert [model.geom(int(g)).name for g in (pair.geom1[0], pair.geom2[0])] == [figure["geom1"], figure["geom2"]]
    close(pair.dim, figure["condim"], (pair.name, "condim"))
    for key in ("friction", "solref", "solreffriction", "solimp", "margin", "gap"):
      close(getattr(model, f"pair_{key}")[figure["id"]], figure[key], (pair.name, key))
  bodies = [(model.body(int(s) >> 16).name, model.body(int(s) & 0xFFFF).name) for s in model.exclude_signature]
  excludes = [(e["body1"], e["body2"]) for e in subject.facts["contact_excludes"]]
  assert sorted([*bodies, *subject.scene.no_excludes]) == sorted(excludes)


def test_keyframes(subject: Subject) -> None:
  for figure in (k for k in subject.facts["keyframes"] if k["name"] not in subject.scene.no_keyframes):
    key = subject.model.key(figure["name"])
    np.testing.assert_allclose(key.qpos, figure["qpos"], rtol=1e-8, atol=1e-9, err_msg=key.name)
    close(key.ctrl, figure["ctrl"], key.name)
    close(key.qvel, np.zeros(subject.model.nv))
    for field in {"mpos", "mquat"} & figure.keys():
      close(getattr(key, field), figure[field], (key.name, field))


def test_cameras(subject: Subject) -> None:
  for figure in subject.facts["cameras"]:
    camera = subject.model.cam(figure["id"])
    assert camera.name == figure["name"]
    assert subject.model.body(int(camera.bodyid[0])).name == named(figure["body"])
    assert camera.mode[0] == enum(mujoco.mjtCamLight, figure["mode"])
    for key in ("pos", "quat", "fovy"):
      np.testing.assert_allclose(getattr(camera, key).ravel(), np.ravel(figure[key]), rtol=1e-8, atol=1e-9)


def test_equality(subject: Subject) -> None:
  model = subject.model
  for figure in subject.facts["equality"]:
    i, objtype = figure["id"], enum(mujoco.mjtObj, figure["objtype"])
    assert model.eq_type[i] == enum(mujoco.mjtEq, figure["type"])
    if figure["type"] != "joint":  # which says what its objects are
      assert model.eq_objtype[i] == objtype
    assert model.eq_active0[i] == figure["active"]
    objects = [mujoco.mj_id2name(model, objtype, int(obj)) for obj in (model.eq_obj1id[i], model.eq_obj2id[i])]
    assert objects == [figure["obj1"], figure["obj2"]]
    close(model.eq_data[i], padded(figure["data"], mujoco.mjNEQDATA), i)
    for key in ("solref", "solimp"):
      close(getattr(model, f"eq_{key}")[i], figure[key], (i, key))


def test_tendons(subject: Subject) -> None:
  model = subject.model
  kinds = {mujoco.mjtWrap.mjWRAP_SITE: model.site, mujoco.mjtWrap.mjWRAP_CYLINDER: model.geom}
  for figure in subject.facts["tendons"]:
    tendon = model.tendon(figure["id"])
    assert tendon.name == figure["name"]
    for key in ("limited", "range", "damping", "frictionloss", "armature", "width"):
      close(getattr(model, f"tendon_{key}")[tendon.id], figure[key], (tendon.name, key))
    close(model.tendon_stiffness[tendon.id], figure.get("stiffness", 0), (tendon.name, "stiffness"))
    if tendon.name not in subject.scene.no_tendon_lengths:
      close(model.tendon_length0[tendon.id], figure["length0"], (tendon.name, "length0"))
      close(model.tendon_lengthspring[tendon.id], figure["springlength"], (tendon.name, "springlength"))
    first = model.tendon_adr[tendon.id]
    for i, wrap in zip(range(first, first + model.tendon_num[tendon.id]), figure["path"], strict=True):
      kind = mujoco.mjtWrap(model.wrap_type[i])
      assert kind == enum(mujoco.mjtWrap, wrap["wrap"])
      assert kinds[kind](int(model.wrap_objid[i])).name == wrap["obj"]
      if kind == mujoco.mjtWrap.mjWRAP_CYLINDER:
        side = int(model.wrap_prm[i])
        assert (model.site(side).name if side >= 0 else None) == wrap.get("sidesite")


def test_dynamics(subject: Subject) -> None:
  """Mass matrix, forces, contacts, accelerations and sensors equal those of a model rebuilt from the figures."""
  model, scene, keyframes = subject.model, subject.scene, subject.facts["keyframes"]
  touching = 0
  poses = states(model, config_of(scene.robot)["keyframe"]) if not scene.spec else reaching(model, keyframes[0])
  for state in poses:
    (ours, mass), (theirs, mass_there) = forward(subject.model, state), forward(subject.reference, state)
    touching += ours.ncon > 0
    assert (ours.ncon, ours.nefc) == (theirs.ncon, theirs.nefc)
    np.testing.assert_allclose(mass, mass_there, rtol=1e-6, atol=1e-9)
    for key in ("qfrc_bias", "qfrc_passive", "actuator_force", "qfrc_actuator", "qacc"):
      expected = getattr(theirs, key)
      bound = 1e-6 * max(1.0, np.abs(expected).max())
      np.testing.assert_allclose(getattr(ours, key), expected, rtol=1e-6, atol=bound, err_msg=key)
    for figure in subject.sensors:
      expected = theirs.sensor(figure["name"]).data
      bound = 1e-6 * max(1.0, np.abs(expected).max(), np.abs(theirs.qacc).max())
      np.testing.assert_allclose(ours.sensor(figure["name"]).data, expected, atol=bound, err_msg=figure["name"])
  assert touching >= 8


ON_LEGS = [name for name, scene in SCENES.items() if scene.collision == "feet" and not scene.spec]


@pytest.mark.parametrize("name", ON_LEGS)
def test_robot_yaml(name: str) -> None:
  """Every name in configs/robot/<robot>.yaml is in the model, and lists over feet follow `feet`."""
  facts, robot = figures(name), config_of(SCENES[name].robot)
  model = build(SCENES[name], facts)
  model.body(robot["root"])
  model.key(robot["keyframe"])
  base = model.site(robot["base_site"]).id
  assert robot["floor_contacts"] == floor_contacts(facts)
  assert [model.joint(i).name for i in range(1, model.njnt)] == robot["joints"]
  assert [model.joint(int(j)).name for j in model.actuator_trnid[:, 0]] == robot["joints"]
  for joint in (*robot.get("hips", []), *robot.get("knees", [])):
    assert joint in robot["joints"]
  for sensor in robot["sensors"].values():
    assert model.sensor_objtype[model.sensor(sensor).id] == mujoco.mjtObj.mjOBJ_SITE
  for sensor in ("gyro", "linvel", "accelerometer"):
    assert model.sensor_objid[model.sensor(robot["sensors"][sensor]).id] == base
  for i, foot in enumerate(robot["feet"]):
    site = model.site(foot)
    for key in ("foot_linvel", "foot_pos"):
      if robot[key]:
        assert model.sensor_objid[model.sensor(robot[key][i]).id] == site.id
    for sensor in robot["foot_contact"][i] if robot["foot_contact"] else []:
      assert model.geom_bodyid[model.sensor_objid[model.sensor(sensor).id]] == site.bodyid[0]
  gains = [model.actuator_gainprm.copy(), model.actuator_biasprm.copy(), model.dof_damping.copy()]
  set_gains(model, **robot["pd"])  # are those of the MJCF
  for actual, before in zip((model.actuator_gainprm, model.actuator_biasprm, model.dof_damping), gains, strict=True):
    np.testing.assert_allclose(actual, before)
