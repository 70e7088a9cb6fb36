"""A cube that the hand turns to one orientation after another."""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from mujoco.mjx._src.math import quat_integrate

from playground.envs.base import State
from playground.envs.manipulation.in_hand import HandTask
from playground.envs.task import InitialState
from playground.mdp.manipulators import HandContext
from playground.mdp.poses import uniform_quat
from playground.physics.backend import PhysicsData, mjx

_BONUS = "success"  # the reward term that is not times dt
_SPIN = (1.0, 5.0)  # rad/s about each axis: how fast a new goal turns away from the last
_SLOWER = 0.8  # factor on the spin in each step
_TURN = 2.0  # control steps' worth of turning in each step


class Reorient(HandTask):
  """Turns the cube to the goal's orientation, again and again (paper, Section IV-C.1 and Appendix C.4).

  Within `success_threshold` of the goal the task adds the reward term `success` once, not times `ctrl_dt`, and the goal
  turns on: it spins, slower and slower, to another orientation, at least `goal.min_turn` away. Its motion is that
  of Playground 0.2.0; the paper only states that a new goal is at least 90 degrees from the last.

  Metrics of an evaluation: `rotations` is the number of goals reached before failure, the cube dropped or no goal
  within `stuck_after` (the paper's real trials), `success_count` that of all goals reached, `success` whether there was
  any; `steps_since_last_success` is of the last step, `rotation_error_deg` and `position_error_cm` are means over the
  episode.
  """

  summaries: ClassVar[Mapping[str, str]] = {
    "success": "max",
    "success_count": "last",
    "steps_since_last_success": "last",
    "rotation_error_deg": "mean",
    "position_error_cm": "mean",
  }
  episode_info = ("goal_spin", "steps_since_success", "success_count", "stuck")

  def __init__(self, config: Any):
    """Builds the scene. `config`: see `configs/env/LeapCubeReorient.yaml`."""
    super().__init__(config)
    self._goal_pos = jnp.array(self.mj_model.key("home").mpos)
    self._stuck_steps = round(config.stuck_after / self.dt)

  def initial_state(self, key: jax.Array, model: mjx.Model) -> InitialState:
    initial = super().initial_state(key, model)
    return initial.replace(mocap_pos=self._goal_pos[None], mocap_quat=uniform_quat(key)[None])

  def first_info(self, data: PhysicsData, key: jax.Array, model: mjx.Model) -> dict[str, Any]:
    return super().first_info(data, key, model) | {
      "goal_spin": jnp.zeros(3),
      "steps_since_success": jnp.zeros((), jnp.int32),
      "success_count": jnp.zeros((), jnp.int32),
      "stuck": jnp.zeros((), bool),
    }

  def reached(self, c: HandContext) -> jax.Array:
    """Returns whether the cube is at the goal, bool."""
    return c.rotation_error < self.config.success_threshold

  def next_info(self, c: HandContext, key: jax.Array) -> dict[str, Any]:
    spin = jnp.where(self.reached(c), new_spin(key, self.config.goal.min_turn, self.dt), _SLOWER * c.info["goal_spin"])
    return self._counts(c) | {"goal_spin": spin}

  def _counts(self, c: HandContext) -> dict[str, jax.Array]:
    success = self.reached(c)
    waited = jnp.where(success, 0, c.info["steps_since_success"] + 1)
    return {
      "steps_since_success": waited,
      "success_count": c.info["success_count"] + success,
      "stuck": c.info["stuck"] | (waited > self._stuck_steps),
    }

  def post_step(self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array) -> State:
    state = super().post_step(data, info, action)
    goal = quat_integrate(data.mocap_quat[0], state.info["goal_spin"], jnp.array(_TURN * self.dt))
    return state.replace(data=data.replace(mocap_quat=goal[None]))

  def total(self, rewards: Mapping[str, jax.Array]) -> jax.Array:
    bonus = rewards.get(_BONUS, jnp.zeros(()))
    return super().total({**rewards, _BONUS: jnp.zeros(())}) + bonus

  def measure(self, c: HandContext) -> dict[str, jax.Array]:
    counts, reached = self._counts(c), success(c)
    return {
      "success": reached,
      "success_count": counts["success_count"].astype(jnp.float32),
      "steps_since_last_success": counts["steps_since_success"].astype(jnp.float32),
      "rotations": reached * ~counts["stuck"],
      "rotation_error_deg": jnp.rad2deg(c.rotation_error),
      "position_error_cm": 100 * c.position_error,
    }


def success(c: HandContext) -> jax.Array:
  """1 in a step in which the cube is within `env.success_threshold` of the goal's orientation."""
  return c.env.reached(c).astype(jnp.float32)


def new_spin(key: jax.Array, min_turn: float, dt: float) -> jax.Array:
  """Returns a goal's angular velocity in its own frame right after it was reached, rad/s [3].

  In the end the goal has turned by `min_turn` rad at least.
  """
  low, high = _SPIN
  spin = jax.random.uniform(key, (3,), minval=low, maxval=high)
  turn = jnp.linalg.norm(spin) * _TURN * dt / (1 - _SLOWER)  # the axis stays: all steps' turns add up
  return spin * jnp.maximum(1.0, min_turn / turn)
