"""Reward terms of legged robots, and how they are chosen, weighed and added up.

A term is a function of a `Context` and of the keys of `env.reward` that its keyword arguments name; a new one is a
function here (the base's motion), in `joints.py`, `feet.py` or `stances.py`, and a weight in `env.reward.scales`. A
weight's name is the function's, unless `env.reward.functions` names another: tasks share names such as `orientation`
(and so what is logged) and mean different things. Formulas are those of Playground 0.2.0, on which the published
weights were tuned; where the paper (appendix "Locomotion", reward functions) writes another, the term says so.
"""

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from playground.errors import ConfigError, nearest
from playground.mdp.feet import FEET
from playground.mdp.joints import JOINTS
from playground.mdp.legged import Context
from playground.mdp.lookup import lookup
from playground.mdp.stances import STANCES

Term = Callable[[Any], jax.Array]  # of the present moment: a `Context`, of a robot on legs or of a hand

# The reward from the sums of weighted terms of positive and of negative weight; times the control step.
TOTALS: dict[str, Callable[[jax.Array, jax.Array], jax.Array]] = {
  "sum": lambda gain, cost: gain + cost,
  "product": lambda gain, cost: gain * jnp.exp(0.2 * cost),
}


def bind(
  config: Any,
  functions: Mapping[str, Callable[..., jax.Array]],
  *,
  parity: bool = False,
  facts: Mapping[str, Any] | None = None,
) -> dict[str, tuple[float, Term]]:
  """Chooses and parametrises terms.

  Args:
    config: `env.reward`: `scales` (weight by name), the terms' parameters; where terms are not the functions of their
      names `functions` and `parity_functions` (function's name by term), and where they do not always count
      `when_moving` and `when_still` (norm of the command by term: above, or below, it the term counts, else it is 0).
    functions: the functions to choose from, by name.
    parity: whether `parity_functions` replace others and their conditions: Playground 0.2.0's slips.
    facts: parameters that are not in `config`, by name.

  Returns:
    (weight, term) by name, without those of weight 0.

  Raises:
    UnknownNameError: a weight for a term that does not exist, or a function that does not.
    ConfigError: a term's parameter is missing.
  """
  facts = facts or {}
  chosen = {name: name for name in config.scales}
  for key, counts in (("functions", True), ("parity_functions", parity)):
    for name, function in dict(config.get(key, {})).items():
      lookup(chosen, name, f"env.reward.{key}")
      lookup(functions, function, f"env.reward.{key}.{name}")
      chosen[name] = function if counts else chosen[name]
  slips = set(config.get("parity_functions", {})) if parity else set()  # bring conditions of their own
  gates = {key: dict(config.get(key, {})) for key in ("when_moving", "when_still")}
  for key, gated in gates.items():
    for name in gated:
      lookup(chosen, name, f"env.reward.{key}")
  bound = {}
  for name in config.scales:
    function = lookup(functions, chosen[name], "env.reward.scales")
    parameters = {}
    for parameter in list(inspect.signature(function).parameters)[1:]:
      if parameter not in facts and parameter not in config:
        raise ConfigError(f"env.reward.{parameter} is missing: term {name!r} needs it.{nearest(parameter, config)}")
      parameters[parameter] = facts[parameter] if parameter in facts else config[parameter]
    bounds = (None if name in slips else gates[key].get(name) for key in ("when_moving", "when_still"))
    bound[name] = (config.scales[name], _term(function, parameters, *bounds))
  return {name: (weight, term) for name, (weight, term) in bound.items() if weight != 0}


def _term(
  function: Callable[..., jax.Array], parameters: dict[str, Any], above: float | None, below: float | None
) -> Term:
  def term(c: Context) -> jax.Array:
    value = function(c, **parameters)
    value = value if above is None else value * (c.commanded_speed > above)
    return value if below is None else value * (c.commanded_speed < below)

  return term


def tracking_lin_vel(c: Context, tracking_sigma: float) -> jax.Array:
  """exp(-|command_xy - v_xy|² / sigma), v the base's velocity in its own frame."""
  error = jnp.square(c.command[:2] - c.sensor("linvel")[:2]).sum()
  return jnp.exp(-error / tracking_sigma)


def tracking_ang_vel(c: Context, tracking_sigma: float) -> jax.Array:
  """exp(-(command_yaw - w_z)² / sigma), w the gyro's reading."""
  return jnp.exp(-jnp.square(c.command[2] - c.sensor("gyro")[2]) / tracking_sigma)


