"""Reward terms of feet: how they swing, land and stand (see `rewards.py`). Heights are the world's, on any terrain."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from playground.mdp.gait import swing_height
from playground.mdp.legged import Context


def feet_clearance(c: Context, max_foot_height: float) -> jax.Array:
  """Sum over feet of |z - height| sqrt(|v_xy|): a moving foot should be at swing height. (Paper: (z - height)².)"""
  speed = jnp.linalg.norm(c.feet_velocity[:, :2], axis=-1)
  return (jnp.abs(c.feet_height - max_foot_height) * jnp.sqrt(speed)).sum()


def feet_height(c: Context, max_foot_height: float) -> jax.Array:
  """Sum over feet that touch down of (peak / height - 1)², peak the highest z of the swing."""
  error = jnp.square(c.kept("swing_peak") / max_foot_height - 1)
  return (error * c.first_contact).sum()


def feet_slip(c: Context) -> jax.Array:
  """Sum over feet in contact of |v_xy|²."""
  return (jnp.square(c.feet_velocity[:, :2]).sum(axis=-1) * c.contact).sum()


def feet_slip_of_base(c: Context) -> jax.Array:
  """Number of feet in contact times |v_xy| of the base, world frame. (Paper: `feet_slip`.)"""
  return jnp.linalg.norm(c.sensor("global_linvel")[:2]) * c.contact.sum()


def feet_air_time(c: Context, min_air_time: float) -> jax.Array:
  """Sum over feet that touch down of air time - min, s. (Paper: clipped to [0, max - min].)"""
  return ((c.kept("feet_air_time") - min_air_time) * c.first_contact).sum()


def feet_air_time_unless_turning(c: Context, min_air_time: float) -> jax.Array:
  """As `feet_air_time`, while |command_xy| > 0.05 m/s: 0 when asked to turn on the spot. (0.2.0's Barkour.)"""
  return feet_air_time(c, min_air_time) * (jnp.linalg.norm(c.command[:2]) > 0.05)


def feet_air_time_capped(c: Context, min_air_time: float, max_air_time: float) -> jax.Array:
  """Sum over feet that touch down of min(air time - min, max - min), s. (Paper: not below 0 either.)"""
  time = (c.kept("feet_air_time") - min_air_time) * c.first_contact
  return jnp.minimum(time, max_air_time - min_air_time).sum()


def feet_phase(c: Context, max_foot_height: float, feet_phase_sigma: float) -> jax.Array:
  """exp(-sum (z - swing height)² / sigma), swing height that of the foot's phase in the gait (see `gait.py`).

  The gait's own `foot_height` takes the place of the maximum where it is drawn.
  """
  peak = c.info.get("foot_height", max_foot_height)
  error = jnp.square(c.feet_height - swing_height(c.phase, peak)).sum()
  return jnp.exp(-error / feet_phase_sigma)


def feet_phase_unless_at_rest(c: Context, max_foot_height: float, feet_phase_sigma: float) -> jax.Array:
  """As `feet_phase`; 0 when asked to stand still, unless the base moves or turns at more than 0.1 m/s or rad/s."""
  linvel, angvel = c.sensor("global_linvel"), c.sensor("global_angvel")
  moving = (jnp.linalg.norm(linvel[:2]) > 0.1) | (jnp.abs(angvel[2]) > 0.1) | ~c.still
  return feet_phase(c, max_foot_height, feet_phase_sigma) * moving


def feet_distance(c: Context, min_feet_distance: float) -> jax.Array:
  """min - d, m, within 0 and 0.1: d is how far the first two feet are apart sideways, seen along the base's heading."""
  apart = c.data.site_xpos[c.robot.feet[0]] - c.data.site_xpos[c.robot.feet[1]]
  heading = jnp.arctan2(c.forward[1], c.forward[0])
  sideways = jnp.abs(jnp.cos(heading) * apart[1] - jnp.sin(heading) * apart[0])
  return jnp.clip(min_feet_distance - sideways, 0.0, 0.1)


def contact_force(c: Context, max_contact_force: float) -> jax.Array:
  """Sum over feet of max(|F_z| - max, 0), N, F the force between the foot and its leg."""
  vertical = jnp.abs(c.robot.feet_force(c.data)[:, 2])
  return jnp.maximum(vertical - max_contact_force, 0.0).sum()


FEET: dict[str, Callable[..., jax.Array]] = {
  f.__name__: f
  for f in (
    feet_clearance, feet_height, feet_slip, feet_slip_of_base, feet_air_time, feet_air_time_unless_turning,
    feet_air_time_capped, feet_phase, feet_phase_unless_at_rest, feet_distance, contact_force,
  )
}  # fmt: skip
