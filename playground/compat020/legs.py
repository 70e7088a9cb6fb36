"""Robots on legs as in Playground 0.2.0, upstream bugs included (docs/differences.md)."""

import copy
import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from playground.envs.locomotion.joystick import Joystick
from playground.envs.locomotion.stand import Stand
from playground.envs.task import InitialState
from playground.mdp import rewards
from playground.mdp.commands import Gait
from playground.mdp.context import StepContext
from playground.mdp.events import Info, PushByForce, PushByForceRegularly
from playground.mdp.legged import LeggedContext, is_still
from playground.physics.backend import mjx

_SIDEWAYS = 0.1  # m/s


def joint_pos_limits_scaled(c: LeggedContext, soft_limit_factor: float) -> jax.Array:
  """As `joint_pos_limits`, with the limits themselves times the factor: the Go1's knee may go beyond its hard limit."""
  lower, upper = c.robot.joint_range * soft_limit_factor
  return (jnp.maximum(lower - c.joint_pos, 0) + jnp.maximum(c.joint_pos - upper, 0)).sum()


def hip_deviation_l1_sideways(c: LeggedContext) -> jax.Array:
  """Sum |q - default| over the hips, only while |command_y| > 0.1 m/s (Berkeley Humanoid, T1)."""
  return rewards.joint_deviation_l1(c, "hips") * (jnp.abs(c.command[1]) > _SIDEWAYS)


def hip_deviation_l1_crossed(c: LeggedContext) -> jax.Array:
  """Sum |q - default| over the hips, times 2 while command_y > 0.1 m/s, else 4 (G1)."""
  return jnp.where(c.command[1] > _SIDEWAYS, 2.0, 4.0) * rewards.joint_deviation_l1(c, "hips")


def stand_still_unless_left(c: LeggedContext) -> jax.Array:
  """Sum |q - default| whenever command_y / |command_xy| < 0.1 (Barkour): a direction is taken for the norm."""
  return rewards.joint_deviation_l1(c) * (c.command[1] / jnp.linalg.norm(c.command[:2]) < 0.1)


def feet_air_time_unless_turning(c: LeggedContext, threshold: float) -> jax.Array:
  """As `feet_air_time`, while |command_xy| > 0.05 m/s (Barkour)."""
  return rewards.feet_air_time(c, threshold) * (jnp.linalg.norm(c.command[:2]) > 0.05)


def is_terminated_early(c: LeggedContext) -> jax.Array:
  """As `is_terminated`, but 0 in the last two steps of a command of 501 (Barkour, OP3)."""
  return rewards.is_terminated(c) * (c.info["command_steps_left"] > 1)


def action_smoothness_l2_lagged(c: StepContext) -> jax.Array:
  """|a1 - a2|² + |a1 - 2 a2 + a|² (H1): the order of the actions is mixed up."""
  last, before = c.last_act, c.action_before_last
  return jnp.square(last - before).sum() + jnp.square(last - 2 * before + c.action).sum()


def lin_vel_z_l2_in_other_gaits(c: LeggedContext, gaits: list[str]) -> jax.Array:
  """v_z² in all gaits but those (Spot)."""
  return rewards.lin_vel_z_l2(c) - rewards.lin_vel_z_l2_in_gaits(c, gaits)


def reset_ctrl_to_zero(key: jax.Array, env: Any, initial: InitialState) -> InitialState:
  """Targets are 0 before the first action (Apollo, Barkour, H1, OP3, Spot)."""
  del key
  return initial.replace(ctrl=jnp.zeros(env.mj_model.nu))


@dataclasses.dataclass
class PushNominalMass(PushByForce):
  """As `PushByForce`, in proportion to the mass before randomisation."""

  def mass(self, model: mjx.Model) -> jax.Array:
    return super().mass(self.env.mjx_model)


@dataclasses.dataclass
class PushNominalMassRegularly(PushNominalMass, PushByForceRegularly):
  """As `PushByForceRegularly`, in proportion to the mass before randomisation."""


@dataclasses.dataclass
class GaitInStep(Gait):
  """As `Gait`, but after standing still all feet go on in step (T1, Apollo), and phases may begin beyond pi (Spot)."""

  def bind(self, env: Any) -> None:
    super().bind(env)
    self._phases = jnp.array([env.robot.gait(name) for name in self.modes])

  def step(self, c: StepContext, key: jax.Array) -> Info:
    del key
    phase = jnp.fmod(c.info["phase"] + c.info["phase_dt"] + jnp.pi, 2 * jnp.pi) - jnp.pi
    return {"phase": jnp.where(is_still(c.command), np.pi, phase) if self.rest_when_still else phase}


class MisreadContext(LeggedContext):
  """A step in which ids of the contact sensors are taken for the addresses of their readings (H1).

  The readings are the base's height and the directions of its axes.
  """

  @property
  def contact(self) -> jax.Array:  # pyright: ignore[reportIncompatibleVariableOverride]
    model = self.env.mj_model
    ids = [[model.sensor(name).id for name in foot] for foot in self.env.config.robot.foot_contact]
    return jnp.stack([(self.data.sensordata[np.array(foot)] > 0).any() for foot in ids])


class H1Joystick(Joystick):
  """The H1's tasks, which misread the contact of its feet in their steps, not at reset."""

  def post_step(self, data: Any, info: Any, action: jax.Array) -> Any:
    stepping: Any = copy.copy(self)
    stepping.context = MisreadContext
    return super(H1Joystick, stepping).post_step(data, info, action)


class Footstand(Stand):
  """The legs that must not touch the floor are the first two, the front ones, in a footstand, too."""

  def watched_feet(self, config: Any) -> list[str]:
    return list(config.robot.feet)[:2]
