"""A planar one-legged hopper: stand, or hop forward (DM Control Suite)."""

import math
from typing import Any

import jax
import jax.numpy as jnp

from playground.envs.dm_control.suite import SuiteTask, Terms, load_spec, move_speed, small_control
from playground.envs.physics import PhysicsData
from playground.mdp.tolerance import tolerance

_STAND_HEIGHT = 0.6  # m, of the torso above the foot
_MAX_HEIGHT = 2.0  # m: out of the leg's reach, so there is no upper bound in effect


class Hopper(SuiteTask):
  """Stands up on one leg (`move_speed: 0`) or hops forward; motors at waist, hip, knee, ankle, actions in [-1, 1].

  Observation [15]: positions without x (z m, pitch and joints rad), velocities m/s and rad/s, log(1 + N) of the forces
  on toe and heel. The reward is standing (0 or 1) times hopping (forward speed) or small_control. An episode starts in
  any pose at any pitch, which may reach into the floor, as in the original suite.
  """

  derived = ("sensordata", "xipos")

  def __init__(self, config: Any):
    """Loads the model. `config`: see `configs/env/_hopper.yaml`."""
    super().__init__(config, load_spec("hopper").compile())
    self._move_speed = move_speed(config)
    self._torso, self._foot = (self.mj_model.body(name).id for name in ("torso", "foot"))

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    return {"state": {"position": 6, "velocity": 7, "touch": 2}}

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    _, pitch_key, joints_key = jax.random.split(rng, 3)
    return {"qpos": self.planar_pose(pitch_key, joints_key)}

  def observe(self, data: PhysicsData) -> jax.Array:
    touch = [jnp.log1p(self.sensor(data, name)) for name in ("touch_toe", "touch_heel")]
    return jnp.concatenate([data.qpos[1:], data.qvel, *touch])

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    height = data.xipos[self._torso, 2] - data.xipos[self._foot, 2]  # between centres of mass
    standing = tolerance(height, (_STAND_HEIGHT, _MAX_HEIGHT))
    if self._move_speed == 0:
      control = small_control(action)
      return standing * control, {"standing": standing, "small_control": control}
    speed = self.sensor(data, "torso_subtreelinvel")[0]
    goal = (self._move_speed, math.inf)
    hopping = tolerance(speed, goal, margin=self._move_speed / 2, sigmoid="linear", value_at_margin=0.5)
    return standing * hopping, {"standing": standing, "hopping": hopping}
