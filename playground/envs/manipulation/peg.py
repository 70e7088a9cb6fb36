"""A peg that two arms put into a socket, one in each hand."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

import jax
import jax.numpy as jnp

from playground.envs.manipulation.arm import Bimanual
from playground.limits import AtLeast0
from playground.mdp.manipulators import ArmContext
from playground.mdp.rewards import joint_deviation_tolerance, site_body_distance_tolerance
from playground.mdp.tolerance import tolerance

_IN_LINE = 0.005  # m off the socket's axis, within which the peg slides in


class SinglePegInsertion(Bimanual):
  """The left arm takes the socket, the right one the peg; they meet in the air, and the peg goes in.

  (Paper, Appendix C.1.) Metrics of an evaluation: `success` is whether the peg's end is within `success_distance` of
  the socket's middle and in line with it when the episode ends, `position_error_cm` how far it is then.
  """

  summaries: ClassVar[Mapping[str, str]] = {"peg_end2_dist_to_line": "last"}

  def at_goal(self, c: ArmContext) -> jax.Array:
    depth, off_line = misalignment(c)
    return (depth < self.config.success_distance) & (off_line < _IN_LINE)

  def measure(self, c: ArmContext) -> dict[str, jax.Array]:
    depth, off_line = misalignment(c)
    return {
      "success": c.at_goal.astype(jnp.float32),
      "position_error_cm": 100 * depth,
      "peg_end2_dist_to_line": off_line,
    }


def misalignment(c: ArmContext) -> tuple[jax.Array, jax.Array]:
  """Returns how far the peg's end is from the socket's middle, and how far from its axis, m."""
  rear, end = c.site_pos("socket_rear"), c.site_pos("peg_end2")
  axis = c.site_pos("socket_entrance") - rear
  along = (end - rear) @ axis / (axis @ axis + 1e-6)
  return jnp.linalg.norm(end - rear), jnp.linalg.norm(end - rear - along * axis)


def arm_home_at_objects(c: ArmContext, joints: str | Sequence[str]) -> jax.Array:
  """Gaussian tolerance of |q - default| of some joints, rad, times how near both grippers are to socket and peg."""
  near = [
    site_body_distance_tolerance(c, f"{side}/gripper", body, 0.001, 0.3)
    for side, body in (("left", "socket"), ("right", "peg"))
  ]
  return joint_deviation_tolerance(c, 0.01, 2.0, "gaussian", joints) * near[0] * near[1]


def peg_inserted_tolerance(c: ArmContext, bound: AtLeast0, margin: AtLeast0) -> jax.Array:
  """Linear tolerance of the distance from the peg's end to the socket's middle, m; 0 where they are not in line."""
  depth, off_line = misalignment(c)
  return tolerance(depth, (0.0, bound), margin, "linear") * (off_line < _IN_LINE)
