"""Pushes against a robot's body, and when they come."""

from typing import Any

import jax
import jax.numpy as jnp

Info = dict[str, Any]


def sample_kicks(keys: jax.Array, config: Any, dt: float) -> Info:
  """Draws one episode's kicks: they come at one interval, with one duration and one strength.

  Args:
    keys: three random keys: interval, duration, strength.
    config: `interval` and `duration` (ranges, s), `velocity` (range, m/s, see `kick_force`).
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


def advance_kick(info: Info, mass: jax.Array, dt: float) -> tuple[jax.Array, Info]:
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
  angle = jax.random.uniform(key, maxval=2 * jnp.pi)
  direction = jnp.array([jnp.cos(angle), jnp.sin(angle), 0.0])
  waited = jnp.where(kicking, info["steps_since_last_pert"], info["steps_since_last_pert"] + 1)
  starting = ~kicking & (waited >= info["steps_until_next_pert"])
  return jnp.where(kicking, force * info["pert_dir"], 0.0), {
    "rng": jnp.where(kicking, info["rng"], rng),
    "steps_since_last_pert": jnp.where(over, 0, waited),
    "pert_steps": jnp.where(starting, 0, info["pert_steps"] + kicking),
    "pert_dir": jnp.where(starting, direction, info["pert_dir"]),
  }
