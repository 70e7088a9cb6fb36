"""A moment of a made-up robot, for terms computed by hand."""

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
from ml_collections import ConfigDict

from playground.mdp.legged import Context
from playground.mdp.rewards import REWARDS, bind

SENSORS = {
  "linvel": jnp.array([0.5, 0.1, 0.0]),
  "gyro": jnp.array([0.0, 0.0, 0.3]),
  "global_linvel": jnp.array([0.0, 0.0, 0.2]),
  "global_angvel": jnp.array([0.3, -0.4, 5.0]),
  "upvector": jnp.array([0.1, -0.2, 0.9]),
  "torso_linvel": jnp.array([0.0, 0.0, 0.1]),
  "torso_angvel": jnp.array([0.1, 0.2, 9.0]),
}
UPRIGHT = {"upvector": jnp.array([0.0, 0.06, 0.998])}
PARAMETERS = {
  "tracking_sigma": 0.25,
  "soft_limit_factor": 0.9,
  "max_foot_height": 0.1,
  "min_air_time": 0.1,
  "max_air_time": 0.25,
  "feet_phase_sigma": 0.01,
  "min_feet_distance": 0.2,
  "max_contact_force": 100.0,
  "base_height_target": 0.5,
  "upvector_target": [0.1, 0.0, 1.0],
  "max_joint_vel": 1.5,
  "target_height": 0.4,
  "height_of": "base_site",
  "height_tolerance": 0.11,
  "upright_tolerance": 0.01,
  "forward": [0.0, 0.0, -1.0],
  "pose_sharpness": 2.0,
  "level_gaits": ["trot"],
}
FACTS = {"lifted_feet": np.array([1]), "pose_weights": (1.0, 0.5), "gait_modes": ("bound", "trot")}
JOINTS = {"hips": np.array([0, 1]), "hip_rolls": np.array([1]), "knees": np.array([1])}


def context(command: tuple[float, float, float] = (1.0, 0.1, 0.3), sensors: Any = SENSORS, **changes: Any) -> Context:
  """Two joints at 0.2 and -0.99 (range: -1 to 1 and -1 to -0.5; default: 0 and -0.75) and two feet."""
  robot = SimpleNamespace(
    joints=lambda group: JOINTS[group],
    torque_limits=jnp.array([6.0, 8.0]),
    feet_force=lambda data: jnp.array([[900.0, 0, -130.0], [0, 0, 80.0]]),
    touching=lambda data, group: jnp.array([False, True]),
    default_pose=jnp.array([0.0, -0.75]),
    joint_range=jnp.array([[-1.0, -1.0], [1.0, -0.5]]),
    base_site=0,
    feet=np.array([1, 2]),
    sensor=lambda data, key: sensors[key],
    feet_velocity=lambda data: jnp.array([[0.3, 0.4, 9.0], [0.0, 0.04, 9.0]]),
  )
  data = SimpleNamespace(
    qpos=jnp.array([0, 0, 0.2, 1, 0, 0, 0, 0.2, -0.99]),
    qvel=jnp.array([0.1, 0.2, 9, 9, 9, 0.3, 2.0, -1.0]),
    qacc=jnp.array([9, 9, 9, 9, 9, 9, 3.0, -2.0]),
    actuator_force=jnp.array([3.0, -4.0]),
    site_xpos=jnp.array([[0, 0, 0.3], [0.5, 0.1, 0.15], [0, -0.05, 0.02]]),
    site_xmat=jnp.array([[[0.6, 0, 0.8], [0, 1, 0], [-0.8, 0, 0.6]]]),
  )
  info = {
    "command": jnp.array(command),
    "last_act": jnp.array([0.5, 0.0]),
    "last_last_act": jnp.array([0.4, 0.2]),
    "feet_air_time": jnp.array([0.3, 0.06]),
    "swing_peak": jnp.array([0.12, 0.2]),
    "phase": jnp.array([0.0, -jnp.pi / 2]),
    "gait": jnp.array(1),
    "step": jnp.array(499),
  }
  fields = {
    "robot": robot,
    "data": data,
    "info": info,
    "action": jnp.array([0.1, -0.3]),
    "contact": jnp.array([True, False]),
    "first_contact": jnp.array([True, False]),
    "done": jnp.array(True),
  }
  return Context(**(fields | changes))


def evaluate(name: str, c: Context, **parameters: Any) -> float:
  """The value of a reward term."""
  config = ConfigDict({"scales": {name: 1.0}, **PARAMETERS, **parameters})
  weight, term = bind(config, REWARDS, facts=FACTS)[name]
  assert weight == 1.0
  return float(term(c))
