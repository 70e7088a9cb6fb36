"""A humanoid with 21 motors: stand, walk or run (DM Control Suite)."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from playground.envs.dm_control.suite import SuiteTask, Terms, load_spec, move_speed, small_control
from playground.envs.physics import PhysicsData
from playground.mdp.tolerance import tolerance

_FREE_QPOS = 7  # position and quaternion of the torso come before the joints
_HEAD_HEIGHT = 1.4  # m
_EXTREMITIES = ("left_hand", "left_foot", "right_hand", "right_foot")


class Humanoid(SuiteTask):
  """Stands (`move_speed: 0`), walks or runs in any direction; 21 motors, actions in [-1, 1].

  Observation [67]: joint angles rad, height of the head m, hands and feet in the torso's frame m, the vertical in the
  torso's frame, velocity of the centre of mass m/s, velocities m/s and rad/s. The reward is stand (standing times
  upright) times small_control times move, which asks for a speed or, if that is 0, for no speed.

  Every episode starts from the model's pose, upright with the feet 0.2 m above the floor, as in Playground 0.2.0. The
  original suite draws poses, any way up, until nothing touches: a search without bound, and episodes that begin with a
  fall, which the paper's settings and returns are not for.
  """

  derived = ("sensordata", "xpos", "xmat")

  def __init__(self, config: Any):
    """Loads the model. `config`: see `configs/env/_humanoid.yaml`."""
    super().__init__(config, load_spec("humanoid").compile())
    self._move_speed = move_speed(config)
    self._torso, self._head = (self.mj_model.body(name).id for name in ("torso", "head"))
    self._extremities = np.array([self.mj_model.body(name).id for name in _EXTREMITIES])

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    return {
      "state": {
        "joint_angles": 21,
        "head_height": 1,
        "extremities": 12,
        "torso_vertical": 3,
        "com_velocity": 3,
        "velocity": 27,
      }
    }

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    return {}

  def observe(self, data: PhysicsData) -> jax.Array:
    torso = data.xmat[self._torso]
    extremities = (data.xpos[self._extremities] - data.xpos[self._torso]) @ torso
    return jnp.concatenate(
      [
        data.qpos[_FREE_QPOS:],
        data.xpos[self._head, 2:],
        extremities.ravel(),
        torso[2],
        self.sensor(data, "torso_subtreelinvel"),
        data.qvel,
      ]
    )

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    head, uprightness = data.xpos[self._head, 2], data.xmat[self._torso, 2, 2]
    standing = tolerance(head, (_HEAD_HEIGHT, math.inf), margin=_HEAD_HEIGHT / 4)
    upright = tolerance(uprightness, (0.9, math.inf), margin=1.9, sigmoid="linear", value_at_margin=0)
    terms = {
      "standing": standing,
      "upright": upright,
      "stand": standing * upright,
      "small_control": small_control(action),
      "move": self._move(self.sensor(data, "torso_subtreelinvel")[:2]),
    }
    return terms["stand"] * terms["small_control"] * terms["move"], terms

  def _move(self, velocity: jax.Array) -> jax.Array:
    """How well the centre of mass keeps still, or reaches the speed; `velocity` is horizontal, m/s."""
    if self._move_speed == 0:
      return tolerance(velocity, margin=2).mean()
    goal = (self._move_speed, math.inf)
    speed = jnp.linalg.norm(velocity)
    return (5 * tolerance(speed, goal, margin=self._move_speed, sigmoid="linear", value_at_margin=0) + 1) / 6
