"""Any task in plain C MuJoCo, as it is."""

from playground.envs.base import Env
from playground.physics.c_mujoco import CPhysics


def on_c_physics(env: Env) -> Env:
  """Has a task simulated by C MuJoCo; call it before the task is first used.

  What a task sees (`env.vision`) is rendered by MuJoCo-Warp all the same, of C MuJoCo's states.
  """
  task = env.unwrapped
  task.physics = CPhysics(task.mj_model, derived=task.derived)
  task.redraws = False  # it simulates the model as it is
  return env
