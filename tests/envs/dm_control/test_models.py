"""Every task's model equals the figures of Playground's, number by number; only looks are our own."""

from typing import Any

import mujoco
import numpy as np
import pytest
from mujoco import mjtObj

from tests.envs.dm_control.suite import DOMAIN, facts_of
from tests.envs.golden import load_task
from tests.robots.figures import close, enum, flags, named, padded

# Sections of the figures: the prefix of MuJoCo's arrays, the kind of object.
SECTIONS = {
  "bodies": ("body", mjtObj.mjOBJ_BODY),
  "joints": ("jnt", mjtObj.mjOBJ_JOINT),
  "sites": ("site", mjtObj.mjOBJ_SITE),
  "sensors": ("sensor", mjtObj.mjOBJ_SENSOR),
  "actuators": ("actuator", mjtObj.mjOBJ_ACTUATOR),
  "tendons": ("tendon", mjtObj.mjOBJ_TENDON),
  "cameras": ("cam", mjtObj.mjOBJ_CAMERA),
}
_ENUMS = {
  "jnt_type": mujoco.mjtJoint, "geom_type": mujoco.mjtGeom, "site_type": mujoco.mjtGeom,
  "sensor_type": mujoco.mjtSensor, "sensor_objtype": mjtObj, "sensor_reftype": mjtObj, "cam_mode": mujoco.mjtCamLight,
  "actuator_trntype": mujoco.mjtTrn, "actuator_dyntype": mujoco.mjtDyn, "actuator_gaintype": mujoco.mjtGain,
  "actuator_biastype": mujoco.mjtBias,
}  # fmt: skip
# What the figures call otherwise: the array, and the field of the figure that is its index in place of the id.
_ALIASES = {
  "jnt_damping": ("dof_damping", "dofadr"), "jnt_armature": ("dof_armature", "dofadr"),
  "jnt_frictionloss": ("dof_frictionloss", "dofadr"), "jnt_springref": ("qpos_spring", "qposadr"),
  "jnt_ref": ("qpos0", "qposadr"), "jnt_solreflimit": ("jnt_solref", "id"), "jnt_solimplimit": ("jnt_solimp", "id"),
  "tendon_springlength": ("tendon_lengthspring", "id"),
}  # fmt: skip
_LOOKS = {"rgba", "material"}
_OTHERWISE = {"id", "name", "path"}  # has a check of its own


class Subject:
  """A task's compiled model and its figures."""

  def __init__(self, task: str):
    self.facts = facts_of(task)
    self.model: mujoco.MjModel = load_task(task).mj_model

  def name(self, kind: Any, index: int) -> str:
    return mujoco.mj_id2name(self.model, kind, index) or ""

  def value(self, prefix: str, key: str, figure: dict[str, Any]) -> Any:
    """What our model has for a key of a figure."""
    model, i = self.model, figure["id"]
    read = lambda field: int(getattr(model, f"{prefix}_{field}")[i])
    match prefix, key:
      case _, "parent":
        return None if i == 0 else self.name(mjtObj.mjOBJ_BODY, read("parentid"))
      case _, "body":
        return self.name(mjtObj.mjOBJ_BODY, read("bodyid"))
      case "sensor", "obj" | "ref":
        return self.name(mjtObj(read(f"{key}type")), read(f"{key}id"))
      case "actuator", "target":
        return self.name(enum(mjtObj, figure["trntype"]), int(model.actuator_trnid[i, 0]))
      case "cam", "target":
        return self.name(mjtObj.mjOBJ_BODY, read("targetbodyid"))
    array, index = _ALIASES.get(f"{prefix}_{key}", (f"{prefix}_{key}", "id"))
    return getattr(model, array)[figure[index]]

  def compare(self, prefix: str, figure: dict[str, Any]) -> None:
    skip = {"solreflimit", "solimplimit"} if figure.get("type") == "free" else set()  # it has no limits
    for key in figure.keys() - _LOOKS - _OTHERWISE - skip:
      where = (prefix, figure["name"], key)
      actual, expected = self.value(prefix, key, figure), figure[key]
      if f"{prefix}_{key}" in _ENUMS:
        assert actual == enum(_ENUMS[f"{prefix}_{key}"], expected), where
      elif isinstance(expected, str | None):
        assert actual == (expected and named(expected)), where
      else:
        expected = padded(expected) if key.endswith("prm") else expected
        close(actual, np.broadcast_to(expected, np.shape(actual)), where)


@pytest.fixture(params=DOMAIN, scope="module")
def subject(request: pytest.FixtureRequest) -> Subject:
  return Subject(request.param)


def test_counts(subject: Subject) -> None:
  counts = {key: count for key, count in subject.facts["counts"].items() if key != "nlight"}
  assert {key: getattr(subject.model, key) for key in counts} == counts
  close(subject.model.body_mass.sum(), subject.facts["total_mass"])
  close(subject.model.qpos0, subject.facts["qpos0"])
  numerics = {figure["name"]: figure["data"] for figure in subject.facts["numerics"]}
  ours = [subject.model.numeric(i) for i in range(subject.model.nnumeric)]
  assert {numeric.name: list(numeric.data) for numeric in ours} == numerics


def test_options(subject: Subject) -> None:
  option = subject.model.opt
  kinds = {"integrator": mujoco.mjtIntegrator, "cone": mujoco.mjtCone, "solver": mujoco.mjtSolver}
  kinds |= {"jacobian": mujoco.mjtJacobian}
  bits = {"disableflags": mujoco.mjtDisableBit, "enableflags": mujoco.mjtEnableBit}
  for key, expected in subject.facts["option"].items():
    if key in kinds:
      assert getattr(option, key) == enum(kinds[key], expected), key
    elif key in bits:
      assert getattr(option, key) == flags(bits[key], expected), key
    else:
      close(getattr(option, key), expected, key)
  for key, expected in subject.facts["statistic"].items():
    close(getattr(subject.model.stat, key), expected, key)


@pytest.mark.parametrize("section", SECTIONS)
def test_things(subject: Subject, section: str) -> None:
  prefix, kind = SECTIONS[section]
  for figure in subject.facts[section]:
    assert subject.name(kind, figure["id"]) == named(figure["name"])
    subject.compare(prefix, figure)


def test_geoms(subject: Subject) -> None:
  """The same geoms collide; what is only drawn has mass and a place as well."""
  model, facts = subject.model, subject.facts
  colliding = [figure["id"] for figure in facts["collision_geoms"]]
  assert [i for i in range(model.ngeom) if model.geom_contype[i] or model.geom_conaffinity[i]] == colliding
  for figure in [*facts["collision_geoms"], *facts["other_geoms"]]:
    assert subject.name(mjtObj.mjOBJ_GEOM, figure["id"]) == named(figure["name"])
    subject.compare("geom", figure)


def test_tendons_pass_through_the_same_objects(subject: Subject) -> None:
  model = subject.model
  for figure in subject.facts["tendons"]:
    start = model.tendon_adr[figure["id"]]
    for i, step in enumerate(figure["path"], start):
      wrap = enum(mujoco.mjtWrap, step["wrap"])
      assert model.wrap_type[i] == wrap
      assert subject.name(enum(mjtObj, step["wrap"]), model.wrap_objid[i]) == step["obj"]
      close(model.wrap_prm[i], step.get("coef", model.wrap_prm[i]))
    assert model.tendon_num[figure["id"]] == len(figure["path"])
