"""Event terms: all that acts on a simulation from outside.

- mode `startup`, func `model_field`: a field of the model, drawn once an environment (`playground.randomization`); in
  mode `reset` it is drawn in each episode.
- mode `reset`: a function `(key, env, initial, **params) -> initial` changes the state that an episode starts with.
- mode `interval`: a class whose fields are the term's `params`. `bind(env)` looks names up once; `reset(key, model)`
  returns the entries of `info` that an episode starts with, `step(data, info)` acts before the physics of a step.
"""

import dataclasses
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from mujoco.mjx._src.math import axis_angle_to_quat, quat_mul

from playground.envs.physics import PhysicsData, mjx
from playground.limits import AtLeast0, Share, Span, Vector
from playground.mdp.rotations import uniform_quat

if TYPE_CHECKING:
  from playground.envs.task import InitialState, Task

Info = dict[str, Any]


def reset_root_xy(key: jax.Array, env: "Task", initial: "InitialState", distance: AtLeast0) -> "InitialState":
  """Moves the root by U[-distance, distance) along x and y, m."""
  del env
  shift = jax.random.uniform(key, (2,), minval=-distance, maxval=distance)
  return initial.replace(qpos=initial.qpos.at[:2].add(shift))


def reset_root_yaw(key: jax.Array, env: "Task", initial: "InitialState", angle: AtLeast0) -> "InitialState":
  """Turns the root about the vertical by U[-angle, angle), rad."""
  del env
  yaw = jax.random.uniform(key, minval=-angle, maxval=angle)
  turn = axis_angle_to_quat(jnp.array([0.0, 0.0, 1.0]), yaw)
  return initial.replace(qpos=initial.qpos.at[3:7].set(quat_mul(turn, initial.qpos[3:7])))


def reset_root_velocity(key: jax.Array, env: "Task", initial: "InitialState", speed: AtLeast0) -> "InitialState":
  """Draws the root's velocity: six numbers U[-speed, speed), m/s and rad/s."""
  del env
  velocity = jax.random.uniform(key, (6,), minval=-speed, maxval=speed)
  return initial.replace(qvel=initial.qvel.at[:6].set(velocity))


def reset_joints_by_scale(key: jax.Array, env: "Task", initial: "InitialState", scale: Span) -> "InitialState":
  """Multiplies each joint's angle by a factor U[scale[0], scale[1]), within the joint's range."""
  low, high = scale
  joints = initial.qpos[env.robot.qpos]
  factors = jax.random.uniform(key, joints.shape, minval=low, maxval=high)
  return initial.replace(qpos=initial.qpos.at[env.robot.qpos].set(jnp.clip(joints * factors, *env.robot.joint_range)))


def reset_joints_gaussian(key: jax.Array, env: "Task", initial: "InitialState", std: AtLeast0) -> "InitialState":
  """Adds N(0, std²) rad to each joint's angle, within the joint's range."""
  joints = initial.qpos[env.robot.qpos]
  joints = jnp.clip(joints + std * jax.random.normal(key, joints.shape), *env.robot.joint_range)
  return initial.replace(qpos=initial.qpos.at[env.robot.qpos].set(joints))


def reset_cube_pose(
  key: jax.Array, env: "Task", initial: "InitialState", pos: Vector, spread: AtLeast0
) -> "InitialState":
  """Puts the cube of a hand at `pos` + U[-spread, spread) on each axis, m, in any orientation."""
  pos_key, quat_key = jax.random.split(key)
  place = jnp.array(pos) + jax.random.uniform(pos_key, (3,), minval=-spread, maxval=spread)
  pose = jnp.concatenate([place, uniform_quat(quat_key)])
  return initial.replace(qpos=initial.qpos.at[env.robot.cube_qpos].set(pose))


def reset_fallen(
  key: jax.Array, env: "Task", initial: "InitialState", probability: Share, height: AtLeast0
) -> "InitialState":
  """Drops the robot, with this probability: from a height (m), turned anyhow, joint angles uniform in their ranges."""
  drop_key, turn_key, joints_key = jax.random.split(key, 3)
  quat = jax.random.normal(turn_key, (4,))
  quat = quat / (jnp.linalg.norm(quat) + 1e-6)
  lower, upper = env.robot.joint_range
  joints = jax.random.uniform(joints_key, lower.shape, minval=lower, maxval=upper)
  fallen = jnp.concatenate([jnp.array([0.0, 0.0, height]), quat, joints])
  return initial.replace(qpos=jnp.where(jax.random.bernoulli(drop_key, probability), fallen, initial.qpos))


