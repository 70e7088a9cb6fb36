"""Scenes: one robot's MJCF, the ground it stands on, and lights.

A robot's file (`robots/<name>/<name>.xml`) holds the robot alone, written as it stands when only its feet collide, and
the solver's options. A few conventions let this file work for all of them:

- the robot is the first body of the world;
- collision geoms of default class `full` belong to the full collision variants only;
- default class `floor` says how the ground touches (friction, priority, masks; without it, as MuJoCo's geoms do), and
  `floor_rough`, if there is one, how a height field does; contact pairs and sensors may name the geom `floor`;
- a keyframe `<name>_rough` takes the place of `<name>` where bumps of 0.05 m may lie under the feet.
"""

import difflib
import importlib.util
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from playground.errors import ConfigError, UnknownNameError, lookup, nearest
from playground.robots.terrain import add_terrain
from playground.text import first_line

ROBOTS = Path(__file__).parent
Gains = float | Sequence[float] | None  # of all servos, or of each
_POSITIONS = {mujoco.mjtJoint.mjJNT_FREE: 7, mujoco.mjtJoint.mjJNT_BALL: 4}  # of a joint in qpos, if not 1
_OF_KEYFRAMES = ("qpos", "qvel", "act", "ctrl", "mpos", "mquat")
GROUND = "studio/groundplane"  # material of the floor

# Contacts MJX's JAX implementation keeps with self-collision (the closest ones); C MuJoCo and Warp ignore these.
_SELF_COLLISION_LIMITS = {"max_contact_points": 30, "max_geom_pairs": 12}

_GROUNDS = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)

# Height of the bumps that the robots' own `_rough` keyframes clear, m.
_ROUGH = 0.05


def find_mjcf(mjcf: str) -> Path:
  """Returns the path of a robot's MJCF; raises UnknownNameError if there is no such file.

  `mjcf` is `my_robot/my_robot.xml`, a file in an importable package (which is not imported), the path of a file, or the
  name of one of our robots.
  """
  ours = {path.stem: path for path in sorted(ROBOTS.glob("*/*.xml")) if path.stem == path.parent.name}
  if mjcf in ours:
    return ours[mjcf]
  if (path := Path(mjcf)).is_file():
    return path
  package, _, rest = mjcf.partition("/")
  try:
    spec = importlib.util.find_spec(package) if package.isidentifier() else None
  except ValueError:  # of `__main__`, which is no package
    spec = None
  for folder in (spec.submodule_search_locations or ()) if spec else ():
    if (path := Path(folder) / rest).is_file():
      return path
  raise UnknownNameError(
    f"env.robot.mjcf={mjcf} does not exist: give the path of a file, or <package>/<path> of an installed package."
    f"{nearest(mjcf, ours)}"
  )


def read_mjcf(mjcf: str) -> mujoco.MjSpec:
  """Reads a robot's MJCF, see `find_mjcf`; raises ConfigError where MuJoCo cannot, or where it has no body."""
  path = find_mjcf(mjcf)
  try:
    spec = mujoco.MjSpec.from_file(str(path))
  except ValueError as error:
    problem = ", ".join(str(error).strip().splitlines())  # the line of the file is on the second
    raise ConfigError(f"env.robot.mjcf={mjcf} is not an MJCF that MuJoCo reads: {problem}.") from None
  if spec.worldbody.first_body() is None:
    raise ConfigError(f"env.robot.mjcf={mjcf} has no body: the robot must be the first body of its <worldbody>.")
  return spec


@contextmanager
def added_to(mjcf: str) -> Iterator[None]:
  """Raises ConfigError where MuJoCo refuses what a scene adds to a robot's MJCF, such as a name that is there twice."""
  try:
    yield
  except ValueError as error:
    if not str(error).startswith("Error: "):  # as MuJoCo's begin
      raise
    remedy = "; rename it in the MJCF" * ("repeated name" in str(error))
    raise ConfigError(
      f"env.robot.mjcf={mjcf} clashes with what the scene adds to it: {first_line(error)}{remedy}."
    ) from None


