"""Scenes: one robot's MJCF, the ground it stands on, and what lights it.

A robot's file (`robots/<name>/<name>.xml`) holds the robot alone, written as it stands when only its feet collide. Two
conventions let this file work for all of them: collision geoms of default class `full` belong to the full collision
variants only, and the robot is the first body of the world.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import mujoco

from playground.errors import UnknownNameError, nearest

ROBOTS = Path(__file__).parent

# Contacts MJX's JAX implementation keeps with self-collision (the closest ones); C MuJoCo and Warp ignore these.
_SELF_COLLISION_LIMITS = {"max_contact_points": 30, "max_geom_pairs": 12}


def build_scene(
  robot: str, *, terrain: str = "flat", collision: str = "feet", floor_contacts: Sequence[str] = ()
) -> mujoco.MjSpec:
  """Puts a robot on a terrain.

  Args:
    robot: folder of `playground/robots`, e.g. `go1`.
    terrain: a key of `TERRAINS`. Its ground is geom 0, named `floor`.
    collision: a key of `COLLISIONS`.
    floor_contacts: geoms that get a contact sensor `<geom>_floor_found` (above 0 while the geom touches the floor),
      in this order, after the robot's own sensors.

  Returns:
    The scene, to edit further or `compile()`.

  Raises:
    UnknownNameError: no such robot, terrain, collision variant or geom.
  """
  known = [path.stem for path in sorted(ROBOTS.glob("*/*.xml")) if path.stem == path.parent.name]
  _check("robot", robot, known)
  _check("terrain", terrain, TERRAINS)
  _check("collision", collision, COLLISIONS)
  spec = mujoco.MjSpec.from_file(str(ROBOTS / robot / f"{robot}.xml"))
  COLLISIONS[collision](spec)
  _add_studio(spec)
  TERRAINS[terrain](spec)
  geoms = [geom.name for geom in spec.geoms if geom.name]
  for name in floor_contacts:
    _check("floor_contacts", name, geoms)
    _add_floor_contact(spec, name)
  return spec


def _check(key: str, name: str, known: Sequence[str] | dict[str, Callable]) -> None:
  if name not in known:
    raise UnknownNameError(f"{key}={name!r} is unknown: choose from {', '.join(known)}.{nearest(name, known)}")


def _feet(spec: mujoco.MjSpec) -> None:
  """The feet against the floor, as the MJCF has it; geoms that cannot collide would only cost time."""
  for geom in _full_geoms(spec):
    spec.delete(geom)


def _full_floor(spec: mujoco.MjSpec) -> None:
  """The whole robot against the floor."""
  _activate(spec, contype=0)


def _full_self(spec: mujoco.MjSpec) -> None:
  """The whole robot against the floor and itself (neighbouring links excepted, as MuJoCo always does)."""
  _activate(spec, contype=1)
  for name, value in _SELF_COLLISION_LIMITS.items():
    spec.add_numeric(name=name, size=1, data=[value])


def _full_geoms(spec: mujoco.MjSpec) -> list[mujoco.MjsGeom]:
  return [geom for geom in spec.geoms if geom.classname.name == "full"]


def _activate(spec: mujoco.MjSpec, contype: int) -> None:
  for geom in spec.geoms:
    if geom.contype or geom.conaffinity:  # a foot: slides with friction wherever it touches, not on the floor alone
      geom.condim = 3
      geom.contype = contype
  for geom in _full_geoms(spec):
    geom.contype, geom.conaffinity = contype, 1


def _flat(spec: mujoco.MjSpec) -> None:
  """An infinite plane. Priority 1: its friction and condim count, not the robot's."""
  spec.worldbody.add_geom(
    name="floor",
    type=mujoco.mjtGeom.mjGEOM_PLANE,
    size=[0, 0, 0.01],
    contype=1,
    conaffinity=0,
    condim=3,
    priority=1,
    friction=[0.6, 0.005, 0.0001],
    material="groundplane",
  )


def _add_floor_contact(spec: mujoco.MjSpec, geom: str) -> None:
  """Sensor: number of contacts found (data=found, reduce=mindist, num=1, so 0 or 1) between a geom and the floor."""
  spec.add_sensor(
    name=f"{geom}_floor_found",
    type=mujoco.mjtSensor.mjSENS_CONTACT,
    objtype=mujoco.mjtObj.mjOBJ_GEOM,
    objname=geom,
    reftype=mujoco.mjtObj.mjOBJ_GEOM,
    refname="floor",
    intprm=[1, 1, 1],
  )


def _add_studio(spec: mujoco.MjSpec) -> None:
  """Sky, checkered ground material and a spotlight that follows the robot."""
  spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
  spec.visual.headlight.diffuse = [0.5, 0.5, 0.5]
  spec.visual.headlight.specular = [0, 0, 0]
  spec.visual.rgba.haze = [0.85, 0.89, 0.94, 1]
  spec.add_texture(
    name="sky",
    type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
    builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
    rgb1=[0.85, 0.89, 0.94],
    rgb2=[0.33, 0.47, 0.65],
    width=128,
    height=768,
  )
  spec.add_texture(
    name="groundplane",
    type=mujoco.mjtTexture.mjTEXTURE_2D,
    builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
    mark=mujoco.mjtMark.mjMARK_EDGE,
    rgb1=[0.84, 0.86, 0.88],
    rgb2=[0.74, 0.77, 0.8],
    markrgb=[0.95, 0.96, 0.97],
    width=300,
    height=300,
  )
  ground = spec.add_material(name="groundplane", texuniform=True, texrepeat=[2, 2])
  ground.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "groundplane"
  root = spec.worldbody.first_body()
  spec.worldbody.add_light(
    name="spotlight",
    type=mujoco.mjtLightType.mjLIGHT_SPOT,
    mode=mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODYCOM,
    targetbody=root.name,
    pos=[3, 0, 4],
    diffuse=[0.7, 0.7, 0.7],
    specular=[0.3, 0.3, 0.3],
  )


COLLISIONS: dict[str, Callable[[mujoco.MjSpec], None]] = {
  "feet": _feet,
  "full_floor": _full_floor,
  "full_self": _full_self,
}
TERRAINS: dict[str, Callable[[mujoco.MjSpec], None]] = {"flat": _flat}
