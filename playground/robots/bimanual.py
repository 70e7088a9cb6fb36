"""Scenes of ALOHA 2: two arms at a table and what they handle, by task."""

import mujoco

from playground.errors import UnknownNameError, nearest
from playground.robots.scene import add_studio_floor
from playground.robots.tabletop import load

# Files of `robots/aloha`, one for each task, and how far its left gripper closes, m: a gap left open while it holds the
# box of the handover lets a policy that explores grasp it, as in Playground 0.2.0.
_CLOSED = {"handover": 0.01, "peg_insertion": 0.002}


def build_aloha_scene(task: str) -> mujoco.MjSpec:
  """Puts ALOHA 2 on a floor, with the parts of a task.

  Args:
    task: `handover` or `peg_insertion`.

  Returns:
    The scene, to edit further or `compile()`.

  Raises:
    UnknownNameError: no such task.
  """
  if task not in _CLOSED:
    raise UnknownNameError(f"task={task!r} is unknown: choose from {', '.join(_CLOSED)}.{nearest(task, _CLOSED)}")
  spec = load(f"aloha/{task}")
  add_studio_floor(spec, -0.75, contype=0, conaffinity=0)
  gripper = spec.actuator("left/gripper")
  gripper.ctrlrange = [_CLOSED[task], gripper.ctrlrange[1]]
  for side in ("left", "right"):
    spec.camera(f"{side}/wrist_cam").name = f"wrist_cam_{side}"
  return spec
