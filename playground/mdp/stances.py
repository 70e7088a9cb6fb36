"""Reward terms of taking up a stance: on all feet after a fall, or on some of them (see `rewards.py`).

Formulas are those of Playground 0.2.0; up is the base's upward axis in the world frame, h a height (see `_height`).
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from playground.mdp.legged import Context
from playground.mdp.lookup import lookup

# The base site's height belongs to the state before the last physics step, the root joint's to the one after it.
_HEIGHTS: dict[str, Callable[[Context], jax.Array]] = {
  "base_site": lambda c: c.base_height,
  "root_joint": lambda c: c.data.qpos[2],
}


def _height(c: Context, height_of: str) -> jax.Array:
  return lookup(_HEIGHTS, height_of, "env.reward.height_of")(c)


def _tilt(c: Context) -> jax.Array:
  """|up - e_z|², from 0 (upright) to 4 (upside down)."""
  return jnp.square(c.sensor("upvector") - jnp.array([0.0, 0.0, 1.0])).sum()


def _upright(c: Context, upright_tolerance: float) -> jax.Array:
  return _tilt(c) < upright_tolerance


def upright(c: Context) -> jax.Array:
  """exp(-2 |up - e_z|²)."""
  return jnp.exp(-2 * _tilt(c))


def torso_height(c: Context, target_height: float, height_of: str) -> jax.Array:
  """exp(min(h, target)) - 1."""
  return jnp.exp(jnp.minimum(_height(c, height_of), target_height)) - 1


def torso_height_share(c: Context, target_height: float, height_of: str) -> jax.Array:
  """h / target, within 0 and 1."""
  return jnp.clip(_height(c, height_of) / target_height, 0.0, 1.0)


def upright_pose(c: Context, upright_tolerance: float) -> jax.Array:
  """exp(-|q - default|² / 2) while upright, which is |up - e_z|² < tolerance; else 0."""
  error = jnp.square(c.joint_pos - c.robot.default_pose).sum()
  return jnp.exp(-0.5 * error) * _upright(c, upright_tolerance)


def calm(
  c: Context, upright_tolerance: float, target_height: float, height_tolerance: float, height_of: str
) -> jax.Array:
  """exp(-|action|² / 2) while upright with target - h < tolerance (m); else 0: once up, stay."""
  high = target_height - _height(c, height_of) < height_tolerance
  return jnp.exp(-0.5 * jnp.square(c.action).sum()) * (_upright(c, upright_tolerance) & high)


def height_deficit(c: Context, target_height: float) -> jax.Array:
  """exp(-(target - min(h, target))), h that of the base site."""
  return jnp.exp(jnp.minimum(c.base_height, target_height) - target_height)


def alignment(c: Context, forward: Sequence[float]) -> jax.Array:
  """((x · forward + 1) / 2)², x the base's forward axis in the world frame, `forward` where it should point."""
  return jnp.square(0.5 * c.forward @ jnp.array(forward) + 0.5)


def lifted_contact(c: Context, lifted_feet: np.ndarray) -> jax.Array:
  """1 while any of the feet that should be in the air touches the floor."""
  return c.contact[lifted_feet].any().astype(jnp.float32)


def drift(c: Context) -> jax.Array:
  """v_x² + v_y² + w_z², the root's velocity in the world frame and its turning about its own z."""
  return jnp.square(c.data.qvel[jnp.array([0, 1, 5])]).sum()


STANCES: dict[str, Callable[..., jax.Array]] = {
  f.__name__: f
  for f in (
    upright, torso_height, torso_height_share, upright_pose, calm, height_deficit, alignment, lifted_contact, drift,
  )
}  # fmt: skip
