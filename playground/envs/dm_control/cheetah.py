"""A planar cheetah that runs (DM Control Suite)."""

import math
from typing import Any

import jax
import jax.numpy as jnp

from playground.envs.dm_control.suite import SuiteTask, Terms, load_spec
from playground.envs.physics import PhysicsData, mjx
from playground.mdp.tolerance import tolerance

_ROOT = 3  # x, z and pitch come before the joints
_SPEED = 10.0  # m/s that earn the full reward
_SETTLING_STEPS = 200


class CheetahRun(SuiteTask):
  """Runs forward with six motors (hind thigh, shin and foot, then front; actions in [-1, 1]).

  Observation [17]: positions without x (z m, pitch and joints rad), velocities m/s and rad/s. The reward is the forward
  speed over 10 m/s, in [0, 1]. An episode starts from a random pose that has come to rest on the ground.
  """

  derived = ("sensordata",)

  def __init__(self, config: Any):
    """Loads the model. `config`: see `configs/env/CheetahRun.yaml`."""
    super().__init__(config, load_spec("cheetah").compile())

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    return {"state": {"position": 8, "velocity": 9}}

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    low, high = self.mj_model.jnt_range[_ROOT:].T
    joints = jax.random.uniform(jax.random.split(rng)[1], low.shape, minval=low, maxval=high)
    return {"qpos": jnp.concatenate([jnp.zeros(_ROOT), joints])}

  def settle(self, data: PhysicsData, model: mjx.Model) -> PhysicsData:
    data = self.physics.step(model, data, data.ctrl, _SETTLING_STEPS)
    return data.replace(time=jnp.zeros_like(data.time))

  def observe(self, data: PhysicsData) -> jax.Array:
    return jnp.concatenate([data.qpos[1:], data.qvel])

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    speed = self.sensor(data, "torso_subtreelinvel")[0]
    return tolerance(speed, (_SPEED, math.inf), margin=_SPEED, sigmoid="linear", value_at_margin=0), {}
