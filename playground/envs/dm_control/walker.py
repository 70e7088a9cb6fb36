"""A planar two-legged walker: stand, walk or run (DM Control Suite)."""

import math
from typing import Any

import jax
import jax.numpy as jnp

from playground.envs.dm_control.suite import SuiteTask, Terms, load_spec, move_speed
from playground.envs.physics import PhysicsData
from playground.mdp.tolerance import tolerance

_STAND_HEIGHT = 1.2  # m, of the torso


class Walker(SuiteTask):
  """Stands upright (`move_speed: 0`), walks or runs; motors at hip, knee, ankle, right then left, actions in [-1, 1].

  Observation [24]: orientation of the seven bodies (cos and sin of their pitch), height of the torso m, velocities m/s
  and rad/s. The reward is stand (3 parts standing, 1 part upright), with a speed to reach times (5 move + 1) / 6. An
  episode starts in any pose at any pitch, which may reach into the floor, as in the original suite.
  """

  derived = ("sensordata", "xpos", "xmat")

  def __init__(self, config: Any):
    """Loads the model. `config`: see `configs/env/_walker.yaml`."""
    super().__init__(config, load_spec("walker").compile())
    self._move_speed = move_speed(config)
    self._torso = self.mj_model.body("torso").id

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    return {"state": {"orientations": 14, "height": 1, "velocity": 9}}

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    _, pitch_key, joints_key = jax.random.split(rng, 3)
    return {"qpos": self.planar_pose(pitch_key, joints_key)}

  def observe(self, data: PhysicsData) -> jax.Array:
    orientations = data.xmat[self._torso :, 0, ::2]  # x and z axis of every body along x
    return jnp.concatenate([orientations.ravel(), data.xpos[self._torso, 2:], data.qvel])

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    standing = tolerance(data.xpos[self._torso, 2], (_STAND_HEIGHT, math.inf), margin=_STAND_HEIGHT / 2)
    upright = (1 + data.xmat[self._torso, 2, 2]) / 2
    stand = (3 * standing + upright) / 4
    terms = {"standing": standing, "upright": upright, "stand": stand}
    if self._move_speed == 0:
      return stand, terms
    speed = self.sensor(data, "torso_subtreelinvel")[0]
    goal = (self._move_speed, math.inf)
    move = tolerance(speed, goal, margin=self._move_speed / 2, sigmoid="linear", value_at_margin=0.5)
    return stand * (5 * move + 1) / 6, {**terms, "move": move}
