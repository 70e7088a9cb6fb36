"""Observation terms of robots in general and of robots on legs.

Sensors, site poses and actuator forces are one physics step older than `qpos` and `qvel`, as MuJoCo leaves them. The
first line of a docstring goes into `policy.yaml`: it gives frame, unit and [length].
"""

import jax
import jax.numpy as jnp

from playground.mdp.context import StepContext
from playground.mdp.legged import LeggedContext
from playground.mdp.options import mirrors_as


@mirrors_as("axial")
def gyro(c: LeggedContext) -> jax.Array:
  """Angular velocity of the base in its own frame, rad/s [3]."""
  return c.sensor("gyro")


@mirrors_as("opposite")
def gyro_yaw(c: LeggedContext) -> jax.Array:
  """Angular velocity of the base about its own z, rad/s [1]."""
  return c.sensor("gyro")[2:]


@mirrors_as("joints")
def target_error(c: StepContext) -> jax.Array:
  """Joint positions relative to their targets, rad [joints]."""
  return c.joint_pos - c.data.ctrl


@mirrors_as("polar")
def linvel(c: LeggedContext) -> jax.Array:
  """Linear velocity of the base in its own frame, m/s [3]."""
  return c.sensor("linvel")


@mirrors_as("polar")
def accelerometer(c: LeggedContext) -> jax.Array:
  """Proper acceleration of the base in its own frame, m/s² [3]."""
  return c.sensor("accelerometer")


@mirrors_as("axial")
def global_angvel(c: LeggedContext) -> jax.Array:
  """Angular velocity of the base in the world frame, rad/s [3]."""
  return c.sensor("global_angvel")


@mirrors_as("polar")
def upvector(c: LeggedContext) -> jax.Array:
  """The base's upward axis in the world frame [3]: unlike `gravity`, it turns with the heading."""
  return c.sensor("upvector")


@mirrors_as("same")
def root_height(c: LeggedContext) -> jax.Array:
  """World z of the root joint, m [1]."""
  return c.data.qpos[2:3]


@mirrors_as("polar")
def root_pos(c: LeggedContext) -> jax.Array:
  """World position of the root joint, m [3]."""
  return c.data.qpos[:3]


@mirrors_as("quaternion")
def root_quat(c: LeggedContext) -> jax.Array:
  """Orientation of the root joint, a quaternion w, x, y, z [4]."""
  return c.data.qpos[3:7]


@mirrors_as("joints")
def actuator_force(c: StepContext) -> jax.Array:
  """Forces of the actuators, N m (N on a tendon) [nu]."""
  return c.data.actuator_force


@mirrors_as("feet")
def last_contact(c: LeggedContext) -> jax.Array:
  """Which feet touched the floor in the step before, 0 or 1 [feet]."""
  return c.carried("last_contact").astype(jnp.float32)


@mirrors_as("feet_polar")
def feet_pos(c: LeggedContext) -> jax.Array:
  """Positions of the feet in the base frame, m [3 * feet]."""
  return c.robot.foot_sensors(c.data, "foot_pos").ravel()


@mirrors_as("feet")
def phase(c: LeggedContext) -> jax.Array:
  """Cosines of the feet's phases in the gait, then their sines [2 * feet]."""
  return jnp.concatenate([jnp.cos(c.phase), jnp.sin(c.phase)])


@mirrors_as("same")
def gait(c: LeggedContext) -> jax.Array:
  """Index of the episode's gait in the modes of the gait command [1]."""
  return c.carried("gait").astype(jnp.float32)[None]


@mirrors_as("same")
def gait_frequency(c: LeggedContext) -> jax.Array:
  """Frequency of the gait's steps, Hz [1]."""
  return c.carried("gait_freq")[None]


@mirrors_as("same")
def foot_height(c: LeggedContext) -> jax.Array:
  """Highest swing of the feet in this episode's gait, m [1]."""
  return c.carried("foot_height")[None]


@mirrors_as("polar")
def push_force(c: LeggedContext) -> jax.Array:
  """Force of a push on the root body, world frame, N [3]."""
  return c.data.xfrc_applied[c.robot.root, :3]


@mirrors_as("same")
def pushed(c: LeggedContext) -> jax.Array:
  """Whether a push is under way, 0 or 1 [1]."""
  return c.carried("pushing").astype(jnp.float32)[None]
