"""Event terms: changes of a simulation from outside.

- mode `startup`, func `model_field`: a field of the model, drawn once an environment; in mode `reset` in each episode.
- mode `reset`: a function `(key, env, initial, **params) -> initial` changes the state that an episode starts with.
- mode `interval`: a class whose fields are the term's `params`. `bind(env)` looks names up once; `reset(key, model)`
  returns the entries of `info` that an episode starts with, `step(data, info)` acts before the physics of a step. An
  auto-reset keeps these entries, except those that depend on the model: `of_model(model)` computes them for the model
  that the auto-reset draws. In the first step after an auto-reset, derived fields (`sensordata`, `xpos`, ...) still
  have their values of the end of the last episode.
"""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp
from mujoco.mjx._src.math import axis_angle_to_quat, normalize, quat_mul

from playground.errors import ConfigError
from playground.limits import MOST, AtLeast0, Limit, Share, Span, Vector, count, span
from playground.mdp.context import need_free_root
from playground.mdp.poses import horizontal, uniform_quat
from playground.physics.backend import PhysicsData, mjx
from playground.text import format_value

if TYPE_CHECKING:
  from playground.envs.task import InitialState, Task

Info = dict[str, Any]
_Duration = Annotated[Sequence[float], Limit(0, above=True, form="list", length=2, rising=True)]
_MOMENTS = {"normal": ("mean", "std"), "bernoulli": ("mean",)}  # parameters of distributions that have no range


def reset_root_xy(key: jax.Array, env: "Task", initial: "InitialState", distance: AtLeast0) -> "InitialState":
  """Moves the root by U[-distance, distance) along x and y, m.

  The robot starts at the height of the highest ground within 1 m of the origin: on stairs or a slope a larger distance
  may put it into the ground.
  """
  need_free_root(env)
  shift = jax.random.uniform(key, (2,), minval=-distance, maxval=distance)
  return initial.replace(qpos=initial.qpos.at[:2].add(shift))


def reset_root_yaw(key: jax.Array, env: "Task", initial: "InitialState", angle: AtLeast0) -> "InitialState":
  """Turns the root about the vertical by U[-angle, angle), rad."""
  need_free_root(env)
  yaw = jax.random.uniform(key, minval=-angle, maxval=angle)
  turn = axis_angle_to_quat(jnp.array([0.0, 0.0, 1.0]), yaw)
  return initial.replace(qpos=initial.qpos.at[3:7].set(quat_mul(turn, initial.qpos[3:7])))


def reset_root_velocity(key: jax.Array, env: "Task", initial: "InitialState", speed: AtLeast0) -> "InitialState":
  """Draws the root's velocity: six numbers U[-speed, speed), m/s and rad/s."""
  need_free_root(env)
  velocity = jax.random.uniform(key, (6,), minval=-speed, maxval=speed)
  return initial.replace(qvel=initial.qvel.at[:6].set(velocity))


def reset_joints_by_scale(key: jax.Array, env: "Task", initial: "InitialState", scale: Span) -> "InitialState":
  """Multiplies each joint's angle by a factor U[scale[0], scale[1]), within the joint's range."""
  joints = initial.qpos[env.robot.qpos]
  joints = jnp.clip(joints * _uniform(key, scale, joints.shape), *env.robot.joint_range)
  return initial.replace(qpos=initial.qpos.at[env.robot.qpos].set(joints))


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
  """Drops the robot, with this probability: from a height over the ground, m, turned anyhow, at any joint angles."""
  need_free_root(env)
  drop_key, turn_key, joints_key = jax.random.split(key, 3)
  quat = jax.random.normal(turn_key, (4,))
  quat = quat / (jnp.linalg.norm(quat) + 1e-6)
  lower, upper = env.robot.joint_range
  joints = jax.random.uniform(joints_key, lower.shape, minval=lower, maxval=upper)
  fallen = jnp.concatenate([initial.qpos[:2], jnp.array([env.robot.ground_peak + height]), quat, joints])
  return initial.replace(qpos=jnp.where(jax.random.bernoulli(drop_key, probability), fallen, initial.qpos))


def reset_to_keyframe(
  key: jax.Array, env: "Task", initial: "InitialState", probability: Share, keyframe: str
) -> "InitialState":
  """Starts in another keyframe of the robot, at rest, with this probability; the root stays where it is, x and y."""
  chosen = jax.random.bernoulli(key, probability)
  pose = env.robot.keyframe(keyframe).at[:2].set(initial.qpos[:2])
  qvel = jnp.where(chosen, 0.0, initial.qvel)
  return initial.replace(qpos=jnp.where(chosen, pose, initial.qpos), qvel=qvel)


