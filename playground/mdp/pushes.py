"""Pushes against a body, and when they come: forces for a while (kicks, wrenches), or jumps of its velocity."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp

from playground.envs.physics import PhysicsData
from playground.mdp.lookup import lookup

Info = dict[str, Any]


class Pushes(Protocol):
  """Disturbs the physics before a step.

  Attributes:
    keys: names of the random keys that `start` needs.
  """

  keys: ClassVar[tuple[str, ...]]

  def start(self, keys: Mapping[str, jax.Array], mass: jax.Array) -> Info:
    """Returns the entries of `info` that an episode starts with; `mass` (kg) is what is pushed."""
    ...

  def act(self, data: PhysicsData, info: Mapping[str, Any]) -> tuple[PhysicsData, Info]:
    """Returns the disturbed physics, and the entries of `info` that changed."""
    ...


@dataclasses.dataclass(frozen=True)
class Kicks:
  """Forces on the root body for a short while, from time to time.

  Attributes:
    enable: whether there are any.
    velocity: range of their strength, m/s (see `kick_force`).
    duration: range, s.
    interval: range of the time between them, s.
    root: id of the body.
    dt: control step, s.
  """

  keys: ClassVar[tuple[str, ...]] = ("push_interval", "push_duration", "push_velocity")
  enable: bool
  velocity: Sequence[float]
  duration: Sequence[float]
  interval: Sequence[float]
  root: int
  dt: float

  def start(self, keys: Mapping[str, jax.Array], mass: jax.Array) -> Info:
    info = sample_kicks(jnp.stack([keys[name] for name in self.keys]), self, self.dt)
    return info | ({"pert_mass": mass} if self.enable else {})

  def act(self, data: PhysicsData, info: Mapping[str, Any]) -> tuple[PhysicsData, Info]:
    if not self.enable:
      return data, {}
    force, changed = advance_kick(info, info["pert_mass"], self.dt)
    return data.replace(xfrc_applied=data.xfrc_applied.at[self.root, :3].set(force)), changed


@dataclasses.dataclass(frozen=True)
class RegularKicks(Kicks):
  """As `Kicks`, but in whole control steps, and the interval is that from the start of one to the start of the next.

  (Playground 0.2.0, Barkour.)
  """

  def direction(self, key: jax.Array) -> jax.Array:
    """Draws which way a kick pushes, a unit vector in the world frame: horizontal, [3]."""
    return _horizontal(key)

  def start(self, keys: Mapping[str, jax.Array], mass: jax.Array) -> Info:
    steps = lambda key, reach: jax.random.randint(keys[key], (), *(round(time / self.dt) for time in reach))
    low, high = self.velocity
    return {
      "push_step": jnp.zeros((), jnp.int32),
      "pert_interval": steps("push_interval", self.interval),
      "pert_duration": steps("push_duration", self.duration),
      "pert_mag": jax.random.uniform(keys["push_velocity"], minval=low, maxval=high),
      "pert_dir": jnp.zeros(3),  # until the first kick
      "pert_mass": mass,
    }

  def act(self, data: PhysicsData, info: Mapping[str, Any]) -> tuple[PhysicsData, Info]:
    if not self.enable:
      return data, {}
    since = info["push_step"] % info["pert_interval"]
    starting = (since == 0) & (info["push_step"] > 0)
    rng, key = jax.random.split(info["rng"])
    direction = jnp.where(starting, self.direction(key), info["pert_dir"])
    force = kick_force(since * self.dt, info["pert_mass"], info["pert_mag"], info["pert_duration"] * self.dt)
    force = jnp.where(since < info["pert_duration"], force, 0.0) * direction
    changed = {"rng": jnp.where(starting, rng, info["rng"]), "push_step": info["push_step"] + 1, "pert_dir": direction}
    return data.replace(xfrc_applied=data.xfrc_applied.at[self.root, : force.size].set(force)), changed


@dataclasses.dataclass(frozen=True)
class Wrenches(RegularKicks):
  """As `RegularKicks`, but forces and torques on a loose object, in any direction. (Playground 0.2.0, LEAP hand.)

  Attributes:
    angular_velocity: range of the torques' strength, rad/s (a torque is that of a body of 1 m radius of gyration).
    parity: as Playground 0.2.0, both strengths come from one draw.
  """

  angular_velocity: Sequence[float]
  parity: bool = False

  def direction(self, key: jax.Array) -> jax.Array:
    """Draws a unit vector of force and torque together, world frame, [6]."""
    vector = jax.random.normal(key, (6,))
    return vector / jnp.linalg.norm(vector)

  def start(self, keys: Mapping[str, jax.Array], mass: jax.Array) -> Info:
    info = super().start(keys, mass)
    key = keys["push_velocity"]
    low, high = self.angular_velocity
    turn = jax.random.uniform(key if self.parity else jax.random.fold_in(key, 1), minval=low, maxval=high)
    return info | {"pert_mag": jnp.repeat(jnp.array([info["pert_mag"], turn]), 3), "pert_dir": jnp.zeros(6)}


@dataclasses.dataclass(frozen=True)
class Jumps:
  """Jumps of the base's horizontal velocity, at one interval in an episode, each in a direction of its own.

  Attributes:
    enable: whether there are any.
    velocity: range of the change, m/s.
    interval: range of the time between them, s.
    dt: control step, s.
  """

  keys: ClassVar[tuple[str, ...]] = ("push_interval",)
  enable: bool
  velocity: Sequence[float]
  interval: Sequence[float]
  dt: float

  def start(self, keys: Mapping[str, jax.Array], mass: jax.Array) -> Info:
    del mass
    low, high = self.interval
    interval = jax.random.uniform(keys["push_interval"], minval=low, maxval=high)
    return {
      "push": jnp.zeros(2),  # direction of a jump in this step, else 0
      "push_step": jnp.zeros((), jnp.int32),
      "push_interval_steps": jnp.round(interval / self.dt).astype(jnp.int32),
    }

  def act(self, data: PhysicsData, info: Mapping[str, Any]) -> tuple[PhysicsData, Info]:
    rng, angle_key, size_key = jax.random.split(info["rng"], 3)
    angle = jax.random.uniform(angle_key, maxval=2 * jnp.pi)
    low, high = self.velocity
    size = jax.random.uniform(size_key, minval=low, maxval=high)
    step = info["push_step"] + 1
    due = (step % info["push_interval_steps"] == 0) & self.enable
    push = jnp.array([jnp.cos(angle), jnp.sin(angle)]) * due
    data = data.replace(qvel=data.qvel.at[:2].add(push * size))
    return data, {"rng": rng, "push": push, "push_step": step}


def make_pushes(config: Any, root: int, dt: float) -> Pushes:
  """Builds the pushes that `env.pushes.kind` names; `root` is the id of the body that a kick acts on."""
  velocity, duration, interval = (tuple(config[key]) for key in ("velocity", "duration", "interval"))
  kinds: dict[str, Pushes] = {
    "kick": Kicks(config.enable, velocity, duration, interval, root, dt),
    "regular_kick": RegularKicks(config.enable, velocity, duration, interval, root, dt),
    "jump": Jumps(config.enable, velocity, interval, dt),
  }
  return lookup(kinds, config.kind, "env.pushes.kind")


def sample_kicks(keys: jax.Array, config: Any, dt: float) -> Info:
  """Draws one episode's kicks: they come at one interval, with one duration and one strength.

  Args:
    keys: three random keys: interval, duration, strength.
    config: has `interval` and `duration` (ranges, s) and `velocity` (range, m/s, see `kick_force`).
    dt: control step, s.

  Returns:
    Entries of `info`: `steps_until_next_pert`, `steps_since_last_pert`, `pert_steps` (since the kick began),
    `pert_duration` (steps), `pert_duration_seconds`, `pert_mag` (m/s) and `pert_dir` (unit vector, world, shape [3]).
  """
  interval, duration, velocity = (
    jax.random.uniform(key, minval=low, maxval=high)
    for key, (low, high) in zip(keys, (config.interval, config.duration, config.velocity), strict=True)
  )
  zero = jnp.zeros((), jnp.int32)
  return {
    "steps_until_next_pert": jnp.round(interval / dt).astype(jnp.int32),
    "steps_since_last_pert": zero,
    "pert_steps": zero,
    "pert_duration": jnp.round(duration / dt).astype(jnp.int32),
    "pert_duration_seconds": duration,
    "pert_mag": velocity,
    "pert_dir": jnp.zeros(3),
  }


def kick_force(time: jax.Array, mass: jax.Array, velocity: jax.Array, duration: jax.Array) -> jax.Array:
  """Returns a kick's force at `time` s after it began, N: 0.5 * mass * velocity / duration * sin(pi * time / duration).

  A half sine. Its area over `duration` is mass * velocity / pi: the body gains velocity / pi, not `velocity`.
  (Playground 0.2.0; kept, since its range of velocities goes with it.)
  """
  return 0.5 * jnp.sin(jnp.pi * time / duration) * mass * velocity / duration


def advance_kick(info: Mapping[str, Any], mass: jax.Array, dt: float) -> tuple[jax.Array, Info]:
  """Moves the kicks one control step on.

  While the interval runs nothing happens; when it is over a horizontal direction is drawn and the kick starts with the
  next step.

  Args:
    info: the entries of `sample_kicks` and `rng`.
    mass: mass that the kick moves, kg.
    dt: control step, s.

  Returns:
    The force on the root body during this step, N, world frame, shape [3]; and the entries of `info` that changed.
  """
  kicking = info["steps_since_last_pert"] >= info["steps_until_next_pert"]
  force = kick_force(info["pert_steps"] * dt, mass, info["pert_mag"], info["pert_duration_seconds"])
  over = kicking & (info["pert_steps"] >= info["pert_duration"])

  rng, key = jax.random.split(info["rng"])
  waited = jnp.where(kicking, info["steps_since_last_pert"], info["steps_since_last_pert"] + 1)
  starting = ~kicking & (waited >= info["steps_until_next_pert"])
  return jnp.where(kicking, force * info["pert_dir"], 0.0), {
    "rng": jnp.where(kicking, info["rng"], rng),
    "steps_since_last_pert": jnp.where(over, 0, waited),
    "pert_steps": jnp.where(starting, 0, info["pert_steps"] + kicking),
    "pert_dir": jnp.where(starting, _horizontal(key), info["pert_dir"]),
  }


def _horizontal(key: jax.Array) -> jax.Array:
  """A horizontal unit vector, shape [3]."""
  angle = jax.random.uniform(key, maxval=2 * jnp.pi)
  return jnp.array([jnp.cos(angle), jnp.sin(angle), 0.0])
