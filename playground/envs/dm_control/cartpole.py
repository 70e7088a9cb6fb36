"""Cart and pole: balance, or swing up and balance, with dense or sparse reward (DM Control Suite)."""

import math
from typing import Any

import jax
import jax.numpy as jnp

from playground.envs.dm_control.suite import SuiteTask, Terms
from playground.errors import ConfigError
from playground.mdp.context import StepContext
from playground.mdp.tolerance import tolerance
from playground.physics.backend import PhysicsData

_SLIDER, _HINGE = 0, 1


class Cartpole(SuiteTask):
  """Moves a cart (one motor, action in [-1, 1]) to keep a pole upright in the middle of the rails.

  Observation [5]: cart position m, cos and sin of the pole's angle, cart velocity m/s, pole velocity rad/s. The dense
  reward is the product of upright, centered, small_control and small_velocity, the sparse one of cart_in_bounds and
  angle_in_bounds.
  """

  domain = "cartpole"
  derived = ("xmat",)

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    cart_key, pole_key, velocity_key = jax.random.split(rng, 3)
    if self.config.swing_up:
      cart = 0.01 * jax.random.normal(cart_key)
      pole = jnp.pi + 0.01 * jax.random.normal(pole_key)
    else:
      cart = jax.random.uniform(cart_key, minval=-0.1, maxval=0.1)
      pole = jax.random.uniform(pole_key, minval=-0.034, maxval=0.034)
    return {"qpos": jnp.stack([cart, pole]), "qvel": 0.01 * jax.random.normal(velocity_key, (2,))}

  def parts(self, data: PhysicsData) -> dict[str, jax.Array]:
    axis = data.xmat[self.body["pole_1"], :, 2]
    return {"cart_position": data.qpos[_SLIDER], "pole_cos": axis[2], "pole_sin": axis[0], "velocity": data.qvel}

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    cart, cosine = data.qpos[_SLIDER], data.xmat[self.body["pole_1"], 2, 2]
    if self.config.sparse:
      terms = {"cart_in_bounds": tolerance(cart, (-0.25, 0.25)), "angle_in_bounds": tolerance(cosine, (0.995, 1.0))}
    else:
      terms = {
        "upright": (cosine + 1) / 2,
        "centered": (1 + tolerance(cart, margin=2)) / 2,
        "small_control": (4 + tolerance(action[0], margin=1, sigmoid="quadratic", value_at_margin=0)) / 5,
        "small_velocity": (1 + tolerance(data.qvel[_HINGE], margin=5)) / 2,
      }
    return math.prod(terms.values(), start=jnp.ones(())), terms


class CartpoleVision(Cartpole):
  """Keeps the pole upright, for learning from pixels: one image shows the reward, and a fall ends the episode.

  The reward of a step is 0.1 less small penalties (pole and cart off the middle, motion, action), so that 25 is the
  most of 250 steps. An episode ends when the pole lies, or the cart is 3 m out.
  """

  def __init__(self, config: Any):
    """Loads the model. `config`: see `configs/env/CartpoleBalanceVision.yaml`."""
    super().__init__(config)
    if config.swing_up or config.sparse:
      raise ConfigError("env.swing_up and env.sparse must be false here: a hanging pole ends the episode.")

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    (x, _), (x_speed, angle_speed) = data.qpos, data.qvel
    terms = {
      "alive": jnp.full((), 0.1),
      "pole_pos_penalty": -jnp.square(1 - data.xmat[self.body["pole_1"], 2, 2]),
      "cart_pos_penalty": -0.02 * jnp.square(x),
      "cart_vel_penalty": -0.01 * jnp.abs(x_speed),
      "pole_vel_penalty": -0.005 * jnp.abs(angle_speed),
      "action_penalty": -0.01 * jnp.square(action).sum(),
    }
    return sum(terms.values(), jnp.zeros(())), terms


def pole_fallen(c: StepContext) -> jax.Array:
  """The pole lies, or the cart is 3 m out."""
  return (jnp.abs(c.data.qpos[_SLIDER]) > 3) | (jnp.abs(c.data.qpos[_HINGE]) > jnp.pi / 2)
