"""Scenes of in-hand manipulation: a hand, palm up, a cube to turn in it and a marker that shows where to."""

from typing import Any

import mujoco

from playground.errors import ConfigError, lookup
from playground.robots.scene import add_studio_floor, added_to, attach, check_keys, read_mjcf

# How the cube lies in the keyframe `home` (w x y z), and where the goal is then (m).
_CUBE_ORIENTATION = (0.810966968, -0.0026289499, -0.585085977, -0.00025430299)
_GOAL_IN_KEYFRAME = (0.25, 0.16, 0)


def build_in_hand_scene(robot: Any) -> mujoco.MjSpec:
  """Puts a cube in a hand, a goal (a mocap body) beside it and a floor 0.25 m below, which collides with the cube only.

  The hand's keyframe `home` is completed with where cube and goal are. After the hand's own sensors come those of the
  `cube` (position, orientation, velocities, angular acceleration, up), `palm_position` and each `<finger>_tip_position`
  as seen from the palm (thumb first), and those of the `goal` (orientation, up).

  Args:
    robot: `env.robot` of a hand: `mjcf` (`playground.robots.scene.find_mjcf`), a file with the keyframe `home` and the
      sites `grasp_site` and `<finger>_tip`; of its `cube` `half_size` (m), `mass` (kg, spread evenly) and `start`
      (position in the keyframe, m).

  Raises:
    ConfigError: a key or the file is missing or invalid, it lacks keyframe or site or has a name of the scene, or
      `start` is not three numbers.
  """
  check_keys(robot, ("mjcf", "cube", "sensors"), "hand")
  if len(robot.cube.start) != 3:
    raise ConfigError(f"env.robot.cube.start={list(robot.cube.start)} must be three numbers: x, y and z in m.")
  spec = read_mjcf(robot.mjcf)
  lookup({key.name: key for key in spec.keys}, "home", f"keyframes of env.robot.mjcf={robot.mjcf}")
  lookup({site.name: site for site in spec.sites}, "grasp_site", f"sites of env.robot.mjcf={robot.mjcf}")
  with added_to(robot.mjcf):
    add_studio_floor(spec, -0.25, contype=2, conaffinity=2)
    attach(spec, "props/hand_cube")
    collides = spec.geom("cube")
    scale, collides.mass = robot.cube.half_size / collides.size[0], robot.cube.mass
    for geom in spec.body("cube").geoms:
      geom.size, geom.pos = scale * geom.size, scale * geom.pos
    site, kind = mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtSensor.mjSENS_FRAMEPOS
    spec.add_sensor(name="palm_position", type=kind, objtype=site, objname="grasp_site")
    tips = [each.name for each in spec.sites if each.name.endswith("_tip")]
    for tip in sorted(tips, key=lambda name: name != "th_tip"):
      palm = {"reftype": site, "refname": "grasp_site"}
      spec.add_sensor(name=f"{tip}_position", type=kind, objtype=site, objname=tip, **palm)
    attach(spec, "props/hand_goal")
  home = spec.key("home")
  home.qpos = [*home.qpos, *robot.cube.start, *_CUBE_ORIENTATION]
  home.mpos, home.mquat = _GOAL_IN_KEYFRAME, (1, 0, 0, 0)
  return spec.copy()  # a copy does not repeat, when compiled, the warning that `attach` silences
