"""What the parts of observations are, in which frame and unit: for `policy.yaml`."""

from collections.abc import Callable, Mapping
from typing import Any

from playground.envs.base import Env
from playground.envs.locomotion.legged import LeggedTask
from playground.envs.manipulation.in_hand import InHand
from playground.envs.manipulation.push import PushCube
from playground.envs.manipulation.tabletop import TabletopTask
from playground.mdp.hand_observations import HAND_OBSERVATIONS
from playground.mdp.observations import OBSERVATIONS

_AT = "Position of {}, world frame, m [3]."
_AXES = "Orientation of {}: last two rows of its rotation matrix in the world frame [6]."
_GRIPPERS = {
  f"{prefix}gripper{what}": text.format(f"the {word}gripper")
  for prefix, word in (("", ""), ("left_", "left "), ("right_", "right "))
  for what, text in (("", _AT), ("_pos", _AT), ("_axes", _AXES))
}
_TABLETOP = _GRIPPERS | {
  "qpos": "Positions of `joints` in their order: rad, m; of a free one m and a quaternion, w first, world frame [nq].",
  "qvel": "Their velocities: rad/s, m/s; of a free one m/s in the world frame, then rad/s in its own [nv].",
  "joint_pos": "Joint positions of the arm, rad [7].",
  "joint_vel": "Joint velocities of the arm, rad/s [7].",
  "servo_error": "Targets of the actuators minus the positions of their joints, rad, m [nu].",
  "finger_gaps": "How far each finger is open beyond the box's half width, m [4].",
  "body_axes": _AXES.format("what is to be moved"),
  "gripper_to_body": "From the gripper to what is to be moved, world frame, m [3].",
  "body_to_target": "From what is to be moved to its target, world frame, m [3].",
  "axes_error": "First two rows of the target's rotation matrix minus those of what is to be moved, world frame [6].",
  "target_pos": _AT.format("the target"),
  "target_axes": _AXES.format("the target"),
  "target_to_box": "From the target to the box, world frame, m [3].",
  "box_pos": _AT.format("the box"),
  "box_axes": _AXES.format("the box"),
  "box_top": _AT.format("the box's upper end"),
  "box_bottom": _AT.format("the box's lower end"),
  "socket": _AT.format("the socket"),
  "socket_entrance": _AT.format("the socket's entrance"),
  "socket_up": "Third row of the socket's rotation matrix in the world frame [3].",
  "peg": _AT.format("the peg"),
  "peg_end2": _AT.format("the peg's end that goes in"),
  "peg_up": "Third row of the peg's rotation matrix in the world frame [3].",
  "no_solution": "1 where the inverse kinematics found no joint angles for the last action, else 0 [1].",
  "last_act": "The action just applied [action_size].",
  "time": "Share of the episode that is over [1].",
}
_PUSH = _TABLETOP | {"last_act": "The action just applied, its delay included [action_size]."}
_KINDS: tuple[tuple[type[Env], Mapping[str, Callable[..., Any] | str]], ...] = (
  (LeggedTask, OBSERVATIONS | {"past_frames": "All parts above in the steps before, newest first."}),
  (InHand, HAND_OBSERVATIONS),
  (PushCube, _PUSH),
  (TabletopTask, _TABLETOP),
)


def describe_part(env: Env, name: str) -> str:
  """One sentence about a part of a task's observation; "" where there is none."""
  parts = next((parts for kind, parts in _KINDS if isinstance(env.unwrapped, kind)), {})
  said = parts.get(name, "")
  return said if isinstance(said, str) else (said.__doc__ or "").strip().splitlines()[0]
