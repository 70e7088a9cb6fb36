"""A humanoid with 21 motors: stand, walk or run (DM Control Suite)."""

import math

import jax
import jax.numpy as jnp

from playground.envs.dm_control.suite import SuiteTask, Terms, reach_speed, small_control
from playground.mdp.tolerance import tolerance
from playground.physics.backend import PhysicsData

_FREE_QPOS = 7  # position and quaternion of the torso come before the joints
_HEAD_HEIGHT = 1.4  # m
_EXTREMITIES = ("left_hand", "left_foot", "right_hand", "right_foot")


class Humanoid(SuiteTask):
  """Stands (`move_speed: 0`), walks or runs in any direction; 21 motors, actions in [-1, 1].

  Observation [67]: joint angles rad, height of the head m, hands and feet in the torso's frame m, the vertical in the
  torso's frame, velocity of the centre of mass m/s, velocities m/s and rad/s. The reward is stand (standing times
  upright) times small_control times move, which asks for a speed or, if that is 0, for no speed.

  Every episode starts from the model's pose, upright with the feet 0.2 m above the floor, as in Playground 0.2.0. The
  original suite draws poses, any way up, until nothing touches. This search has no bound, and those episodes begin with
  a fall, but the paper's settings and returns are for upright starts.
  """

  domain = "humanoid"
  derived = ("sensordata", "xpos", "xmat")

  def parts(self, data: PhysicsData) -> dict[str, jax.Array]:
    torso, extremities = self.body["torso"], jnp.array([self.body[name] for name in _EXTREMITIES])
    return {
      "joint_angles": data.qpos[_FREE_QPOS:],
      "head_height": data.xpos[self.body["head"], 2],
      "extremities": (data.xpos[extremities] - data.xpos[torso]) @ data.xmat[torso],
      "torso_vertical": data.xmat[torso, 2],
      "com_velocity": self.sensor(data, "torso_subtreelinvel"),
      "velocity": data.qvel,
    }

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    head, uprightness = data.xpos[self.body["head"], 2], data.xmat[self.body["torso"], 2, 2]
    standing = tolerance(head, (_HEAD_HEIGHT, math.inf), margin=_HEAD_HEIGHT / 4)
    upright = tolerance(uprightness, (0.9, math.inf), margin=1.9, sigmoid="linear", value_at_margin=0)
    goal, velocity = self.config.move_speed, self.sensor(data, "torso_subtreelinvel")[:2]
    if goal == 0:
      move = tolerance(velocity, margin=2).mean()
    else:
      move = (5 * reach_speed(jnp.linalg.norm(velocity), goal, margin=goal, value_at_margin=0) + 1) / 6
    stand, control = standing * upright, small_control(action)
    terms = {"standing": standing, "upright": upright, "stand": stand, "small_control": control, "move": move}
    return stand * control * move, terms