def check_keys(robot: Mapping[str, Any], keys: Sequence[str], what: str, optional: Sequence[str] = ()) -> None:
  """Checks the keys of `env.robot`; it may have others of its own.

  Raises:
    ConfigError: it lacks one of `keys`, which robots of a kind (`what`) have.
    UnknownNameError: a key is nearly one of them or of `optional`.
  """
  if missing := [key for key in keys if key not in robot]:
    name = robot.get("name")
    raise ConfigError(f"env.robot.{missing[0]} is missing: robot={name} is no {what}, or its YAML is not complete.")
  known = (*keys, *optional)
  for key in robot:
    if key not in known and (like := difflib.get_close_matches(key, known, n=1, cutoff=0.82)):
      raise UnknownNameError(f"env.robot.{key} does not exist. Did you mean {like[0]!r}?")


def build_scene(
  mjcf: str,
  *,
  terrain: str = "flat",
  parameters: Mapping[str, Any] | None = None,
  collision: str = "feet",
  floor_contacts: Sequence[str] = (),
) -> mujoco.MjSpec:
  """Puts a robot on a terrain.

  Args:
    mjcf: the robot's MJCF, see `find_mjcf`; for ours the name, e.g. `go1`.
    terrain: a key of `TERRAINS`. Its ground is geom 0, named `floor`.
    parameters: of the terrain, by name.
    collision: a key of `COLLISIONS`.
    floor_contacts: geoms that get a contact sensor `<geom>_floor_found` (above 0 while the geom touches the floor),
      in this order, after the robot's own sensors, but before the first of contacts between its parts and what follows.

  Raises:
    ConfigError: an invalid MJCF or parameter, a floor or another name of the scene in the MJCF, an unknown name, or a
      collision variant that the robot has no geoms for.
  """
  activate = lookup(COLLISIONS, collision, "env.scene.collision")
  spec = read_mjcf(mjcf)
  _check_qpos(spec, mjcf)
  if any(geom.name == "floor" for geom in spec.geoms):
    raise ConfigError(f"env.robot.mjcf={mjcf} has a geom named floor: remove it, the scene adds the ground.")
  for geom in spec.worldbody.geoms:
    if geom.type in _GROUNDS and (geom.contype or geom.conaffinity):
      ground = f"the geom {geom.name}" if geom.name else "a geom without a name"
      raise ConfigError(f"env.robot.mjcf={mjcf} has a ground, {ground}: remove it, the scene adds one.")
  if collision != "feet" and not _full_geoms(spec):
    feet_only = f"{Path(mjcf).stem} has collision geoms for the feet only"
    remedy = "choose env.scene.collision=feet, or give more geoms the class full"
    raise ConfigError(f"env.scene.collision={collision}: {feet_only}, {remedy}.")
  activate(spec)
  with added_to(mjcf):
    add_studio(spec)
    _set_keyframes(spec, add_terrain(spec, terrain, parameters or {}))
  spec.geom("floor").material = GROUND
  if terrain != "flat":
    for geom in spec.geoms:  # MJX on JAX knows no contact of a cylinder with a height field: rounds off its ends
      if geom.type == mujoco.mjtGeom.mjGEOM_CYLINDER and (geom.contype or geom.conaffinity):
        geom.type = mujoco.mjtGeom.mjGEOM_CAPSULE
  geoms = {geom.name: geom for geom in spec.geoms if geom.name}
  floor = geoms["floor"]
  paired = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
  for name in floor_contacts:
    geom = lookup(geoms, name, "env.robot.floor_contacts")
    if not (name in paired or geom.contype & floor.conaffinity or floor.contype & geom.conaffinity):
      raise ConfigError(
        f"env.robot.mjcf={mjcf}: the geom {name} of env.robot.floor_contacts passes through the floor: "
        'a foot needs conaffinity="1", and the default class floor contype="1", or they need a contact pair.'
      )
  with added_to(mjcf):
    add_floor_contacts(spec, floor_contacts)
  return spec


