"""Reward terms of a hand with a cube, beside those of any robot in `playground.mdp.rewards`.

Formulas are those of Playground 0.2.0 (paper, Appendix C.4).
"""

import math

import jax
import jax.numpy as jnp

from playground.mdp.context import StepContext
from playground.mdp.hands import HandContext
from playground.mdp.tolerance import tolerance


def cube_orientation_linear(c: HandContext, bound: float = 0.2) -> jax.Array:
  """1 while the angle between cube and goal is at most `bound` rad, falling linearly to 0.1 at pi rad beyond."""
  return tolerance(c.rotation_error, (0.0, bound), margin=math.pi, sigmoid="linear")


def cube_position_linear(c: HandContext, bound: float = 0.02, margin: float = 0.05) -> jax.Array:
  """1 while the cube is at most `bound` m from the palm, falling linearly to 0.1 at `margin` m beyond."""
  return tolerance(c.position_error, (0.0, bound), margin=margin, sigmoid="linear")


def cube_ang_vel_z(c: HandContext) -> jax.Array:
  """w_z, the cube's angular velocity about the world's z, with its sign."""
  return c.sensor("cube_angvel")[2]


def cube_lin_vel_l1(c: HandContext) -> jax.Array:
  """|v_x| + |v_y| + |v_z|, v the cube's world velocity."""
  return jnp.abs(c.sensor("cube_linvel")).sum()


def joint_power_qfrc_l1(c: StepContext) -> jax.Array:
  """Sum |qd_j| |tau_j|, W, tau what the actuators do at the joints, through tendons too."""
  return (jnp.abs(c.joint_vel) * jnp.abs(c.data.qfrc_actuator[c.robot.qvel])).sum()
