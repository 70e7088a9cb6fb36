"""A reward, an observation, a termination and an event for robots on legs."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from playground.limits import Positive, Span
from playground.mdp.legged import LeggedContext
from playground.mdp.poses import horizontal
from playground.physics.backend import PhysicsData, mjx


def height_tracking_exp(c: LeggedContext, target: float, std: Positive) -> jax.Array:
  """exp(-(h - target)² / std²), h the height of the base site, m."""
  return jnp.exp(-jnp.square((c.base_height - target) / std))


def roll_pitch(c: LeggedContext) -> jax.Array:
  """Roll and pitch of the base, rad [2]."""
  x, y, z = -c.gravity
  return jnp.array([jnp.arctan2(y, z), jnp.arctan2(-x, jnp.sqrt(y**2 + z**2))])


def too_low(c: LeggedContext, height: Positive) -> jax.Array:
  """Whether the base site is below `height`, m."""
  return c.base_height < height


@dataclasses.dataclass
class Wind:
  """Blows on the base with a horizontal force, drawn at every reset.

  Attributes:
    force: range of its strength, N.
  """

  force: Span

  def bind(self, env: Any) -> None:
    """Looks up the body, once."""
    self.body: int = env.robot.root

  def reset(self, key: jax.Array, model: mjx.Model) -> dict[str, Any]:
    """Returns the entries of `info` that an episode starts with."""
    angle_key, size_key = jax.random.split(key)
    low, high = self.force
    return {"wind": jax.random.uniform(size_key, minval=low, maxval=high) * horizontal(angle_key)}

  def step(self, data: PhysicsData, info: dict[str, Any]) -> tuple[PhysicsData, dict[str, Any]]:
    """Returns the physics that the control step begins with, and the entries of `info` that change."""
    return data.replace(xfrc_applied=data.xfrc_applied.at[self.body, :3].add(info["wind"])), {}
