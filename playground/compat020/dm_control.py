"""Playground 0.2.0's DM Control Suite, upstream bugs included."""

import jax
import jax.numpy as jnp

from playground.envs.base import State
from playground.envs.dm_control import ball_in_cup, cartpole, finger, fish, pendulum, reacher, swimmer, walker
from playground.envs.dm_control.suite import SuiteTask, Terms
from playground.mdp.tolerance import tolerance
from playground.physics.backend import PhysicsData, mjx


class _LateTarget(SuiteTask):
  """The first observation shows the model's default target: the target is moved after the forward pass."""

  def reset(self, rng: jax.Array, model: mjx.Model | None = None) -> State:
    state = super().reset(rng, model)
    before = state.data.replace(mocap_pos=self.physics.make().mocap_pos)
    return state.replace(obs=self.observe(self.physics.forward(self.mjx_model if model is None else model, before)))


class BallInCup(ball_in_cup.BallInCup):
  """The ball always hangs on its string at the start."""

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    return {}


class Cartpole(cartpole.Cartpole):
  """Several of the initial positions and velocities come from one key, so that they are functions of each other."""

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    cart_key, pole_key, _ = jax.random.split(rng, 3)
    key = cart_key if self.config.swing_up else pole_key
    return super().initial(rng) | {"qvel": 0.01 * jax.random.normal(key, (2,))}


class CartpoleVision(Cartpole, cartpole.CartpoleVision):
  """See `Cartpole`."""


class _Finger(finger.Finger):
  """The hinge's initial angle comes from the key of the finger's angles, in proportion to the proximal joint's."""

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    fields = super().initial(rng)
    low, high = self.mj_model.jnt_range[0]
    share = (fields["qpos"][0] - low) / (high - low)
    return fields | {"qpos": fields["qpos"].at[2].set(2 * jnp.pi * share - jnp.pi)}


class FingerSpin(_Finger, finger.FingerSpin):
  """See `_Finger`."""


class FingerTurn(_LateTarget, _Finger, finger.FingerTurn):
  """See `_Finger` and `_LateTarget`."""


class FishSwim(_LateTarget, fish.FishSwim):
  """See `_LateTarget`."""


class Reacher(_LateTarget, reacher.Reacher):
  """See `_LateTarget`."""


class Swimmer(_LateTarget, swimmer.Swimmer):
  """See `_LateTarget`."""


class PendulumSwingup(pendulum.PendulumSwingup):
  """Starts on one half of the circle; a cosine that rounding takes above 1 earns nothing."""

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    return {"qpos": jnp.abs(super().initial(rng)["qpos"])}

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    return tolerance(data.xmat[self.body["pole"], 2, 2], (pendulum.UPRIGHT, 1.0)), {}


class Walker(walker.Walker):
  """The torso's uprightness is observed in place of its height."""

  def observe(self, data: PhysicsData) -> jax.Array:
    return super().observe(data).at[14].set(data.xmat[self.body["torso"], 2, 2])