def reset_to_keyframe(
  key: jax.Array, env: "Task", initial: "InitialState", probability: Share, keyframe: str
) -> "InitialState":
  """Starts in another keyframe of the robot, at rest, with this probability; the root stays where it is, x and y."""
  chosen = jax.random.bernoulli(key, probability)
  pose = env.robot.keyframe(keyframe).at[:2].set(initial.qpos[:2])
  qvel = jnp.where(chosen, 0.0, initial.qvel)
  return initial.replace(qpos=jnp.where(chosen, pose, initial.qpos), qvel=qvel)


@dataclasses.dataclass(frozen=True)
class PushByForce:
  """Pushes the root body with a force, a half sine in time, from time to time; strengths and times are an episode's.

  Writes `pushing` (whether a push is under way in this step), `push_force` and the counters `push_wait`, `push_time`.

  Attributes:
    velocity: range of the strength, m/s: the force's peak is 0.5 * mass * velocity / duration, so that the body gains
      velocity / pi (Playground 0.2.0, with which this range goes).
    duration_s: range, s.
    interval_s: range of the time between two pushes, s.
  """

  velocity: Span
  duration_s: Span
  interval_s: Span

  def bind(self, env: Any) -> None:
    object.__setattr__(self, "_env", env)

  def reset(self, key: jax.Array, model: mjx.Model) -> Info:
    env: Any = self._env  # pyright: ignore[reportAttributeAccessIssue]
    interval, duration, velocity = (
      jax.random.uniform(k, minval=low, maxval=high)
      for k, (low, high) in zip(
        jax.random.split(key, 3), (self.interval_s, self.duration_s, self.velocity), strict=True
      )
    )
    return {
      "push_interval": jnp.round(interval / env.dt).astype(jnp.int32),
      "push_duration": duration,
      "push_velocity": velocity,
      "push_mass": env.robot.mass(model),
      "push_direction": jnp.zeros(3),
      "push_wait": jnp.zeros((), jnp.int32),
      "push_time": jnp.zeros((), jnp.int32),
      "pushing": jnp.zeros((), bool),
    }

  def step(self, data: PhysicsData, info: Info) -> tuple[PhysicsData, Info]:
    env: Any = self._env  # pyright: ignore[reportAttributeAccessIssue]
    pushing = info["push_wait"] >= info["push_interval"]
    force = push_force(info["push_time"] * env.dt, info["push_mass"], info["push_velocity"], info["push_duration"])
    force = jnp.where(pushing, force * info["push_direction"], 0.0)
    over = pushing & (info["push_time"] >= jnp.round(info["push_duration"] / env.dt))
    rng, key = jax.random.split(info["rng"])
    waited = jnp.where(pushing, info["push_wait"], info["push_wait"] + 1)
    starting = ~pushing & (waited >= info["push_interval"])
    data = data.replace(xfrc_applied=data.xfrc_applied.at[env.robot.root, :3].set(force))
    return data, {
      "rng": jnp.where(pushing, info["rng"], rng),
      "push_direction": jnp.where(starting, horizontal(key), info["push_direction"]),
      "push_wait": jnp.where(over, 0, waited),
      "push_time": jnp.where(starting, 0, info["push_time"] + pushing),
      "pushing": pushing,
    }


@dataclasses.dataclass(frozen=True)
class PushByForceRegularly:
  """As `PushByForce`, but the interval runs from the start of one push to that of the next, in whole steps.

  (Playground 0.2.0, Barkour.)

  Attributes:
    velocity: see `PushByForce`.
    duration_s: range, s.
    interval_s: range, s.
  """

  velocity: Span
  duration_s: Span
  interval_s: Span

  def bind(self, env: Any) -> None:
    object.__setattr__(self, "_env", env)
    object.__setattr__(self, "_body", env.robot.root)

  def direction(self, key: jax.Array) -> jax.Array:
    """Draws the direction of a push: horizontal, world frame [3]."""
    return horizontal(key)

  def strength(self, key: jax.Array) -> jax.Array:
    """Draws the strength of an episode's pushes, m/s."""
    low, high = self.velocity
    return jax.random.uniform(key, minval=low, maxval=high)

  def mass(self, model: mjx.Model) -> jax.Array:
    """The mass that is pushed, kg."""
    return self._env.robot.mass(model)  # pyright: ignore[reportAttributeAccessIssue]

  def reset(self, key: jax.Array, model: mjx.Model) -> Info:
    dt: float = self._env.dt  # pyright: ignore[reportAttributeAccessIssue]
    interval_key, duration_key, strength_key = jax.random.split(key, 3)
    steps = lambda k, reach: jax.random.randint(k, (), *(round(time / dt) for time in reach))
    return {
      "push_interval": steps(interval_key, self.interval_s),
      "push_duration": steps(duration_key, self.duration_s),
      "push_velocity": self.strength(strength_key),
      "push_mass": self.mass(model),
      "push_direction": jnp.zeros_like(self.direction(key)),
      "push_step": jnp.zeros((), jnp.int32),
      "pushing": jnp.zeros((), bool),
    }

  def step(self, data: PhysicsData, info: Info) -> tuple[PhysicsData, Info]:
    dt: float = self._env.dt  # pyright: ignore[reportAttributeAccessIssue]
    body: int = self._body  # pyright: ignore[reportAttributeAccessIssue]
    since = info["push_step"] % info["push_interval"]
    begun = info["push_step"] >= info["push_interval"]
    starting = (since == 0) & (info["push_step"] > 0)
    rng, key = jax.random.split(info["rng"])
    direction = jnp.where(starting, self.direction(key), info["push_direction"])
    pushing = since < info["push_duration"]
    force = push_force(since * dt, info["push_mass"], info["push_velocity"], info["push_duration"] * dt)
    force = jnp.where(pushing, force, 0.0) * direction
    data = data.replace(xfrc_applied=data.xfrc_applied.at[body, : force.size].set(force))
    return data, {
      "rng": jnp.where(starting, rng, info["rng"]),
      "push_step": info["push_step"] + 1,
      "push_direction": direction,
      "pushing": pushing & begun,
    }


