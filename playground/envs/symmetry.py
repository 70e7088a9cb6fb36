"""Left-right symmetry of robots on legs: the observation and the action of the mirror image.

The mirror is the robot's x-z plane (y becomes -y). A robot's YAML says which parts of names are left and right
(`mirror: {left_: right_}`); the signs of joints follow from their axes in the model. An observation term's function
says how its vector mirrors, with `playground.mdp.options.mirrors_as`. Sensors count as lying in the plane of the mirror
(the Go1's inertial sensor is 6.6 cm beside it).
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np
from scipy.linalg import block_diag

from playground.envs.base import PIXELS, Env
from playground.envs.task import Task
from playground.errors import ConfigError
from playground.mdp.legged import LeggedRobot
from playground.mdp.managers import ACTOR
from playground.mdp.options import MirrorKind
from playground.mdp.terms import Term

_SIGNS: dict[str, list[float]] = {
  "same": [1.0],
  "opposite": [-1.0],
  "polar": [1.0, -1.0, 1.0],
  "axial": [-1.0, 1.0, -1.0],
  "command": [1.0, -1.0, -1.0],
  "quaternion": [1.0, -1.0, 1.0, -1.0],
}
_AXIS_TOLERANCE, _ANCHOR_TOLERANCE = 1e-3, 5e-3  # of a unit vector; m, as drawn robots are not quite symmetric
_RANGE_TOLERANCE = 0.06  # rad; Spot's hips differ by 0.051


class Reflection(NamedTuple):
  """A vector's mirror image: element i is `sign[i]` times the element `source[i]`, both shape [n]."""

  source: np.ndarray
  sign: np.ndarray

  def __call__(self, x: jax.Array) -> jax.Array:
    return x[..., self.source] * self.sign


class Mirror(NamedTuple):
  """The mirror image of observations, by group, and of actions."""

  obs: Mapping[str, Reflection]
  action: Reflection


def mirror_of(env: Env) -> Mirror:
  """Returns the mirror of a task.

  Raises:
    ConfigError: the task's robot has none, or an observation term does not say how it mirrors.
  """
  task: Any = env.unwrapped
  if not isinstance(task, Task) or not isinstance(task.robot, LeggedRobot):
    raise ConfigError("only tasks of robots on legs have a left-right mirror, and this task has no such robot.")
  robot, joints = task.robot, joint_reflection(task.robot)
  of_joints = np.eye(len(joints.sign))[joints.source] * joints.sign[:, None]
  of_feet = np.eye(len(robot.foot_names))[partners(robot, robot.foot_names)]
  groups: dict[str, np.ndarray] = {}
  for group, sizes in task.observation_parts.items():
    parts = []
    for term in task.observations.groups[group]:
      inherits = group != ACTOR and term.name == ACTOR
      parts.append(groups[ACTOR] if inherits else _of_term(term, sizes[term.name], of_joints, of_feet))
    step = np.asarray(block_diag(*parts))
    groups[group] = _repeated(step, sum(sizes.values()))  # the group `state` may hold several steps
  obs = {group: Reflection(np.abs(m).argmax(axis=1), m.sum(axis=1, dtype=np.float32)) for group, m in groups.items()}
  return Mirror(obs, joints)


def augmentation(env: Env) -> Mirror:
  """Returns the mirror for `agent.mirror_augmentation`.

  Raises:
    ConfigError: the task has none, or has images.
  """
  sizes = env.observation_size
  try:
    if isinstance(sizes, Mapping) and any(group.startswith(PIXELS) for group in sizes):
      raise ConfigError("images are not mirrored.")
    return mirror_of(env)
  except ConfigError as error:
    raise ConfigError(
      f"agent.mirror_augmentation=true: {error} agent.mirror_augmentation=false trains without."
    ) from None


