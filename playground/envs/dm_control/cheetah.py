"""A planar cheetah that runs (DM Control Suite)."""

import jax
import jax.numpy as jnp

from playground.envs.dm_control.suite import SuiteTask, Terms, reach_speed
from playground.physics.backend import PhysicsData, mjx

_ROOT = 3  # x, z and pitch come before the joints
_SPEED = 10.0  # m/s that earn the full reward
_SETTLING_STEPS = 200


class CheetahRun(SuiteTask):
  """Runs forward with six motors (hind thigh, shin and foot, then front; actions in [-1, 1]).

  Observation [17]: positions without x (z m, pitch and joints rad), velocities m/s and rad/s. The reward is the forward
  speed over 10 m/s, in [0, 1]. An episode starts from a random pose that has come to rest on the ground.
  """

  domain = "cheetah"
  derived = ("sensordata",)

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    joints = self.draw_joints(jax.random.split(rng)[1], slice(_ROOT, None))
    return {"qpos": jnp.concatenate([jnp.zeros(_ROOT), joints])}

  def settle(self, data: PhysicsData, model: mjx.Model) -> PhysicsData:
    data = self.physics.step(model, data, data.ctrl, _SETTLING_STEPS)
    return data.replace(time=jnp.zeros_like(data.time))

  def parts(self, data: PhysicsData) -> dict[str, jax.Array]:
    return {"position": data.qpos[1:], "velocity": data.qvel}

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    return reach_speed(self.sensor(data, "torso_subtreelinvel")[0], _SPEED, margin=_SPEED, value_at_margin=0), {}
