"""States to look at rewards and observations by hand, with nothing compiled: C MuJoCo computes the derived fields."""

from typing import Any

import jax.numpy as jnp
import mujoco

from playground.envs.dm_control.suite import SuiteTask
from playground.physics.backend import PhysicsData


def state_at(env: SuiteTask, **fields: Any) -> PhysicsData:
  """What a task sees where `fields` (qpos, qvel, mocap_pos, ctrl) are these and all else is the model's default."""
  data = mujoco.MjData(env.mj_model)
  for name, value in fields.items():
    getattr(data, name)[:] = value
  mujoco.mj_forward(env.mj_model, data)
  matrices = ("xmat", "site_xmat", "geom_xmat")  # flat rows in C
  derived = {name: jnp.array(getattr(data, name), jnp.float32) for name in env.derived}
  shaped = {name: value.reshape(-1, 3, 3) if name in matrices else value for name, value in derived.items()}
  state = {name: jnp.array(getattr(data, name), jnp.float32) for name in fields}
  return env.physics.make(**state).replace(**shaped)
