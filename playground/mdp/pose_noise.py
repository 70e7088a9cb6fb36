"""Noise on the pose of an object that a camera tracks, and poses that are wrong altogether for a moment."""

from collections.abc import Callable
from typing import Any

import jax

from playground.mdp.rotations import turn_at_random, uniform_quat

Pose = tuple[jax.Array, jax.Array]  # position m [3], orientation [4]

_INJECTED_REACH = 0.5  # m


def sensed_pose(
  key: jax.Array,
  pose: Pose,
  config: Any,
  level: float,
  turn: Callable[[jax.Array, jax.Array, float], jax.Array] = turn_at_random,
) -> Pose:
  """Returns a tracker's reading of a pose (paper, Appendix C.4).

  Args:
    key: random key.
    pose: the exact one.
    config: `pos`: m, uniform in +- on each axis; `angle`: rad, largest turn, about a random axis; `injection`: with
      this probability the reading has nothing to do with the pose: within +- 0.5 m, in any orientation.
    level: factor on all of them.
    turn: turns an orientation at random by at most an angle in rad: (key, orientation, angle) -> orientation.
  """
  pos_key, quat_key, wrong_key, wrong_pos_key, wrong_quat_key = jax.random.split(key, 5)
  offset = jax.random.uniform(pos_key, (3,), minval=-1.0, maxval=1.0)
  pos, quat = pose[0] + level * config.pos * offset, turn(quat_key, pose[1], level * config.angle)
  wrong = level * jax.random.bernoulli(wrong_key, config.injection)
  reach = _INJECTED_REACH
  wrong_pos = jax.random.uniform(wrong_pos_key, (3,), minval=-reach, maxval=reach)
  return pos * (1 - wrong) + wrong_pos * wrong, quat * (1 - wrong) + uniform_quat(wrong_quat_key) * wrong
