"""Noise on the pose of an object that a camera tracks, and poses that are plainly wrong for a moment."""

from collections.abc import Mapping
from typing import Any

import jax
from mujoco.mjx._src.math import normalize

from playground.mdp.noise import uniform_noise
from playground.mdp.rotations import turn_at_random, uniform_quat

Pose = tuple[jax.Array, jax.Array]  # position m [3], orientation [4]

DRAWS = (("pose_pos", "pose_quat"), ("injected_quat", "injected_pos", "injected"))  # random keys, as 0.2.0 splits them
_INJECTED_REACH = 0.5  # m


def sensed_pose(keys: Mapping[str, jax.Array], pose: Pose, config: Any, level: float, parity: bool) -> Pose:
  """A tracker's reading of a pose (paper, Appendix C.4).

  Args:
    keys: random keys by the names in `DRAWS`.
    pose: the exact one.
    config: `pos`: m, uniform in +- on each axis; `angle`: rad, largest turn, about a random axis; `injection`: with
      this probability the reading has nothing to do with the pose: within +- 0.5 m, turned anyhow.
    level: factor on all of them.
    parity: as Playground 0.2.0, noise of the standard deviation `angle` on the quaternion's entries: its turns are
      about three times as large.
  """
  pos, quat = pose
  pos = uniform_noise(keys["pose_pos"], pos, level * config.pos)
  if parity:
    quat = normalize(quat + level * config.angle * jax.random.normal(keys["pose_quat"], (4,)))
  else:
    quat = turn_at_random(keys["pose_quat"], quat, level * config.angle)
  wrong = level * jax.random.bernoulli(keys["injected"], config.injection)
  reach = _INJECTED_REACH
  injected = jax.random.uniform(keys["injected_pos"], (3,), minval=-reach, maxval=reach)
  return pos * (1 - wrong) + injected * wrong, quat * (1 - wrong) + uniform_quat(keys["injected_quat"]) * wrong
