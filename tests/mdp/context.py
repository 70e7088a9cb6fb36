"""A moment of a made-up robot, for terms computed by hand."""

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from ml_collections import ConfigDict

from playground.errors import lookup
from playground.mdp.legged import LeggedContext

SENSORS = {
  "linvel": jnp.array([0.5, 0.1, 0.0]),
  "gyro": jnp.array([0.0, 0.0, 0.3]),
  "global_linvel": jnp.array([0.3, -0.4, 0.2]),
  "global_angvel": jnp.array([0.3, -0.4, 5.0]),
  "upvector": jnp.array([0.1, -0.2, 0.9]),
  "torso_linvel": jnp.array([0.0, 0.0, 0.1]),
  "torso_angvel": jnp.array([0.1, 0.2, 9.0]),
}
UPRIGHT = SENSORS | {"upvector": jnp.array([0.0, 0.06, 0.998])}
JOINTS = {".*": [0, 1], "hips": [0, 1], "hip_rolls": [1], "knees": [1]}
FEET = ("left", "right")
FOOT_SENSORS = {
  "foot_force": jnp.array([[900.0, 0, -130.0], [0, 0, 80.0]]),
  "foot_linvel": jnp.array([[0.3, 0.4, 9.0], [0.0, 0.04, 9.0]]),
}


def context(
  command: tuple[float, float, float] = (1.0, 0.1, 0.3),
  sensors: Any = SENSORS,
  contact: tuple[bool, bool] = (True, False),
  terminated: bool = True,
  data: Any = None,
  **info: Any,
) -> LeggedContext:
  """Two joints at 0.2 and -0.99 (range: -1 to 1 and -1 to -0.5; default: 0 and -0.75) and two feet.

  Args:
    command: of the velocity.
    sensors: readings by name.
    contact: which feet touch the floor.
    terminated: whether the episode ends in this step.
    data: fields of the physics instead of those here.
    info: entries of `info` instead of those here.
  """
  robot = SimpleNamespace(
    qpos=slice(7, None),
    qvel=slice(6, None),
    find_joints=lambda group: np.array(JOINTS[group]),
    find_feet=lambda feet: np.array([FEET.index(foot) for foot in feet]),
    foot_sensors=lambda data, key: FOOT_SENSORS[key],
    touching=lambda data, group: jnp.array([False, True]),
    contact=lambda data: jnp.array(contact),
    default_pose=jnp.array([0.0, -0.75]),
    joint_range=jnp.array([[-1.0, -1.0], [1.0, -0.5]]),
    target_range=jnp.array([[-1.0, -0.9], [0.1, -0.5]]),
    pose_weights=jnp.array([1.0, 0.5]),
    gait=lambda name, key: lookup({"bound": [0.0, 0.0], "trot": [0.0, 1.0], "walk": [1.0, 0.0]}, name, key),
    root=1,
    base_site=0,
    feet=np.array([1, 2]),
    sensor=lambda data, key: sensors[key],
  )
  physics = {
    "qpos": jnp.array([0, 0, 0.2, 1, 0, 0, 0, 0.2, -0.99]),
    "qvel": jnp.array([0.1, 0.2, 9, 9, 9, 0.3, 2.0, -1.0]),
    "qacc": jnp.array([9, 9, 9, 9, 9, 9, 3.0, -2.0]),
    "ctrl": jnp.array([0.1, 0.2]),
    "actuator_force": jnp.array([3.0, -4.0]),
    "qfrc_actuator": jnp.array([9, 9, 9, 9, 9, 9, 3.0, -4.0]),
    "site_xpos": jnp.array([[0, 0, 0.3], [0.5, 0.1, 0.15], [0, -0.05, 0.02]]),
    "site_xmat": jnp.array([[[0.6, 0, 0.8], [0, 1, 0], [-0.8, 0, 0.6]]]),
  }
  carried = {
    "command": jnp.array(command),
    "last_act": jnp.array([0.5, 0.0]),
    "last_last_act": jnp.array([0.4, 0.2]),
    "feet_air_time": jnp.array([0.28, 0.04]),
    "swing_peak": jnp.array([0.12, 0.2]),
    "last_contact": jnp.array([False, False]),
    "phase": jnp.array([0.0, -jnp.pi / 2]),
    "gait": jnp.array(1),
    "command_steps_left": jnp.array(3),
  }
  env: Any = SimpleNamespace(
    robot=robot,
    mj_model=SimpleNamespace(njnt=3, jnt_type=[mujoco.mjtJoint.mjJNT_FREE]),
    dt=0.02,
    terminations=SimpleNamespace(any=lambda c: jnp.array(terminated)),
    config=ConfigDict({"commands": {"gait": {"params": {"modes": ["bound", "trot"]}}}}),
  )
  fields: Any = SimpleNamespace(**(physics | (data or {})))
  return LeggedContext(env, fields, carried | info, jnp.array([0.1, -0.3]))
