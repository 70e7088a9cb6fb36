"""A planar one-legged hopper: stand, or hop forward (DM Control Suite)."""

import jax
import jax.numpy as jnp

from playground.envs.dm_control.suite import SuiteTask, Terms, reach_speed, small_control
from playground.mdp.tolerance import tolerance
from playground.physics.backend import PhysicsData

_STAND_HEIGHT = 0.6  # m, of the torso above the foot
_MAX_HEIGHT = 2.0  # m: out of the leg's reach, so there is no upper bound in effect


class Hopper(SuiteTask):
  """Stands up on one leg (`move_speed: 0`) or hops forward; motors at waist, hip, knee, ankle, actions in [-1, 1].

  Observation [15]: positions without x (z m, pitch and joints rad), velocities m/s and rad/s, log(1 + N) of the forces
  on toe and heel. The reward is standing (0 or 1) times hopping (forward speed) or small_control. An episode starts in
  any pose at any pitch, which may reach into the floor, as in the original suite.
  """

  domain = "hopper"
  derived = ("sensordata", "xipos")

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    return {"qpos": self.draw_planar_pose(*jax.random.split(rng, 3)[1:])}

  def parts(self, data: PhysicsData) -> dict[str, jax.Array]:
    touch = jnp.concatenate([self.sensor(data, name) for name in ("touch_toe", "touch_heel")])
    return {"position": data.qpos[1:], "velocity": data.qvel, "touch": jnp.log1p(touch)}

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    goal = self.config.move_speed
    height = data.xipos[self.body["torso"], 2] - data.xipos[self.body["foot"], 2]  # between centres of mass
    standing = tolerance(height, (_STAND_HEIGHT, _MAX_HEIGHT))
    if goal == 0:
      control = small_control(action)
      return standing * control, {"standing": standing, "small_control": control}
    hopping = reach_speed(self.sensor(data, "torso_subtreelinvel")[0], goal, margin=goal / 2, value_at_margin=0.5)
    return standing * hopping, {"standing": standing, "hopping": hopping}
