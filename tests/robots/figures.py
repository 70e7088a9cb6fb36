"""Scenes as the figures of the reference models have them, and models rebuilt from those figures alone."""

import dataclasses
import functools
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

from playground.config import config_dict
from playground.robots.in_hand import build_in_hand_scene
from playground.robots.scene import build_scene

TESTS = Path(__file__).parents[1]
HANDS = ("leap_hand", "aero_hand")

# Solver fields of a joint, by name in the figures, where they have them, and in MuJoCo's specifications.
SOLVER_FIELDS = {"solreflimit": "solref_limit", "solimplimit": "solimp_limit"}


@dataclasses.dataclass(frozen=True)
class Scene:
  """One of our scenes, and what of its figures is deliberately not so here.

  Attributes:
    robot: folder of `playground/robots`.
    terrain: as in `build_scene`.
    collision: as in `build_scene`.
    pd: gains that the reference's first task on this scene sets, where they are not the robot's own.
    no_sensors: sensors of the reference that nothing reads.
    more_sensors: sensors that we have besides.
    no_geom_fields: fields of collision geoms that act nowhere.
    no_excludes: pairs of bodies, excluded from contact in the reference, that have nothing which collides.
    no_keyframes: keyframes of the reference that nothing starts from.
    no_tendon_lengths: tendons that touch a pulley at a point, so that rounding adds a turn around it or not.
    ranges: of joints, rad, that are mistakes in the reference.
    spec: builds the scene, where it is another than a robot on a terrain.
  """

  robot: str
  terrain: str = "flat"
  collision: str = "feet"
  pd: dict[str, float] = dataclasses.field(default_factory=dict)
  no_sensors: tuple[str, ...] = ()
  more_sensors: tuple[str, ...] = ()
  no_geom_fields: tuple[str, ...] = ()
  no_excludes: tuple[tuple[str, str], ...] = ()
  no_keyframes: tuple[str, ...] = ()
  no_tendon_lengths: tuple[str, ...] = ()
  ranges: dict[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
  spec: Callable[[], mujoco.MjSpec] | None = None


def robot_config(robot: str) -> dict[str, Any]:
  """What `configs/robot/<robot>.yaml` says."""
  return yaml.safe_load((TESTS.parent / f"configs/robot/{robot}.yaml").read_text())


def in_hand_scene(hand: str, **changes: Any) -> mujoco.MjSpec:
  """The scene of a hand of `configs/robot`, some keys changed."""
  return build_in_hand_scene(config_dict(robot_config(hand) | changes))


@functools.cache
def figures(name: str) -> dict[str, Any]:
  return json.loads((TESTS / f"figures/{name}.json").read_text())


def floor_contacts(facts: dict[str, Any]) -> list[str]:
  """Geoms with a sensor for contact with the floor, in sensor order."""
  return [s["obj"] for s in facts["sensors"] if s["type"] == "contact" and s["ref"] == "floor"]


def build(scene: Scene, facts: dict[str, Any]) -> mujoco.MjModel:
  """Compiles our scene, with the contact sensors of the figures."""
  if scene.spec:
    return scene.spec().compile()
  spec = build_scene(
    scene.robot, terrain=scene.terrain, collision=scene.collision, floor_contacts=floor_contacts(facts)
  )
  return spec.compile()


def enum(kind: Any, name: str) -> Any:
  """The member of a MuJoCo enumeration that the figures call by its bare name."""
  return next(m for m in kind.__members__.values() if m.name.split("_", 1)[1].lower() == name)


def named(name: str) -> str:
  """The name of an object; the figures call unnamed ones `kind#id`."""
  return "" if "#" in name else name


def close(actual: Any, figure: Any, key: object = None) -> None:
  # Figures have nine significant digits.
  np.testing.assert_allclose(np.ravel(actual), np.ravel(figure), rtol=2e-8, atol=1e-12, err_msg=str(key))


def flags(kind: Any, names: Iterable[str]) -> int:
  return sum(int(enum(kind, name)) for name in names)


def rebuild(facts: dict[str, Any], hfield_data: np.ndarray | None = None) -> mujoco.MjModel:
  """Returns a model made from the figures alone (heights of a height field apart, which they do not have)."""
  spec = mujoco.MjSpec()
  spec.compiler.degree = False
  option = facts["option"]
  for key in ("timestep", "iterations", "ls_iterations", "tolerance", "ls_tolerance", "ccd_iterations", "impratio"):
    setattr(spec.option, key, option[key])
  spec.option.integrator = enum(mujoco.mjtIntegrator, option["integrator"])
  spec.option.cone = enum(mujoco.mjtCone, option["cone"])
  spec.option.disableflags = flags(mujoco.mjtDisableBit, option["disableflags"])
  bodies = {"world": spec.worldbody}
  for b in facts["bodies"][1:]:
    body = bodies[b["name"]] = bodies[b["parent"]].add_body(name=b["name"], pos=b["pos"], quat=b["quat"])
    body.mocap, body.gravcomp = "mocapid" in b, b.get("gravcomp", 0)
    if b["mass"]:  # else the body is fixed to its parent and weighs nothing
      body.explicitinertial = True
      body.mass, body.ipos, body.iquat, body.inertia = (b[key] for key in ("mass", "ipos", "iquat", "inertia"))
  for j in facts["joints"]:
    if j["type"] == "free":
      bodies[j["body"]].add_freejoint()
      continue
    bodies[j["body"]].add_joint(
      name=j["name"], type=enum(mujoco.mjtJoint, j["type"]), pos=j["pos"], axis=j["axis"], range=j["range"],
      damping=[j["damping"], 0, 0], armature=j["armature"], frictionloss=j["frictionloss"], limited=j["limited"],
      stiffness=[j["stiffness"], 0, 0], springref=j["springref"], ref=j["ref"],
      **{to: j[key] for key, to in SOLVER_FIELDS.items() if key in j},
      actfrcrange=j.get("actfrcrange", [0, 0]), actfrclimited="actfrcrange" in j,
    )  # fmt: skip
  for h in facts["hfields"]:
    assert hfield_data is not None and hfield_data.size == h["nrow"] * h["ncol"]
    spec.add_hfield(name=h["name"], size=h["size"], nrow=h["nrow"], ncol=h["ncol"], userdata=hfield_data)
  for g in facts["collision_geoms"]:
    bodies[g["body"]].add_geom(
      type=enum(mujoco.mjtGeom, g["type"]), hfieldname=g.get("hfield", ""),
      **{k: g[k] for k in ("name", "size", "pos", "quat", "contype", "conaffinity", "condim", "friction", "solref")},
      **{k: g[k] for k in ("solimp", "solmix", "margin", "gap", "priority")},
    )  # fmt: skip
  used = {s["obj"] for s in facts["sensors"]} | {s.get("ref") for s in facts["sensors"]}
  used |= {w["obj"] for t in facts["tendons"] for w in t["path"]}
  for g in facts["other_geoms"]:
    if g["name"] in used:
      shape = {key: g[key] for key in ("name", "size", "pos", "quat")}
      bodies[g["body"]].add_geom(type=enum(mujoco.mjtGeom, g["type"]), contype=0, conaffinity=0, **shape)
  for p in facts["contact_pairs"]:
    keys = ("name", "condim", "friction", "solref", "solreffriction", "solimp", "margin", "gap")
    spec.add_pair(geomname1=p["geom1"], geomname2=p["geom2"], **{k: p[k] for k in keys})
  for e in facts["contact_excludes"]:
    spec.add_exclude(bodyname1=e["body1"], bodyname2=e["body2"])
  for s in facts["sites"]:
    bodies[s["body"]].add_site(name=s["name"], pos=s["pos"], quat=s["quat"])
  for t in facts["tendons"]:
    tendon = spec.add_tendon(name=t["name"], stiffness=[t.get("stiffness", 0), 0, 0], springlength=t["springlength"])
    for w in t["path"]:
      if w["wrap"] == "site":
        tendon.wrap_site(w["obj"])
      else:
        tendon.wrap_geom(w["obj"], w.get("sidesite", ""))
  for e in facts["equality"]:
    spec.add_equality(
      type=enum(mujoco.mjtEq, e["type"]), objtype=enum(mujoco.mjtObj, e["objtype"]), name1=e["obj1"], name2=e["obj2"],
      active=e["active"], data=padded(e["data"], mujoco.mjNEQDATA), solref=e["solref"], solimp=e["solimp"],
    )  # fmt: skip
  for s in facts["sensors"]:
    ref = {"reftype": enum(mujoco.mjtObj, s["reftype"]), "refname": s["ref"]} if "ref" in s else {}
    spec.add_sensor(
      name=s["name"], type=enum(mujoco.mjtSensor, s["type"]), objtype=enum(mujoco.mjtObj, s["objtype"]),
      objname=s["obj"], intprm=s.get("intprm", [0, 0, 0]), **ref,
    )  # fmt: skip
  for a in facts["actuators"]:
    spec.add_actuator(
      name=a["name"], target=a["target"], trntype=enum(mujoco.mjtTrn, a["trntype"]), gainprm=padded(a["gainprm"]),
      biastype=enum(mujoco.mjtBias, a["biastype"]), biasprm=padded(a["biasprm"]), gear=a["gear"],
      ctrllimited=a["ctrllimited"], ctrlrange=a["ctrlrange"], forcelimited=a["forcelimited"],
      forcerange=a["forcerange"],
    )  # fmt: skip
  return spec.compile()


def padded(parameters: list[float], size: int = 10) -> list[float]:
  """Parameters, of actuators unless `size` says otherwise, with the trailing zeros that the figures leave out."""
  return parameters + [0.0] * (size - len(parameters))


def reaching(model: mujoco.MjModel, home: dict[str, Any]) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
  """Random velocities, targets and poses near a keyframe's; every second turns loose bodies any way up."""
  rng = np.random.default_rng(0)
  result = []
  for i in range(16):
    qpos = np.array(home["qpos"], float)
    for kind, start, limits in zip(model.jnt_type, model.jnt_qposadr, model.jnt_range, strict=True):
      if kind != mujoco.mjtJoint.mjJNT_FREE:
        qpos[start] += rng.normal(0, 0.1) * (limits[1] - limits[0])
        continue
      qpos[start : start + 3] += rng.normal([0, 0, -0.02], 0.02)
      if i % 2:
        qpos[start + 3 : start + 7] = rng.normal(size=4)
      qpos[start + 3 : start + 7] /= np.linalg.norm(qpos[start + 3 : start + 7])
    spread = np.diff(model.actuator_ctrlrange).ravel()
    result.append((qpos, rng.normal(0, 1, model.nv), home["ctrl"] + rng.normal(0, 0.1, model.nu) * spread))
  return result


def states(model: mujoco.MjModel, keyframe: str) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
  """Random velocities and targets at poses near the keyframe, feet at the ground, and fallen or upside down near it."""
  rng = np.random.default_rng(0)
  home = model.key(keyframe)
  result = []
  for i in range(16):
    qpos = home.qpos + np.concatenate([[0, 0, rng.uniform(-0.03, 0.01)], rng.normal(0, 0.05, model.nq - 3)])
    qpos[2] -= 0.03 * model.nhfield  # on which keyframes stand higher
    if i % 2:
      qpos[2] = rng.uniform(0, 0.4) * home.qpos[2]
      qpos[3:7] = rng.normal(size=4)
    qpos[3:7] /= np.linalg.norm(qpos[3:7])
    result.append((qpos, rng.normal(0, 1, model.nv), home.ctrl + rng.normal(0, 0.5, model.nu)))
  return result


def forward(model: mujoco.MjModel, state: tuple[np.ndarray, ...]) -> tuple[mujoco.MjData, np.ndarray]:
  """The data after `mj_forward`, and the mass matrix."""
  data, mass = mujoco.MjData(model), np.zeros((model.nv, model.nv))
  data.qpos, data.qvel, data.ctrl = state
  mujoco.mj_forward(model, data)
  mujoco.mj_fullM(model, data, mass)
  return data, mass
