"""Any task on C MuJoCo."""

from playground.envs.base import Env
from playground.physics.c_mujoco import CPhysics


def on_c_physics(env: Env) -> Env:
  """Makes C MuJoCo simulate a task; call it before the task is first used.

  MuJoCo-Warp still renders the images of `env.vision`, from the states of C MuJoCo.
  """
  task = env.unwrapped
  task.physics = CPhysics(task.physics)
  task.as_configured = False
  return env
