"""Put a peg into a socket, one in each hand."""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from playground.envs.base import State
from playground.envs.manipulation.bimanual import Bimanual
from playground.envs.manipulation.tabletop import Terms, is_finite, outside
from playground.envs.physics import PhysicsData
from playground.mdp.tolerance import tolerance

_SOCKET, _PEG = slice(16, 18), slice(23, 25)  # their x and y in qpos
_SPREAD = 0.1  # m, uniform in +-
_SOCKET_GOAL, _PEG_GOAL = (-0.05, 0.0, 0.15), (0.05, 0.0, 0.15)  # m, where the two meet
_IN_LINE = 0.005  # m off the socket's axis, within which the peg slides in


class SinglePegInsertion(Bimanual):
  """The left arm takes the socket, the right one the peg; they meet in the air, and the peg goes in.

  (Paper, Appendix C.1.) `socket_entrance_reward` and `peg_end2_reward` are, as in Playground 0.2.0, of the bodies'
  centres, not of the sites that they are called after. Differences from it: those of `Bimanual`.

  Metrics of an evaluation: `success` is whether the peg's end is within `success_distance` of the socket's middle and
  in line with it when the episode ends, `position_error_cm` how far it is then.
  """

  summaries: ClassVar[Mapping[str, str]] = {**Bimanual.summaries, "peg_end2_dist_to_line": "last"}

  def __init__(self, config: Any):
    """Builds the scene; `config`: see `configs/env/AlohaSinglePegInsertion.yaml`."""
    super().__init__(config, "peg_insertion")

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    parts = {"qpos": self.mj_model.nq, "qvel": self.mj_model.nv}
    places = ("left_gripper", "socket", "right_gripper", "peg", "socket_entrance", "peg_end2", "socket_up", "peg_up")
    return {"state": parts | dict.fromkeys(places, 3)}

  def _start(self, rng: jax.Array) -> tuple[jax.Array, dict[str, jax.Array], dict[str, Any]]:
    rng, peg_key, socket_key = jax.random.split(rng, 3)
    peg, socket = (jax.random.uniform(key, (2,), minval=-_SPREAD, maxval=_SPREAD) for key in (peg_key, socket_key))
    return rng, {"qpos": self._home_qpos.at[_PEG].add(peg).at[_SOCKET].add(socket)}, {}

  def evaluate(self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array) -> State:
    reward, rewards = self._weighted(data)
    out_of_bounds = outside(self._body(data, "socket")) | outside(self._body(data, "peg"))
    depth, off_line = self._misalignment(data)
    metrics = {
      "peg_end2_dist_to_line": off_line,
      "out_of_bounds": out_of_bounds.astype(jnp.float32),
      "success": ((depth < self._success_distance) & (off_line < _IN_LINE)).astype(jnp.float32),
      "position_error_cm": 100 * depth,
    }
    done = (out_of_bounds | ~is_finite(data)).astype(jnp.float32)
    return State(data, self._observe(data), reward, done, rewards | metrics, dict(info))

  def _misalignment(self, data: PhysicsData) -> tuple[jax.Array, jax.Array]:
    """How far the peg's end is from the socket's middle, and how far from its axis, m."""
    rear, end = self._site(data, "socket_rear"), self._site(data, "peg_end2")
    axis = self._site(data, "socket_entrance") - rear
    along = (end - rear) @ axis / (axis @ axis + 1e-6)
    return jnp.linalg.norm(end - rear), jnp.linalg.norm(end - rear - along * axis)

  def _terms(self, data: PhysicsData) -> Terms:
    socket, peg = self._body(data, "socket"), self._body(data, "peg")
    near = lambda gap, reach, margin: tolerance(jnp.linalg.norm(gap), (0.0, reach), margin, "linear")
    left = near(socket - self._site(data, "left/gripper"), 0.001, 0.3)
    right = near(peg - self._site(data, "right/gripper"), 0.001, 0.3)
    at_home = {
      side: tolerance(jnp.linalg.norm(data.qpos[arm] - self._home_qpos[arm]), (0.0, 0.01), 2.0)
      for side, arm in self._arms.items()
    }
    socket_at = near(jnp.array(_SOCKET_GOAL) - socket, 0.01, 0.15)
    peg_at = near(jnp.array(_PEG_GOAL) - peg, 0.01, 0.15)
    upright = lambda name: tolerance(self._axes(data, name)[2, 2], (0.99, 1.0), 0.03, "linear")
    depth, off_line = self._misalignment(data)
    return {
      "left_reward": left,
      "right_reward": right,
      "left_target_qpos": at_home["left"] * left * right,
      "right_target_qpos": at_home["right"] * left * right,
      "no_table_collision": self._no_table_collision(data),
      "socket_entrance_reward": socket_at,
      "peg_end2_reward": peg_at,
      "socket_z_up": upright("socket") * socket_at,
      "peg_z_up": upright("peg") * peg_at,
      "peg_insertion_reward": tolerance(depth, (0.0, 0.001), 0.1, "linear") * (off_line < _IN_LINE),
    }

  def _observe(self, data: PhysicsData) -> jax.Array:
    parts = [data.qpos, data.qvel, self._site(data, "left/gripper"), self._body(data, "socket")]
    parts += [self._site(data, "right/gripper"), self._body(data, "peg")]
    parts += [self._site(data, "socket_entrance"), self._site(data, "peg_end2")]
    return jnp.concatenate([*parts, self._axes(data, "socket")[2], self._axes(data, "peg")[2]])