def _check_qpos(spec: mujoco.MjSpec, mjcf: str) -> None:
  """Raises ConfigError where the first joint is not free, or where a keyframe is not one of the model."""
  if not spec.joints or spec.joints[0].type != mujoco.mjtJoint.mjJNT_FREE:
    body = spec.worldbody.first_body().name
    raise ConfigError(f"env.robot.mjcf={mjcf} needs <freejoint/> as its first joint, in the body {body}.")
  sizes = [_POSITIONS.get(joint.type, 1) for joint in spec.joints]
  for key in spec.keys:
    if len(key.qpos) not in (0, sum(sizes)):  # MuJoCo fills a short one with zeros
      needed = f"qpos must have {sum(sizes)} numbers, 7 for the free joint and 1 for each hinge or slide"
      raise ConfigError(f"env.robot.mjcf={mjcf}: {needed}, but the keyframe {key.name} has {len(key.qpos)}.")
    if not np.isfinite(key.qpos).all():
      raise ConfigError(f"env.robot.mjcf={mjcf}: the keyframe {key.name} has a qpos that is not finite.")
    if len(key.qpos) and not np.array(key.qpos)[3:7].any():  # MuJoCo normalises others
      raise ConfigError(f"env.robot.mjcf={mjcf}: the keyframe {key.name} has no quaternion (w x y z), but zeros.")
    for joint, position in zip(spec.joints, np.split(key.qpos, np.cumsum(sizes)[:-1]), strict=True):
      if joint.type == mujoco.mjtJoint.mjJNT_HINGE and np.abs(position).max(initial=0.0) > 2 * np.pi:
        turned = f"the keyframe {key.name} turns the joint {joint.name} to {position[0]:g} rad"
        raise ConfigError(f"env.robot.mjcf={mjcf}: {turned}: write positions in rad, not in degrees.")
    if spec.key(base := key.name.removesuffix("_rough")) is None:
      raise ConfigError(f"env.robot.mjcf={mjcf}: the keyframe {key.name} is {base} on rough ground: add {base}.")


def _feet(spec: mujoco.MjSpec) -> None:
  """The feet against the floor, as the MJCF has it; geoms without mass that cannot collide would only cost time."""
  for geom in _full_geoms(spec):
    if geom.mass == 0 or geom.parent.explicitinertial:
      spec.delete(geom)


def _full_self(spec: mujoco.MjSpec) -> None:
  """The whole robot against the floor and itself (neighbouring links excepted, as MuJoCo always does)."""
  _full_floor(spec, contype=1)
  for name, value in _SELF_COLLISION_LIMITS.items():
    spec.add_numeric(name=name, size=1, data=[value])


def _full_geoms(spec: mujoco.MjSpec) -> list[mujoco.MjsGeom]:
  return [geom for geom in spec.geoms if geom.classname.name == "full"]


def _full_floor(spec: mujoco.MjSpec, contype: int = 0) -> None:
  """The whole robot against the floor; with contype 1 against itself, too."""
  for geom in spec.geoms:
    if geom.contype or geom.conaffinity:  # a foot: slides with friction wherever it touches, not on the floor alone
      geom.condim = 3
      geom.contype = contype
  for geom in _full_geoms(spec):
    geom.contype, geom.conaffinity = contype, 1


def _set_keyframes(spec: mujoco.MjSpec, peak: float) -> None:
  """Lifts keyframes above the ground's highest point where robots start, `peak` m."""
  lift = {key.name: peak for key in spec.keys}
  for key in list(spec.keys):
    name = key.name.removesuffix("_rough")
    if name == key.name:
      continue
    if peak > 0:
      spec.key(name).qpos, lift[name] = key.qpos, max(0.0, peak - _ROUGH)
    spec.delete(key)
  for key in spec.keys:
    if len(key.ctrl) != len(spec.actuators):
      key.ctrl = []  # which nobody reads, and which would fail to compile before missing servos are named
    if len(key.qpos):  # a keyframe may have none
      key.qpos[2] += lift[key.name]


def load(part: str) -> mujoco.MjSpec:
  """Reads a part's MJCF, e.g. `panda/arm` or `props/cube`."""
  return mujoco.MjSpec.from_file(str(ROBOTS / f"{part}.xml"))


