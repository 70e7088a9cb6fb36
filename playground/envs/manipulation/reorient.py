"""Turn a cube in the hand to one orientation after another."""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from mujoco.mjx._src.math import quat_integrate

from playground.envs.base import State
from playground.envs.manipulation.in_hand import InHand
from playground.envs.physics import PhysicsData, mjx
from playground.mdp.hand_rewards import position_error, rotation_error
from playground.mdp.hands import Context
from playground.mdp.pushes import Wrenches
from playground.mdp.rotations import uniform_quat

_SPIN = (1.0, 5.0)  # rad/s about each axis: how fast a new goal turns away from the last
_SLOWER = 0.8  # factor on the spin in each step
_TURN = 2.0  # control steps' worth of turning in each step


class Reorient(InHand):
  """Turns the cube to the goal's orientation, again and again (paper, Section IV-C.1 and Appendix C.4).

  Within `success_threshold` of the goal the task pays `success_reward`, and the goal turns on: it spins, slower and
  slower, to another orientation. Its motion is that of Playground 0.2.0; the paper says only that a new goal is at
  least 90 degrees from the last.

  The defaults differ from Playground 0.2.0 as in `InHand`, and as follows; `env.parity=true` has its ways:
  - a goal turns by at least `goal.min_turn` (0.2.0: mostly, but as little as 50 degrees);
  - the tracked cube is turned by at most `noise.pose.angle` rad, as in the paper (0.2.0 adds that much noise to each
    entry of the quaternion: about three times the angle);
  - the strengths of a push's force and torque are independent (0.2.0: one draw).

  Metrics of an evaluation: `rotations` is the number of goals reached before failure, the cube dropped or no goal
  within `stuck_after` (the paper's real trials), `success` whether there was any; `rotation_error_deg` and
  `position_error_cm` are means over the episode.
  """

  summaries: ClassVar[Mapping[str, str]] = {
    "success": "max",
    "rotation_error_deg": "mean",
    "position_error_cm": "mean",
  }
  forgotten = (*InHand.forgotten, "goal_spin", "steps_since_success", "stuck")
  draws = (("goal",), *InHand.draws, Wrenches.keys)

  def __init__(self, config: Any):
    """Builds the task, as `InHand`, from `configs/env/LeapCubeReorient.yaml`."""
    super().__init__(config)
    self._goal_pos = jnp.array(self.mj_model.key("home").mpos)
    self._min_turn: float = 0.0 if self.parity else config.goal.min_turn
    self._threshold: float = config.success_threshold
    self._success_reward: float = config.success_reward
    self._stuck_steps = round(config.stuck_after / self.dt)
    pushes = {name: config.pushes[name] for name in ("enable", "velocity", "angular_velocity", "duration", "interval")}
    self._pushes = Wrenches(**pushes, root=self.hand.cube, dt=self.dt, parity=self.parity)

  def _start(self, keys: Mapping[str, jax.Array]) -> dict[str, jax.Array]:
    goal = {"mocap_pos": self._goal_pos[None], "mocap_quat": uniform_quat(keys["goal"])[None]}
    return super()._start(keys) | goal

  def _start_info(self, keys: Mapping[str, jax.Array], model: mjx.Model) -> dict[str, jax.Array]:
    own = {
      "goal_spin": jnp.zeros(3),
      "steps_since_success": jnp.zeros((), jnp.int32),
      "stuck": jnp.zeros((), bool),
    }
    return own | self._pushes.start(keys, self.hand.cube_mass(model))

  def disturb(self, state: State) -> State:
    state = super().disturb(state)
    data, changed = self._pushes.act(state.data, state.info)
    return state.replace(data=data, info=state.info | changed)

  def evaluate(self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array) -> State:
    state = super().evaluate(data, info, action)
    info = state.info
    success = rotation_error(self._context(data, info, action)) < self._threshold
    waited = jnp.where(success, 0, info["steps_since_success"] + 1)
    stuck = info["stuck"] | (waited > self._stuck_steps)
    rng, key = jax.random.split(info["rng"])
    spin = jnp.where(success, new_spin(key, self._min_turn, self.dt), _SLOWER * info["goal_spin"])
    goal = quat_integrate(data.mocap_quat[0], spin, jnp.array(_TURN * self.dt))
    reached = success.astype(jnp.float32)
    bonus = self._success_reward * reached
    return state.replace(
      data=data.replace(mocap_quat=goal[None]),
      reward=state.reward + bonus,
      metrics=state.metrics | {"reward/success": bonus, "success": reached, "rotations": reached * ~stuck},
      info=info | {"rng": rng, "goal_spin": spin, "steps_since_success": waited, "stuck": stuck},
    )

  def _measure(self, now: Context) -> dict[str, jax.Array]:
    return {
      "rotation_error_deg": jnp.rad2deg(rotation_error(now)),
      "position_error_cm": 100 * position_error(now),
    }


def new_spin(key: jax.Array, min_turn: float, dt: float) -> jax.Array:
  """A goal's angular velocity in its own frame right after it was reached, rad/s [3].

  Args:
    key: random key.
    min_turn: rad that it turns by in the end, at least.
    dt: control step, s.
  """
  low, high = _SPIN
  spin = jax.random.uniform(key, (3,), minval=low, maxval=high)
  turn = jnp.linalg.norm(spin) * _TURN * dt / (1 - _SLOWER)  # the axis stays: all steps' turns add up
  return spin * jnp.maximum(1.0, min_turn / turn)