def reset_body_uniform(
  key: jax.Array, env: "Task", initial: "InitialState", body: str, reach: Vector
) -> "InitialState":
  """Moves a free body by U[-reach, reach) along x, y and z, m."""
  place = env.robot.free_joint(body)
  return initial.replace(qpos=initial.qpos.at[place].add(_uniform_vector(key, [-r for r in reach], reach, 3)))


def reset_goal_uniform(
  key: jax.Array,
  env: "Task",
  initial: "InitialState",
  low: Vector,
  high: Vector,
  turn: AtLeast0 = 0.0,
  at_least: Vector | None = None,
) -> "InitialState":
  """Draws the goal's position U[low, high), m, then raised to `at_least`, and turns it by U[0, turn) rad.

  The entries of the turn's axis are uniform, so it points to the corners of a cube more often than to its faces, as in
  Playground 0.2.0, on which the published settings were tuned.
  """
  place_key, axis_key, angle_key = jax.random.split(key, 3)
  goal = _uniform_vector(place_key, low, high, 3)
  goal = goal if at_least is None else jnp.maximum(goal, jnp.array(at_least))
  axis = normalize(jax.random.uniform(axis_key, (3,), minval=-1.0, maxval=1.0))
  quat = axis_angle_to_quat(axis, jax.random.uniform(angle_key, maxval=turn))
  return initial.replace(mocap_pos=goal[None], mocap_quat=quat[None])


def reset_joints_uniform(
  key: jax.Array, env: "Task", initial: "InitialState", low: Sequence[float], high: Sequence[float]
) -> "InitialState":
  """Adds U[low, high) rad to each joint of the arm, within its range; the servos hold it there."""
  robot = env.robot
  joints = initial.qpos[robot.qpos] + _uniform_vector(key, low, high, len(robot.joint_names))
  joints = jnp.clip(joints, *robot.joint_range)
  ctrl = robot.init_ctrl if initial.ctrl is None else initial.ctrl
  qpos = initial.qpos.at[robot.qpos].set(joints)
  return initial.replace(qpos=qpos, ctrl=ctrl.at[robot.servos].set(joints))


@dataclasses.dataclass(frozen=True)
class ModelField:
  """Draws entries of a field of the model, in mode `startup` or `reset` (`playground.randomization`).

  Attributes:
    field: a field of `mjx.Model`, of numbers or switches, with a row per geom, body, site, actuator, tendon, pair,
      light, camera, material, joint, dof or qpos entry, or `actuator_kp`, which moves a position servo's gain and bias
      together, or `body_density`, which scales a body's mass and inertia together.
    target: whose rows: a name, a list of names, `all`, or `joints` (every joint but the free ones).
    operation: `set`, `scale`, `add`, or `rotate`, which turns a direction or quaternion about a random axis by the
      angle that is drawn, rad.
    range: (low, high) of `uniform` and `log_uniform`.
    mean: of `normal`, and of `bernoulli` the probability of true.
    std: of `normal`.
    distribution: `uniform`, `log_uniform` or `normal`; of a switch `bernoulli`.
    column: column, or columns, of a two-dimensional field; None is all.
    shared: one draw for all entries, instead of one for each.
    axis: of `rotate`, ranges of the axis's x, y and z before it is normalised; None is uniform over all directions.
  """

  field: str
  target: str | Sequence[str]
  operation: Literal["set", "scale", "add", "rotate"]
  range: Annotated[Sequence[float], span(-MOST)] | None = None
  mean: float | None = None
  std: AtLeast0 | None = None
  distribution: Literal["uniform", "log_uniform", "normal", "bernoulli"] = "uniform"
  column: Annotated[int | Sequence[int], count(0).each] | None = None
  shared: bool = False
  axis: Sequence[Sequence[float]] | None = None

  def check(self, key: str) -> None:
    """Raises ConfigError where parameters do not go together; `key` is that of `params` in the config."""
    needed = _MOMENTS.get(self.distribution, ("range",))
    for name in ("range", "mean", "std"):
      if (name in needed) != (getattr(self, name) is not None):
        verb = "needs" if name in needed else "has no"
        raise ConfigError(f"{key}: distribution {self.distribution!r} {verb} key {name!r}.")
    first, _ = self.parameters
    if self.distribution == "bernoulli" and not 0 <= first <= 1:
      raise ConfigError(f"{key}.mean={first:g} is no probability.")
    if self.distribution == "log_uniform" and first <= 0:
      raise ConfigError(f"{key}.range={list(self.parameters)} must be above 0 for log_uniform.")
    if self.axis is not None and self.operation != "rotate":
      raise ConfigError(f"{key}: operation {self.operation!r} has no key 'axis'.")
    if self.axis is not None:
      pairs = isinstance(self.axis, tuple) and len(self.axis) == 3 and all(map(span(-MOST).allows, self.axis))
      if not pairs or not any(map(any, self.axis)):
        raise ConfigError(f"{key}.axis={self.axis!r} is not three pairs [low, high], of x, y and z, not all 0.")

  @property
  def parameters(self) -> tuple[float, float]:
    """The distribution's two parameters: (low, high) or (mean, std); a bernoulli's std is 0 here."""
    first, second = (self.mean, self.std or 0.0) if self.distribution in _MOMENTS else (self.range or (0.0, 0.0))
    return first or 0.0, second

  def describe(self) -> dict[str, str]:
    """Returns field, target, operation and draw (distribution and parameters), for people."""
    first, second = self.parameters
    parameters = f"{first:g}" if self.distribution == "bernoulli" else f"{first:g}, {second:g}"
    return {
      "field": self.field if self.column is None else f"{self.field}[:, {format_value(self.column)}]",
      "target": self.target if isinstance(self.target, str) else ", ".join(self.target),
      "operation": self.operation,
      "draw": f"{self.distribution}({parameters})",
    }