@dataclasses.dataclass(frozen=True)
class PushObjectByWrench(PushByForceRegularly):
  """Forces and torques on the object of the task, in any direction, at regular times. (Playground 0.2.0, LEAP hand.)

  Attributes:
    angular_velocity: range of the torques' strength, rad/s (a torque is that of a body of 1 m radius of gyration).
  """

  angular_velocity: Span = (0.0, 0.0)

  def bind(self, env: Any) -> None:
    object.__setattr__(self, "_env", env)
    object.__setattr__(self, "_body", env.robot.cube)

  def direction(self, key: jax.Array) -> jax.Array:
    """Draws a unit vector of force and torque together, world frame [6]."""
    vector = jax.random.normal(key, (6,))
    return vector / jnp.linalg.norm(vector)

  def strength(self, key: jax.Array) -> jax.Array:
    """Draws the strengths of force and torque of an episode's pushes, m/s and rad/s [6]."""
    low, high = self.angular_velocity
    turn = jax.random.uniform(jax.random.fold_in(key, 1), minval=low, maxval=high)
    return jnp.repeat(jnp.array([super().strength(key), turn]), 3)

  def mass(self, model: mjx.Model) -> jax.Array:
    """Mass of the object, kg."""
    return self._env.robot.cube_mass(model)  # pyright: ignore[reportAttributeAccessIssue]


@dataclasses.dataclass(frozen=True)
class PushBySettingVelocity:
  """Adds to the root's horizontal velocity, at one interval in an episode, each time in another direction.

  Writes `push_step`, `push_interval_steps`, `push` (the direction of a push in this step, else 0) and `pushing`.

  Attributes:
    velocity: range of the change, m/s.
    interval_s: range of the time between two pushes, s.
  """

  velocity: Span
  interval_s: Span

  def bind(self, env: Any) -> None:
    object.__setattr__(self, "_dt", env.dt)

  def reset(self, key: jax.Array, model: mjx.Model) -> Info:
    del model
    low, high = self.interval_s
    interval = jax.random.uniform(key, minval=low, maxval=high)
    return {
      "push": jnp.zeros(2),
      "push_step": jnp.zeros((), jnp.int32),
      "push_interval_steps": jnp.round(interval / self._dt).astype(jnp.int32),  # pyright: ignore[reportAttributeAccessIssue]
      "pushing": jnp.zeros((), bool),
    }

  def step(self, data: PhysicsData, info: Info) -> tuple[PhysicsData, Info]:
    rng, angle_key, size_key = jax.random.split(info["rng"], 3)
    low, high = self.velocity
    size = jax.random.uniform(size_key, minval=low, maxval=high)
    step = info["push_step"] + 1
    due = step % info["push_interval_steps"] == 0
    push = horizontal(angle_key)[:2] * due
    data = data.replace(qvel=data.qvel.at[:2].add(push * size))
    return data, {"rng": rng, "push": push, "push_step": step, "pushing": due}


def push_force(time: jax.Array, mass: jax.Array, velocity: jax.Array, duration: jax.Array) -> jax.Array:
  """Returns a push's force at `time` s after it began, N: 0.5 * mass * velocity / duration * sin(pi * time / duration).

  A half sine. Its area over `duration` is mass * velocity / pi: the body gains velocity / pi, not `velocity`.
  (Playground 0.2.0; kept, since its range of velocities goes with it.)
  """
  return 0.5 * jnp.sin(jnp.pi * time / duration) * mass * velocity / duration


def horizontal(key: jax.Array) -> jax.Array:
  """Draws a horizontal unit vector, shape [3]."""
  angle = jax.random.uniform(key, maxval=2 * jnp.pi)
  return jnp.array([jnp.cos(angle), jnp.sin(angle), 0.0])
