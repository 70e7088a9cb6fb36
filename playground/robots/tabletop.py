"""Scenes on a table or floor: an arm, its gripper and objects, each described once and put together here.

A part's file (`robots/<name>/*.xml`, `robots/props/*.xml`) holds that part alone, with default classes of its own. The
arm's file also holds the solver's options and a frame `flange` for the gripper. Bodies come in the order in which parts
are attached, the world's own geoms first; keyframes and sensors belong to the whole scene and are added last.
"""

from collections.abc import Callable

import mujoco
import numpy as np

from playground.errors import lookup
from playground.robots.scene import add_contact_sensor, add_studio_floor, attach, load

# Pose from which the Panda picks things up: joints (rad), fingers (m).
_ARM_HOME = (0, 0.3, 0, -1.57079, 0, 2, -0.7853)
_FINGERS_OPEN = (0.04, 0.04)

# Parts of the gripper that should not touch the floor, a wall or a cabinet.
_GUARDED = ("left_finger_pad", "right_finger_pad", "hand_capsule")


def build_tabletop(name: str) -> mujoco.MjSpec:
  """Returns a scene of `TABLETOPS`. The ground is the geom `floor`; targets are mocap bodies."""
  # A copy does not repeat, when compiled, the warning that `attach` silences.
  return lookup(TABLETOPS, name, "env.scene")().copy()


def _panda() -> mujoco.MjSpec:
  """The Panda with its own hand."""
  spec = load("panda/arm")
  attach(spec, "panda/hand", frame="flange")
  return spec


def _add_studio(spec: mujoco.MjSpec, floor: float = 0.0, *, top: bool = True, sun: float | None = 1.5) -> None:
  """A studio with its floor `floor` m above the arm's base, a light that follows the arm and a sun `sun` m up."""
  add_studio_floor(spec, floor)
  spec.delete(spec.light("studio/spotlight"))
  if top:
    kind, mode = mujoco.mjtLightType.mjLIGHT_SPOT, mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM
    spec.worldbody.add_light(name="top", type=kind, mode=mode, pos=[0, 0, 2])
  if sun:
    spec.worldbody.add_light(type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, pos=[0, 0, sun], diffuse=[0.3] * 3)


def _add_camera(spec: mujoco.MjSpec) -> None:
  """A view from the arm's right, for `env.vision`; the public models have none."""
  quat = [0.845515, 0.526346, 0.047461, 0.07624]
  spec.worldbody.add_camera(name="workspace", pos=[0.75, -1.1, 0.7], quat=quat)


def _add_cube(spec: mujoco.MjSpec) -> None:
  attach(spec, "props/cube")
  for geom in _GUARDED:
    add_contact_sensor(spec, geom, "floor")
  add_contact_sensor(spec, "box", "hand_capsule", name="box_hand_found")


def _panda_single_cube() -> mujoco.MjSpec:
  """A cube to pick up."""
  spec = _panda()
  _add_studio(spec)
  _add_camera(spec)
  _add_cube(spec)
  cube = (0.7, 0, 0.03, 1, 0, 0, 0)
  spec.add_key(name="home", qpos=[*_ARM_HOME, *_FINGERS_OPEN, *cube], ctrl=[*_ARM_HOME, 0.04])
  return spec


def _panda_single_cube_camera() -> mujoco.MjSpec:
  """A red cube to pick up, a white strip where it may lie, a camera on both, one light, materials to draw."""
  spec = _panda()
  for i in range(10):
    white, blue, alpha = 1 - 0.1 * i / 9, 1 - 0.08 * i / 9, 1 - 0.05 * i
    spec.add_material(name=f"off_white{i}", rgba=[white, white, blue, alpha], shininess=0.25)
  _add_studio(spec, sun=None)
  spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.3] * 3, [0.6] * 3
  strip = {"size": [0.02, 1, 0.01], "pos": [0.631, 0, 0.001], "rgba": [1, 1, 1, 1], "contype": 0, "conaffinity": 0}
  spec.worldbody.add_geom(name="init_space", type=mujoco.mjtGeom.mjGEOM_PLANE, **strip)
  quat = [0.657706645, 0.265371277, 0.263783826, 0.653772244]
  spec.worldbody.add_camera(name="front", pos=[1.176, 0.001, 0.483], quat=quat, fovy=42)
  _add_cube(spec)
  spec.body("box").pos = [1, 0, 0.03]
  spec.geom("box").rgba = [1, 0, 0, 1]
  low = (-2e-05, 0.47804, -0.00055, -1.81309, -0.00161, 2.34597, 0.78501)
  spec.add_key(name="low_home", qpos=[*low, *_FINGERS_OPEN, 0.7, 0, 0.03, 1, 0, 0, 0], ctrl=[*low, 0.04])
  arm = (0.0481, 0.5604, -0.0417, -1.8459, 0.0342, 2.3654, 0.7852)
  cube = (0.6368, 0.0064, 0.1179, 1, 0.0001, -0.001, -0.0063)
  spec.add_key(name="picked", qpos=[*arm, 0.0198, 0.02, *cube], ctrl=[*arm, 0])
  return spec