@dataclasses.dataclass
class PushByForce:
  """Pushes the root body with a force, a half sine in time, at intervals; a full reset draws strength and times.

  Writes `pushing` (whether a push is under way in this step), `push_force` and the counters `push_wait`, `push_time`.

  Attributes:
    velocity: range of the strength, m/s: the force's peak is 0.5 * mass * velocity / duration, so that the body gains
      velocity / pi (as in Playground 0.2.0, whose ranges these are); up to 40 % less in a push of 2 or 3 steps, the
      last of which may lie beyond `duration`, where the force is reversed.
    duration_s: range, s.
    interval_s: range of the time between two pushes, s; it is a control step at least.
  """

  velocity: Span
  duration_s: _Duration
  interval_s: Span
  counters: ClassVar[tuple[str, ...]] = ("push_wait", "push_time")

  def bind(self, env: Any) -> None:
    self.env, self.body = env, env.robot.root

  def direction(self, key: jax.Array) -> jax.Array:
    """Draws the direction of a push: horizontal, world frame [3]."""
    return horizontal(key)

  def strength(self, key: jax.Array) -> jax.Array:
    """Draws the strength of an episode's pushes, m/s."""
    return _uniform(key, self.velocity)

  def times(self, interval_key: jax.Array, duration_key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Draws an episode's interval, in control steps, and its pushes' duration, s."""
    interval = _steps(_uniform(interval_key, self.interval_s), self.env.dt)
    return interval, _uniform(duration_key, self.duration_s)

  def mass(self, model: mjx.Model) -> jax.Array:
    """Returns the mass that is pushed, kg."""
    return self.env.robot.mass(model)

  def reset(self, key: jax.Array, model: mjx.Model) -> Info:
    interval_key, duration_key, strength_key = jax.random.split(key, 3)
    interval, duration = self.times(interval_key, duration_key)
    return (
      {
        "push_interval": interval,
        "push_duration": duration,
        "push_velocity": self.strength(strength_key),
        "push_direction": jnp.zeros_like(self.direction(key)),
        "pushing": jnp.zeros((), bool),
      }
      | self.of_model(model)
      | {name: jnp.zeros((), jnp.int32) for name in self.counters}
    )

  def of_model(self, model: mjx.Model) -> Info:
    """Returns the mass that is pushed, of a model that an episode may draw."""
    return {"push_mass": self.mass(model)}

  def step(self, data: PhysicsData, info: Info) -> tuple[PhysicsData, Info]:
    pushing, dt = info["push_wait"] >= info["push_interval"], self.env.dt
    force = self.force(info["push_time"] * dt, info["push_mass"], info["push_velocity"], info["push_duration"])
    force = jnp.where(pushing, force * info["push_direction"], 0.0)
    over = pushing & (info["push_time"] >= jnp.round(info["push_duration"] / dt))
    rng, key = jax.random.split(info["rng"])
    waited = jnp.where(pushing, info["push_wait"], info["push_wait"] + 1)
    starting = ~pushing & (waited >= info["push_interval"])
    return self.apply(data, force), {
      "rng": jnp.where(pushing, info["rng"], rng),
      "push_direction": jnp.where(starting, self.direction(key), info["push_direction"]),
      "push_wait": jnp.where(over, 0, waited),
      "push_time": jnp.where(starting, 0, info["push_time"] + pushing),
      "pushing": pushing,
    }

  @staticmethod
  def force(time: jax.Array, mass: jax.Array, velocity: jax.Array, duration: jax.Array) -> jax.Array:
    """Returns a push's force at `time` s after it began, N."""
    return 0.5 * jnp.sin(jnp.pi * time / duration) * mass * velocity / duration

  def apply(self, data: PhysicsData, force: jax.Array) -> PhysicsData:
    """Returns the physics with a further force [3], or force and torque [6], on the body."""
    return data.replace(xfrc_applied=data.xfrc_applied.at[self.body, : force.size].add(force))


@dataclasses.dataclass
class PushByForceRegularly(PushByForce):
  """As `PushByForce`, but the interval runs from the start of one push to that of the next, in whole steps.

  (Playground 0.2.0, Barkour.)
  """

  counters = ("push_step",)

  def times(self, interval_key: jax.Array, duration_key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Draws an episode's interval and its pushes' duration, both in control steps."""
    steps = lambda key, reach: jax.random.randint(key, (), *_steps(jnp.array(reach), self.env.dt))
    return steps(interval_key, self.interval_s), steps(duration_key, self.duration_s)

  def step(self, data: PhysicsData, info: Info) -> tuple[PhysicsData, Info]:
    dt, since = self.env.dt, info["push_step"] % info["push_interval"]
    starting = (since == 0) & (info["push_step"] > 0)
    rng, key = jax.random.split(info["rng"])
    direction = jnp.where(starting, self.direction(key), info["push_direction"])
    pushing = since < info["push_duration"]
    force = self.force(since * dt, info["push_mass"], info["push_velocity"], info["push_duration"] * dt)
    return self.apply(data, jnp.where(pushing, force, 0.0) * direction), {
      "rng": jnp.where(starting, rng, info["rng"]),
      "push_step": info["push_step"] + 1,
      "push_direction": direction,
      "pushing": pushing & (info["push_step"] >= info["push_interval"]),
    }


@dataclasses.dataclass
class PushObjectByWrench(PushByForceRegularly):
  """Forces and torques on the object of the task, in any direction, at regular times. (Playground 0.2.0, LEAP hand.)

  Attributes:
    angular_velocity: range of the torques' strength, rad/s (a torque is that of a body of 1 m radius of gyration).
  """

  angular_velocity: Span = (0.0, 0.0)

  def bind(self, env: Any) -> None:
    self.env, self.body = env, env.robot.cube

  def direction(self, key: jax.Array) -> jax.Array:
    """Draws a unit vector of force and torque together, world frame [6]."""
    vector = jax.random.normal(key, (6,))
    return vector / jnp.linalg.norm(vector)

  def strength(self, key: jax.Array) -> jax.Array:
    """Draws the strengths of force and torque of an episode's pushes, m/s and rad/s [6]."""
    turn = _uniform(jax.random.fold_in(key, 1), self.angular_velocity)
    return jnp.repeat(jnp.array([super().strength(key), turn]), 3)

  def mass(self, model: mjx.Model) -> jax.Array:
    return model.body_mass[self.body]


@dataclasses.dataclass
class PushBySettingVelocity:
  """Adds a horizontal velocity in a random direction to the root's, at an interval that a full reset draws.

  Writes `push_step`, `push_interval_steps`, `push` (the direction of a push in this step, else 0) and `pushing`.

  Attributes:
    velocity: range of the change, m/s.
    interval_s: range of the time between two pushes, s; it is a control step at least.
  """

  velocity: Span
  interval_s: Span

  def bind(self, env: Any) -> None:
    if not hasattr(env.robot, "root"):
      raise ConfigError("the robot has no free root, whose velocity this event changes.")
    self.dt: float = env.dt

  def reset(self, key: jax.Array, model: mjx.Model) -> Info:
    return {
      "push": jnp.zeros(2),
      "push_step": jnp.zeros((), jnp.int32),
      "push_interval_steps": _steps(_uniform(key, self.interval_s), self.dt),
      "pushing": jnp.zeros((), bool),
    }

  def step(self, data: PhysicsData, info: Info) -> tuple[PhysicsData, Info]:
    rng, angle_key, size_key = jax.random.split(info["rng"], 3)
    step = info["push_step"] + 1
    due = step % info["push_interval_steps"] == 0
    push = horizontal(angle_key)[:2] * due
    data = data.replace(qvel=data.qvel.at[:2].add(push * _uniform(size_key, self.velocity)))
    return data, {"rng": rng, "push": push, "push_step": step, "pushing": due}


def _steps(seconds: jax.Array, dt: float) -> jax.Array:
  """Returns the nearest number of control steps, 1 at least, int32."""
  return jnp.maximum(jnp.round(seconds / dt), 1).astype(jnp.int32)


def _uniform(key: jax.Array, reach: Span, shape: tuple[int, ...] = ()) -> jax.Array:
  return jax.random.uniform(key, shape, minval=reach[0], maxval=reach[1])


def _uniform_vector(key: jax.Array, low: Sequence[float], high: Sequence[float], size: int) -> jax.Array:
  if not len(low) == len(high) == size or any(a > b for a, b in zip(low, high, strict=True)):
    raise ConfigError(f"low={list(low)} and high={list(high)} must be {size} numbers each, none above high.")
  return jax.random.uniform(key, (size,), minval=jnp.array(low), maxval=jnp.array(high))