def tracking(c: Context, tracking_sigma: float) -> jax.Array:
  """`tracking_lin_vel` + 0.5 `tracking_ang_vel`."""
  return tracking_lin_vel(c, tracking_sigma) + 0.5 * tracking_ang_vel(c, tracking_sigma)


def lin_vel_z(c: Context) -> jax.Array:
  """v_z², v the base's velocity in the world frame."""
  return jnp.square(c.sensor("global_linvel")[2])


def lin_vel_z_local(c: Context) -> jax.Array:
  """v_z², v the base's velocity in its own frame."""
  return jnp.square(c.sensor("linvel")[2])


def lin_vel_z_with_torso(c: Context) -> jax.Array:
  """v_z² of the base plus that of the torso, in the world frame."""
  return lin_vel_z(c) + jnp.square(c.sensor("torso_linvel")[2])


def lin_vel_z_in_level_gaits(c: Context, level_gaits: Sequence[str], gait_modes: Sequence[str]) -> jax.Array:
  """As `lin_vel_z`, in the gaits whose base should stay level; 0 in those in which it flies."""
  level = jnp.array([mode in level_gaits for mode in gait_modes])
  return lin_vel_z(c) * level[c.kept("gait")]


def lin_vel_z_in_other_gaits(c: Context, level_gaits: Sequence[str], gait_modes: Sequence[str]) -> jax.Array:
  """As `lin_vel_z`, in the other gaits only: a slip of Playground 0.2.0's Spot."""
  return lin_vel_z(c) - lin_vel_z_in_level_gaits(c, level_gaits, gait_modes)


def lin_vel_xy(c: Context) -> jax.Array:
  """v_x² + v_y², v the base's velocity in the world frame."""
  return jnp.square(c.sensor("global_linvel")[:2]).sum()


def ang_vel(c: Context) -> jax.Array:
  """|w|², w the base's angular velocity."""
  return jnp.square(c.sensor("global_angvel")).sum()


def ang_vel_xy(c: Context) -> jax.Array:
  """w_x² + w_y², w the base's angular velocity in the world frame."""
  return jnp.square(c.sensor("global_angvel")[:2]).sum()


def ang_vel_xy_local(c: Context) -> jax.Array:
  """w_x² + w_y², w the gyro's reading."""
  return jnp.square(c.sensor("gyro")[:2]).sum()


def ang_vel_xy_of_torso(c: Context) -> jax.Array:
  """w_x² + w_y², w the torso's angular velocity in the world frame."""
  return jnp.square(c.sensor("torso_angvel")[:2]).sum()


def orientation(c: Context) -> jax.Array:
  """up_x² + up_y², up the base's upward axis in the world frame."""
  return jnp.square(c.sensor("upvector")[:2]).sum()


def orientation_as(c: Context, upvector_target: Sequence[float]) -> jax.Array:
  """|up - target|², up the base's upward axis in the world frame. (Paper: `orientation`.)"""
  return jnp.square(c.sensor("upvector") - jnp.array(upvector_target)).sum()


def base_height(c: Context, base_height_target: float) -> jax.Array:
  """(z - target)², z the root joint's, world frame."""
  return jnp.square(c.data.qpos[2] - base_height_target)


def collision(c: Context) -> jax.Array:
  """1 while the robot's parts touch each other as its `self_contact` lists."""
  return c.robot.touching(c.data, "self_contact").any().astype(jnp.float32)


def alive(c: Context) -> jax.Array:
  """1 in every step."""
  del c
  return jnp.ones(())


def alive_until_done(c: Context) -> jax.Array:
  """1 in every step but the one that terminates the episode."""
  return 1.0 - termination(c)


def termination(c: Context) -> jax.Array:
  """1 in the step that terminates the episode."""
  return c.done.astype(jnp.float32)


def termination_early(c: Context) -> jax.Array:
  """As `termination`, in the first 500 steps of a command (not of an episode): a slip of 0.2.0's Barkour and OP3."""
  return termination(c) * (c.kept("step") < 500)


_BASE = (
  tracking_lin_vel, tracking_ang_vel, tracking, lin_vel_z, lin_vel_z_local, lin_vel_z_with_torso,
  lin_vel_z_in_level_gaits, lin_vel_z_in_other_gaits, lin_vel_xy, ang_vel, ang_vel_xy, ang_vel_xy_local,
  ang_vel_xy_of_torso, orientation, orientation_as, base_height, collision, alive, alive_until_done, termination,
  termination_early,
)  # fmt: skip
REWARDS: dict[str, Callable[..., jax.Array]] = {f.__name__: f for f in _BASE} | JOINTS | FEET | STANCES
