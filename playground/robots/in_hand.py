"""Scenes of in-hand manipulation: a hand, palm up, a cube to turn in it and a marker that shows where to."""

import dataclasses

import mujoco

from playground.errors import UnknownNameError, nearest
from playground.robots.scene import add_studio_floor
from playground.robots.tabletop import load


@dataclasses.dataclass(frozen=True)
class Cube:
  """A cube as a hand is given it.

  Attributes:
    half_size: m.
    mass: kg, spread evenly.
    start: position in the keyframe `home`, m.
  """

  half_size: float
  mass: float
  start: tuple[float, float, float]


# Cube of each hand, a folder of `playground/robots`.
CUBES = {
  "leap_hand": Cube(half_size=0.035, mass=0.108, start=(0.1, 0, 0.05)),
  "aero_hand": Cube(half_size=0.025, mass=0.0692, start=(0.12, 0, 0.05)),
}

# How the cube lies in the keyframe `home` (w x y z).
_CUBE_ORIENTATION = (0.810966968, -0.0026289499, -0.585085977, -0.00025430299)

# The goal is a marker, but a body that collides, as in Playground 0.2.0: a cube of the LEAP's, beside the hand.
_GOAL, _GOAL_POSITION, _GOAL_IN_KEYFRAME = CUBES["leap_hand"], (0.325, 0.17, 0.0475), (0.25, 0.16, 0)

# Colours of a drawn cube's faces by axis, towards minus and plus.
_FACES = (
  ((0.9, 0.35, 0.1), (0.8, 0.1, 0.15)),
  ((0.1, 0.55, 0.3), (0.15, 0.35, 0.8)),
  ((0.95, 0.95, 0.92), (0.95, 0.8, 0.15)),
)


def build_in_hand_scene(hand: str) -> mujoco.MjSpec:
  """Puts a cube in a hand, a goal (a mocap body) beside it and a floor 0.25 m below, which only the cube meets.

  The hand's keyframe `home` is completed with where cube and goal are. After the hand's own sensors come those of the
  `cube` (position, orientation, velocities, angular acceleration, up), `palm_position` and each `<finger>_tip_position`
  as seen from the palm (thumb first), and those of the `goal` (orientation, up).

  Args:
    hand: a key of `CUBES`.

  Returns:
    The scene, to edit further or `compile()`.

  Raises:
    UnknownNameError: no such hand.
  """
  if hand not in CUBES:
    raise UnknownNameError(f"hand={hand!r} is unknown: choose from {', '.join(CUBES)}.{nearest(hand, CUBES)}")
  spec = load(f"{hand}/right_hand")
  add_studio_floor(spec, -0.25, contype=2, conaffinity=2)
  _add_cube(spec, CUBES[hand])
  _add_position_sensors(spec)
  _add_goal(spec)
  home = spec.key("home")
  home.qpos = [*home.qpos, *CUBES[hand].start, *_CUBE_ORIENTATION]
  home.mpos, home.mquat = _GOAL_IN_KEYFRAME, (1, 0, 0, 0)
  return spec


def _add_cube(spec: mujoco.MjSpec, cube: Cube) -> None:
  body = spec.worldbody.add_body(name="cube", pos=[0.11, 0, 0.1])
  body.add_freejoint(name="cube_freejoint")
  body.add_site(name="cube_center", group=4)
  _draw_cube(body, cube.half_size)
  _add_box(body, cube, name="cube", conaffinity=2, friction=[0.3, 0.05, 0.0001])
  types = {
    "position": mujoco.mjtSensor.mjSENS_FRAMEPOS,
    "orientation": mujoco.mjtSensor.mjSENS_FRAMEQUAT,
    "linvel": mujoco.mjtSensor.mjSENS_FRAMELINVEL,
    "angvel": mujoco.mjtSensor.mjSENS_FRAMEANGVEL,
    "angacc": mujoco.mjtSensor.mjSENS_FRAMEANGACC,
    "upvector": mujoco.mjtSensor.mjSENS_FRAMEZAXIS,
  }
  for name, kind in types.items():
    spec.add_sensor(name=f"cube_{name}", type=kind, objtype=mujoco.mjtObj.mjOBJ_BODY, objname="cube")


def _add_position_sensors(spec: mujoco.MjSpec) -> None:
  """Where palm and fingertips are, the sites `grasp_site` and `<finger>_tip`."""
  site, kind = mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtSensor.mjSENS_FRAMEPOS
  spec.add_sensor(name="palm_position", type=kind, objtype=site, objname="grasp_site")
  palm = {"reftype": site, "refname": "grasp_site"}
  tips = [each.name for each in spec.sites if each.name.endswith("_tip")]
  for tip in sorted(tips, key=lambda name: name != "th_tip"):
    spec.add_sensor(name=f"{tip}_position", type=kind, objtype=site, objname=tip, **palm)


def _add_goal(spec: mujoco.MjSpec) -> None:
  body = spec.worldbody.add_body(name="goal", mocap=True, pos=_GOAL_POSITION)
  _draw_cube(body, _GOAL.half_size)
  _add_box(body, _GOAL)
  types = {"orientation": mujoco.mjtSensor.mjSENS_FRAMEQUAT, "upvector": mujoco.mjtSensor.mjSENS_FRAMEZAXIS}
  for name, kind in types.items():
    spec.add_sensor(name=f"cube_goal_{name}", type=kind, objtype=mujoco.mjtObj.mjOBJ_BODY, objname="goal")


def _add_box(body: mujoco.MjsBody, cube: Cube, **properties: object) -> None:
  """The cube that collides and weighs."""
  body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[cube.half_size] * 3, mass=cube.mass, group=3, **properties)


def _draw_cube(body: mujoco.MjsBody, half_size: float) -> None:
  """A black cube with a plate of its own colour on every face, so that a video shows how it is turned."""
  drawn = {"type": mujoco.mjtGeom.mjGEOM_BOX, "mass": 0, "group": 2, "contype": 0, "conaffinity": 0}
  body.add_geom(**drawn, size=[0.99 * half_size] * 3, rgba=[0.08, 0.08, 0.09, 1])
  for axis, colours in enumerate(_FACES):
    for sign, colour in zip((-1, 1), colours, strict=True):
      size, pos = [0.8 * half_size] * 3, [0.0] * 3
      size[axis], pos[axis] = 0.01 * half_size, sign * 0.99 * half_size
      body.add_geom(**drawn, size=size, pos=pos, rgba=[*colour, 1])