def _panda_single_cube_pixels() -> mujoco.MjSpec:
  """The same for a camera: a dark floor that shows the strip, a sun, and an invisible target."""
  spec = _panda_single_cube_camera()
  floor = spec.geom("floor")
  floor.material, floor.rgba = "", [0.125, 0.125, 0.125, 1]
  spec.body("mocap_target").geoms[0].rgba = [0, 0, 0, 0]  # the ray caster knows no other transparency than all of it
  coat = spec.material("off_white")
  for body in ("hand", "left_finger", "right_finger"):  # painted with the arm's material, so that it can be randomised
    for geom in spec.body(body).geoms:
      if np.allclose(geom.rgba, coat.rgba):
        geom.material, geom.rgba = coat.name, [0.5, 0.5, 0.5, 1]  # MuJoCo's default: no colour of its own
  light = spec.light("top")
  light.type, light.mode = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, mujoco.mjtCamLight.mjCAMLIGHT_FIXED
  light.pos, light.dir = [2.25, 0, 1.15], [-1.589, -0.001, -0.971]
  return spec


def _panda_cabinet() -> mujoco.MjSpec:
  """A drawer to open, from an arm stretched upwards."""
  spec = _panda()
  spec.geom("hand_capsule").conaffinity = 3  # meets the cabinet, too
  _add_studio(spec)
  quat = [0.0492779628, 0.0492779628, 0.705387611, 0.705387611]
  spec.worldbody.add_camera(name="side", pos=[0.5, 1.381, 0.476], quat=quat)
  attach(spec, "props/cabinet")
  for geom in _GUARDED:
    add_contact_sensor(spec, "barrier", geom)
  spec.add_key(name="upright", qpos=[0] * 10, ctrl=[0] * 8)
  return spec


def _panda_robotiq_cube() -> mujoco.MjSpec:
  """A foam block to push over a table, with torques, before a wall; gravity does not pull the robot."""
  spec = load("panda/arm")
  attach(spec, "panda/robotiq_2f85", frame="flange")
  for body in spec.bodies[1:]:
    body.gravcomp = 1
  for i in range(1, 8):  # servos become motors: a control of 1 is 150 Nm (the first four) or 20 Nm, in light joints
    spec.joint(f"joint{i}").damping[0] = 1
    motor = spec.actuator(f"actuator{i}")
    motor.set_to_motor()
    motor.gear[0] = 150 if i <= 4 else 20
    motor.inheritrange, motor.ctrlrange = 0, [-1, 1]
  spec.option.iterations = spec.option.ls_iterations = spec.option.ccd_iterations = 10
  spec.visual.global_.azimuth, spec.visual.global_.elevation = -40, -30
  _add_studio(spec, -0.02297, top=False, sun=3)
  _add_camera(spec)
  wall = {"size": [0.48, 0.75, 0.05], "pos": [0.946, 0, 0.5], "quat": [1, 0, -1, 0]}
  spec.worldbody.add_geom(name="wall", type=mujoco.mjtGeom.mjGEOM_PLANE, **wall)
  table = {"size": [0.315, 0.6, 0.01], "pos": [0.54586, 0.02337, -0.02], "contype": 0, "conaffinity": 0}
  spec.worldbody.add_geom(name="pad", type=mujoco.mjtGeom.mjGEOM_BOX, rgba=[0.5, 0.5, 0.5, 0.2], **table)
  attach(spec, "props/yoga_block")
  for side in ("left", "right"):
    for part in ("coupler_col_1", "coupler_col_2", "follower_pad2"):
      add_contact_sensor(spec, f"{side}_{part}", "box", data="normal")
  for other in ("wall", "floor"):
    for geom in _GUARDED:
      add_contact_sensor(spec, other, geom)
  arm = (-0.182772, 0.146282, 0.172246, -2.24238, -0.0788546, 2.45127, 0.0160022)
  block = (0.56784, -0.0253974, 0.0306525, 0, 0, 0, 1)
  spec.add_key(name="home", qpos=[*arm, *[0.8] * 6, *block], ctrl=[*[0] * 7, 0.82])
  return spec


def _aloha(task: str, closed: float) -> mujoco.MjSpec:
  """ALOHA 2 with the parts of a task; its left gripper closes up to `closed`, m."""
  spec = load(f"aloha/{task}")
  add_studio_floor(spec, -0.75, contype=0, conaffinity=0)
  gripper = spec.actuator("left/gripper")
  gripper.ctrlrange = [closed, gripper.ctrlrange[1]]
  for side in ("left", "right"):
    spec.camera(f"{side}/wrist_cam").name = f"wrist_cam_{side}"
  return spec


TABLETOPS: dict[str, Callable[[], mujoco.MjSpec]] = {
  "panda_single_cube": _panda_single_cube,
  "panda_single_cube_camera": _panda_single_cube_camera,
  "panda_single_cube_pixels": _panda_single_cube_pixels,
  "panda_cabinet": _panda_cabinet,
  "panda_robotiq_cube": _panda_robotiq_cube,
  # A gap left open while it holds the box lets a policy that explores grasp it, as in Playground 0.2.0.
  "handover": lambda: _aloha("handover", 0.01),
  "peg_insertion": lambda: _aloha("peg_insertion", 0.002),
}