def joint_reflection(robot: LeggedRobot) -> Reflection:
  """Returns the mirror image of a vector of joints, and of the action, whose actuators stand in the joints' order.

  Raises:
    ConfigError: the robot's YAML has no `mirror`, or its model is not its own mirror image.
  """
  model = robot.mj_model
  data = mujoco.MjData(model)
  mujoco.mj_kinematics(model, data)
  root = model.jnt_bodyid[0]
  to_root = data.xmat[root].reshape(3, 3).T
  axes, anchors = data.xaxis[1:] @ to_root.T, (data.xanchor[1:] - data.xpos[root]) @ to_root.T
  source = partners(robot, robot.joint_names)
  turns = (model.jnt_type[1:] == mujoco.mjtJoint.mjJNT_HINGE)[:, None]
  flip = np.where(turns, _SIGNS["axial"], _SIGNS["polar"])
  cosine = (flip * axes * axes[source]).sum(axis=1)
  sign = np.sign(cosine)
  apart = anchors * _SIGNS["polar"] - anchors[source]
  apart -= (apart * axes[source]).sum(axis=1, keepdims=True) * axes[source]  # a hinge may lie anywhere on its axis
  apart = np.abs(apart).max(axis=1)
  pose, ranges = np.asarray(robot.default_pose), model.jnt_range[1:]
  for i, name in enumerate(robot.joint_names):
    other = robot.joint_names[source[i]]
    if abs(cosine[i]) < 1 - _AXIS_TOLERANCE or apart[i] > _ANCHOR_TOLERANCE:
      raise ConfigError(f"env.robot.mirror: joints {name} and {other} of the model are not mirror images.")
    if abs(pose[i] - sign[i] * pose[source[i]]) > _AXIS_TOLERANCE:
      raise ConfigError(f"env.robot.mirror: the default pose of {name} is not the mirror image of {other}'s.")
    reach = ranges[source[i]] if sign[i] > 0 else -ranges[source[i]][::-1]
    if np.abs(ranges[i] - reach).max() > _RANGE_TOLERANCE:
      raise ConfigError(f"env.robot.mirror: the range of {name} is not the mirror image of {other}'s.")
  return Reflection(source, sign.astype(np.float32))


def partners(robot: LeggedRobot, names: tuple[str, ...]) -> np.ndarray:
  """Returns the index of the part on the other side, for each of `names`; a part on neither side is its own.

  Raises:
    ConfigError: the robot's YAML has no `mirror`, or no part of that name is on the other side.
  """
  if not robot.left_to_right:
    raise ConfigError("the robot's YAML has no `mirror`, such as {left_: right_}: its left and right are not known.")
  found = []
  for name in names:
    other = _other_side(name, robot.left_to_right)
    if other not in names:
      raise ConfigError(f"env.robot.mirror: the other side of {name} would be {other}, which the robot does not have.")
    found.append(names.index(other))
  return np.array(found)


def _other_side(name: str, pairs: Mapping[str, str]) -> str:
  """Returns a name with its beginning or end replaced by that of the other side."""
  for left, right in pairs.items():
    for this, other in ((left, right), (right, left)):
      if name.startswith(this):
        return other + name.removeprefix(this)
      if name.endswith(this):
        return name.removesuffix(this) + other
  return name


def _of_term(term: Term, size: int, joints: np.ndarray, feet: np.ndarray) -> np.ndarray:
  """Returns the matrix that turns a term's vector of `size` into its mirror image, shape [size, size]."""
  kind: MirrorKind | None = getattr(term.func, "mirror", None)
  if kind is None:
    raise ConfigError(
      f"{term.key} does not say how it mirrors: write @mirrors_as(...) (playground.mdp.options) above its function, "
      f"{term.func.__module__}:{term.func.__name__}."
    )
  matrices = {name: np.diag(signs) for name, signs in _SIGNS.items()} | {"joints": joints, "feet": feet}
  matrices["feet_polar"] = np.kron(feet, matrices["polar"])
  whole = _repeated(matrices[kind], size)
  _check_options(term, whole)
  return whole


def _check_options(term: Term, whole: np.ndarray) -> None:
  """Raises ConfigError where a term's scale or clip treats left and right differently."""
  scale, clip = term.options.scale, term.options.clip
  factors = np.resize(np.atleast_1d(1.0 if scale is None else scale), len(whole))
  uneven = clip is not None and clip[0] != -clip[1] and (whole < 0).any()
  if uneven or not np.array_equal(factors, np.abs(whole) @ factors):
    raise ConfigError(f"{term.key}: its scale or clip is not the same on the left and on the right.")


def _repeated(matrix: np.ndarray, size: int) -> np.ndarray:
  """Returns the matrix for a vector of `size` that repeats the vector of `matrix`.

  Raises:
    ConfigError: it does not fit a whole number of times.
  """
  if size % len(matrix):
    raise ConfigError(f"an observation has {size} numbers, and its mirror image is of vectors of {len(matrix)}.")
  return np.kron(np.eye(size // len(matrix)), matrix)