def attach(spec: mujoco.MjSpec, part: str, *, frame: str = "", prefix: str = "") -> None:
  """Puts a part into a scene, at a frame of it or at its origin, with all that belongs to the part.

  None of the part's names, those of default classes and materials included, may be in the scene already.
  """
  where = spec.frame(frame) if frame else spec.worldbody.add_frame()
  keys = [(key.name, {field: list(getattr(key, field)) for field in _OF_KEYFRAMES}) for key in spec.keys]
  # MuJoCo warns that a scene whose parts get no prefix may not be written as XML, which is not needed.
  warning = mujoco.get_mju_user_warning()
  mujoco.set_mju_user_warning(lambda message: None)
  try:
    spec.attach(load(part), prefix=prefix, frame=where)
  finally:
    mujoco.set_mju_user_warning(warning)
  for name, values in keys:  # which MuJoCo empties until it compiles
    for field, value in values.items():
      setattr(spec.key(name), field, value)


def add_contact_sensor(spec: mujoco.MjSpec, geom: str, other: str, *, name: str = "", data: str = "found") -> None:
  """Adds a sensor `<geom>_<other>_<data>` of the deepest contact between two geoms.

  `data` is `found` (above 0 while they touch) or `normal` (3 numbers from `geom` to `other`, zeros while they do not).
  """
  field = {"found": mujoco.mjtConDataField.mjCONDATA_FOUND, "normal": mujoco.mjtConDataField.mjCONDATA_NORMAL}[data]
  spec.add_sensor(
    name=name or f"{geom}_{other}_{data}",
    type=mujoco.mjtSensor.mjSENS_CONTACT,
    objtype=mujoco.mjtObj.mjOBJ_GEOM,
    objname=geom,
    reftype=mujoco.mjtObj.mjOBJ_GEOM,
    refname=other,
    intprm=[1 << int(field), 1, 1],  # 1: the one of smallest distance; 1 contact
  )


def add_floor_contacts(spec: mujoco.MjSpec, geoms: Sequence[str]) -> None:
  """Adds sensors `<geom>_floor_found` of each geom's contact with the floor, before the contact sensors that it has."""
  sensors = list(spec.sensors)
  contacts = [i for i, sensor in enumerate(sensors) if sensor.type == mujoco.mjtSensor.mjSENS_CONTACT]
  after = sensors[contacts[0] :] if contacts else []
  keys = ("name", "type", "objtype", "objname", "reftype", "refname", "intprm")
  moved = [{key: getattr(sensor, key) for key in keys} for sensor in after]
  for sensor in after:
    spec.delete(sensor)
  for geom in geoms:
    add_contact_sensor(spec, geom, "floor")
  for sensor in moved:
    spec.add_sensor(**sensor)


def add_studio(spec: mujoco.MjSpec) -> None:
  """Adds sky, checkered ground material and a spotlight that follows the robot, all named `studio/...`."""
  spec.visual.headlight.ambient = [0.35] * 3
  spec.visual.headlight.diffuse = [0.5] * 3
  spec.visual.headlight.specular = [0, 0, 0]
  spec.visual.rgba.haze = [0.85, 0.89, 0.94, 1]
  attach(spec, "props/studio", prefix="studio/")
  spec.light("studio/spotlight").targetbody = spec.worldbody.first_body().name


def add_studio_floor(spec: mujoco.MjSpec, height: float = 0.0, **properties: Any) -> None:
  """A studio with an infinite plane `height` m above the origin, the geom `floor`; `properties` are the geom's."""
  add_studio(spec)
  plane, at = mujoco.mjtGeom.mjGEOM_PLANE, [0, 0, height]
  spec.worldbody.add_geom(name="floor", type=plane, size=[0, 0, 0.05], pos=at, material=GROUND, **properties)


def set_gains(mj_model: mujoco.MjModel, kp: Gains = None, kv: Gains = None, damping: Gains = None) -> None:
  """Sets the gains of every position servo of a robot, in place; None leaves those of the MJCF.

  A servo's torque is kp * (ctrl - q) - kv * qd, clipped to its range; each hinge itself adds -damping * qd.
  """
  if kp is not None:
    mj_model.actuator_gainprm[:, 0] = kp
    mj_model.actuator_biasprm[:, 1] = -np.asarray(kp)
  if kv is not None:
    mj_model.actuator_biasprm[:, 2] = -np.asarray(kv)
  if damping is not None:
    mj_model.dof_damping[6:] = damping


COLLISIONS: dict[str, Callable[..., None]] = {"feet": _feet, "full_floor": _full_floor, "full_self": _full_self}
