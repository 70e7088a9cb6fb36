"""Parts that observations are concatenated from. A new one is a function here and its name in `env.obs`.

Sensors, site poses and actuator forces are one physics step older than `qpos` and `qvel`, as MuJoCo leaves them.
Noise (`env.noise.scales`) is drawn in the order of `OBSERVATIONS`.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from playground.mdp.legged import Context


def gyro(c: Context) -> jax.Array:
  """Angular velocity of the base in its own frame, rad/s [3]."""
  return c.sensor("gyro")


def gyro_yaw(c: Context) -> jax.Array:
  """Angular velocity of the base about its own z, rad/s [1]."""
  return c.sensor("gyro")[2:]


def gravity(c: Context) -> jax.Array:
  """Direction of gravity in the base frame [3]."""
  return c.gravity


def joint_pos(c: Context) -> jax.Array:
  """Joint positions relative to the default pose, rad [nu]."""
  return c.pose_error


def joint_angle(c: Context) -> jax.Array:
  """Joint positions as they are, rad [nu]."""
  return c.joint_pos


def target_error(c: Context) -> jax.Array:
  """Joint positions relative to their targets, rad [nu]."""
  return c.joint_pos - c.data.ctrl


def joint_vel(c: Context) -> jax.Array:
  """Joint velocities, rad/s [nu]."""
  return c.joint_vel


def linvel(c: Context) -> jax.Array:
  """Linear velocity of the base in its own frame, m/s [3]."""
  return c.sensor("linvel")


def last_act(c: Context) -> jax.Array:
  """The action before the one just applied [nu]."""
  return c.kept("last_act")


def command(c: Context) -> jax.Array:
  """Velocity asked for: forward m/s, left m/s, turn rad/s [3]."""
  return c.command


def accelerometer(c: Context) -> jax.Array:
  """Proper acceleration of the base in its own frame, m/s² [3]."""
  return c.sensor("accelerometer")


def global_angvel(c: Context) -> jax.Array:
  """Angular velocity of the base in the world frame, rad/s [3]."""
  return c.sensor("global_angvel")


def upvector(c: Context) -> jax.Array:
  """The base's upward axis in the world frame [3]: unlike `gravity`, it turns with the heading."""
  return c.sensor("upvector")


def base_height(c: Context) -> jax.Array:
  """World z of the base site, m [1]."""
  return c.base_height[None]


def root_height(c: Context) -> jax.Array:
  """World z of the root joint, m [1]."""
  return c.data.qpos[2:3]


def root_pos(c: Context) -> jax.Array:
  """World position of the root joint, m [3]."""
  return c.data.qpos[:3]


def root_quat(c: Context) -> jax.Array:
  """Orientation of the root joint, a quaternion w, x, y, z [4]."""
  return c.data.qpos[3:7]


def actuator_force(c: Context) -> jax.Array:
  """Joint torques, N m [nu]."""
  return c.data.actuator_force


def last_contact(c: Context) -> jax.Array:
  """Which feet touched the floor in the step before, 0 or 1 [feet]."""
  return c.kept("last_contact").astype(jnp.float32)


def contact(c: Context) -> jax.Array:
  """Which feet touch the floor, 0 or 1 [feet]."""
  return c.contact.astype(jnp.float32)


def feet_velocity(c: Context) -> jax.Array:
  """World velocities of the feet, m/s [3 * feet]."""
  return c.feet_velocity.ravel()


def feet_pos(c: Context) -> jax.Array:
  """Positions of the feet in the base frame, m [3 * feet]."""
  return c.robot.feet_pos(c.data).ravel()


def feet_air_time(c: Context) -> jax.Array:
  """How long each foot has been in the air, s [feet]."""
  return c.kept("feet_air_time")


def phase(c: Context) -> jax.Array:
  """Cosines of the feet's phases in the gait, then their sines [2 * feet]."""
  return jnp.concatenate([jnp.cos(c.phase), jnp.sin(c.phase)])


def gait(c: Context) -> jax.Array:
  """Which of `env.gait.modes` the episode is walked in, its index [1]."""
  return c.kept("gait").astype(jnp.float32)[None]


def gait_frequency(c: Context) -> jax.Array:
  """Frequency of the gait's steps, Hz [1]."""
  return c.kept("gait_freq")[None]


def foot_height(c: Context) -> jax.Array:
  """How high the feet should swing in this episode's gait, m [1]."""
  return c.kept("foot_height")[None]


def push_force(c: Context) -> jax.Array:
  """Force of a push on the root body, world frame, N [3]."""
  return c.data.xfrc_applied[c.robot.root, :3]


def pushed(c: Context) -> jax.Array:
  """Whether a push is under way, 0 or 1 [1]."""
  if "push" in c.info:
    return c.info["push"].any().astype(jnp.float32)[None]
  if "pert_interval" in c.info:  # regular kicks; `push_step` is already that of the next step
    step, interval = c.info["push_step"] - 1, c.info["pert_interval"]
    kicking = (step >= interval) & (step % interval < c.info["pert_duration"])
    return kicking.astype(jnp.float32)[None]
  return (c.kept("steps_since_last_pert") >= c.kept("steps_until_next_pert")).astype(jnp.float32)[None]


OBSERVATIONS: dict[str, Callable[[Context], jax.Array]] = {
  f.__name__: f
  for f in (
    gyro, gravity, joint_pos, joint_vel, linvel, last_act, command, accelerometer, global_angvel, upvector,
    joint_angle, base_height, root_height, root_pos, root_quat, actuator_force, last_contact, contact, feet_velocity,
    feet_air_time, phase, push_force, pushed, gyro_yaw, target_error, feet_pos, gait, gait_frequency, foot_height,
  )
}  # fmt: skip
