"""A planar two-legged walker: stand, walk or run (DM Control Suite)."""

import math

import jax

from playground.envs.dm_control.suite import SuiteTask, Terms, reach_speed
from playground.mdp.tolerance import tolerance
from playground.physics.backend import PhysicsData

_STAND_HEIGHT = 1.2  # m, of the torso


class Walker(SuiteTask):
  """Stands upright (`move_speed: 0`), walks or runs; motors at hip, knee, ankle, right then left, actions in [-1, 1].

  Observation [24]: orientation of the seven bodies (cos and sin of their pitch), height of the torso m, velocities m/s
  and rad/s. The reward is stand (3 parts standing, 1 part upright), with a speed to reach times (5 move + 1) / 6. An
  episode starts in any pose at any pitch, which may reach into the floor, as in the original suite.
  """

  domain = "walker"
  derived = ("sensordata", "xpos", "xmat")

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    return {"qpos": self.draw_planar_pose(*jax.random.split(rng, 3)[1:])}

  def parts(self, data: PhysicsData) -> dict[str, jax.Array]:
    torso = self.body["torso"]
    orientations = data.xmat[torso:, 0, ::2]  # x and z axis of every body along x
    return {"orientations": orientations, "height": data.xpos[torso, 2:], "velocity": data.qvel}

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    torso, goal = self.body["torso"], self.config.move_speed
    standing = tolerance(data.xpos[torso, 2], (_STAND_HEIGHT, math.inf), margin=_STAND_HEIGHT / 2)
    upright = (1 + data.xmat[torso, 2, 2]) / 2
    stand = (3 * standing + upright) / 4
    terms = {"standing": standing, "upright": upright, "stand": stand}
    if goal == 0:
      return stand, terms
    move = reach_speed(self.sensor(data, "torso_subtreelinvel")[0], goal, margin=goal / 2, value_at_margin=0.5)
    return stand * (5 * move + 1) / 6, {**terms, "move": move}
