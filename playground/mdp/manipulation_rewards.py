"""Reward terms of arms at a table and of hands with a cube, beside those of any robot in `rewards`.

Formulas are those of Playground 0.2.0 (paper, appendix "Manipulation" and C.4). A tolerance is 1 up to `bound` and
falls to 0.1 at `margin` beyond it, in the shape `sigmoid` (`playground.mdp.tolerance`). Terms with `tanh` or
`tolerance` in their names are within 0 and 1.
"""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from mujoco.mjx._src.math import normalize

from playground.limits import AtLeast0, Positive, Share, Vector
from playground.mdp.context import StepContext
from playground.mdp.manipulators import ArmContext, HandContext
from playground.mdp.tolerance import tolerance


def object_gripper_distance_tanh(c: ArmContext, std: Positive) -> jax.Array:
  """1 - tanh(d / std), d from the gripper's tip to the object's centre, m. (Paper, appendix "Manipulation".)"""
  return 1 - jnp.tanh(jnp.linalg.norm(c.object_pos - c.gripper_pos) / std)


def object_goal_distance_tanh(c: ArmContext, std: Positive, turn_weight: Share = 0.0) -> jax.Array:
  """1 - tanh(d / std) once the gripper has reached the object in this episode, else 0.

  d = (1 - turn_weight) * distance from object to goal, m, + turn_weight * |first two rows of R_goal - R_object|.
  """
  distance = (1 - turn_weight) * jnp.linalg.norm(c.object_to_goal)
  if turn_weight:
    distance += turn_weight * jnp.linalg.norm(c.goal_axes_error)
  return (1 - jnp.tanh(distance / std)) * c.reached


def object_goal_distance_xy_tolerance(c: ArmContext, bound: AtLeast0, margin: AtLeast0, sigmoid: str) -> jax.Array:
  """Tolerance of the horizontal distance from object to goal, m."""
  return tolerance(jnp.linalg.norm(c.object_to_goal[:2]), (0.0, bound), margin, sigmoid)


def object_goal_angle_tolerance(c: ArmContext, bound: AtLeast0, margin: AtLeast0, sigmoid: str) -> jax.Array:
  """Tolerance of the angle between object and goal, rad."""
  return tolerance(c.goal_angle, (0.0, bound), margin, sigmoid)


def gripper_behind_object_tolerance(
  c: ArmContext, behind: float, bound: AtLeast0, margin: AtLeast0, sigmoid: str
) -> jax.Array:
  """Tolerance of the gripper's distance, m, from a point `behind` m behind the object as seen from the goal."""
  away = -c.object_to_goal
  place = c.object_pos + behind * normalize(away) * (jnp.linalg.norm(away) > 1e-3)
  return tolerance(jnp.linalg.norm(place - c.gripper_pos), (0.0, bound), margin, sigmoid)


def object_lifted(c: ArmContext, height: float) -> jax.Array:
  """1 while the object's centre is above `height` m."""
  return (c.object_pos[2] > height).astype(jnp.float32)


def object_at_goal(c: ArmContext) -> jax.Array:
  """1 while the object is at the goal, as `env.success_distance` and the like say."""
  return c.at_goal.astype(jnp.float32)


def goal_reached(c: ArmContext) -> jax.Array:
  """1 in a step in which a goal counts as reached (task PushCube)."""
  return c.env.goal_reached(c).astype(jnp.float32)  # pyright: ignore[reportAttributeAccessIssue]


def body_position_tolerance(c: ArmContext, body: str, position: Vector, bound: AtLeast0, margin: AtLeast0) -> jax.Array:
  """Linear tolerance of a body's distance from a position, m."""
  return tolerance(jnp.linalg.norm(jnp.array(position) - c.body_pos(body)), (0.0, bound), margin, "linear")


def body_upright_at_position(
  c: ArmContext, body: str, position: Vector, bound: AtLeast0, margin: AtLeast0
) -> jax.Array:
  """`body_position_tolerance` times a linear tolerance of the cosine of the body's tilt (1 from 0.99 on)."""
  upright = tolerance(c.body_axes(body)[2, 2], (0.99, 1.0), 0.03, "linear")
  return upright * body_position_tolerance(c, body, position, bound, margin)


def site_body_distance_tolerance(c: ArmContext, site: str, body: str, bound: AtLeast0, margin: AtLeast0) -> jax.Array:
  """Linear tolerance of the distance between a site and a body's centre, m."""
  return tolerance(jnp.linalg.norm(c.body_pos(body) - c.site_pos(site)), (0.0, bound), margin, "linear")


def no_contact(c: ArmContext, geom: str) -> jax.Array:
  """1 while none of the contact sensors of a geom (`floor`, `table`, ...) sees a contact."""
  return 1 - c.robot.touching(c.data, geom).any().astype(jnp.float32)


def contact_normal_horizontal(c: ArmContext) -> jax.Array:
  """|e_z x n|, n the mean normal of the fingers' contacts with the object: 1 for pushing from the side."""
  normal = normalize(c.data.sensordata[:18].reshape(6, 3).mean(axis=0))
  return jnp.linalg.norm(jnp.cross(jnp.array([0.0, 0.0, 1.0]), normal))


def joint_deviation_tanh(c: ArmContext, joints: str | Sequence[str] = ".*") -> jax.Array:
  """1 - tanh(|q - default|), of the arms' joints, rad."""
  return 1 - jnp.tanh(jnp.linalg.norm(c.joint_pos_rel[c.robot.find_joints(joints)]))


def joint_deviation_tolerance(
  c: ArmContext, bound: AtLeast0, margin: AtLeast0, sigmoid: str, joints: str | Sequence[str] = ".*"
) -> jax.Array:
  """Tolerance of |q - default|, of the arms' joints, rad."""
  return tolerance(jnp.linalg.norm(c.joint_pos_rel[c.robot.find_joints(joints)]), (0.0, bound), margin, sigmoid)


def joint_vel_tolerance(c: ArmContext, bound: AtLeast0, margin: AtLeast0, sigmoid: str) -> jax.Array:
  """Tolerance of |qd|, of the arms' joints, rad/s."""
  return tolerance(jnp.linalg.norm(c.joint_vel), (0.0, bound), margin, sigmoid)


def joint_vel_within_limits(c: ArmContext, limits: Sequence[float]) -> jax.Array:
  """1 while no joint is faster than its limit, rad/s."""
  return 1 - (jnp.abs(c.joint_vel) > jnp.array(limits)).any().astype(jnp.float32)


def action_norm(c: StepContext) -> jax.Array:
  """|action|."""
  return jnp.linalg.norm(c.action)


def action_rate_norm(c: StepContext) -> jax.Array:
  """|action - last action|."""
  return jnp.linalg.norm(c.action - c.last_act)


def no_ik_solution(c: ArmContext) -> jax.Array:
  """1 where the arm cannot go where the action sends it (task PickCubeCartesian)."""
  return c.carried("no_solution")


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
