"""Reward terms.

Formulas are those of Playground 0.2.0, on which the published weights were tuned; where the paper (appendices
"Locomotion", "Manipulation" and C.4) writes another, the term says so. Sensors, site poses and actuator forces are one
physics step older than `qpos` and `qvel`, as MuJoCo leaves them. Heights are the world's, on any terrain. Up is the
base's upward axis in the world frame. A frame is chosen by the sensor that is read: `linvel` and `gyro` are in the
base's frame, `global_linvel` and `global_angvel` in the world frame.
"""

import math
from collections.abc import Sequence
from typing import Annotated

import jax
import jax.numpy as jnp
from mujoco.mjx._src.math import normalize

from playground.errors import ConfigError
from playground.limits import AtLeast0, Positive, Share, Vector, positive
from playground.mdp.context import StepContext, root_qpos
from playground.mdp.legged import LeggedContext, swing_height
from playground.mdp.manipulators import ArmContext, HandContext
from playground.mdp.tolerance import tolerance

# Any robot.


def is_terminated(c: StepContext) -> jax.Array:
  """1 in the step that terminates the episode."""
  return c.terminated.astype(jnp.float32)


def is_alive(c: StepContext) -> jax.Array:
  """1 in every step but the one that terminates the episode."""
  return 1.0 - is_terminated(c)


def constant(c: StepContext) -> jax.Array:
  """1 in every step."""
  return jnp.ones(())


def action_l2(c: StepContext) -> jax.Array:
  """|action|²."""
  return jnp.square(c.action).sum()


def action_rate_l2(c: StepContext) -> jax.Array:
  """|action - last action|²."""
  return jnp.square(c.action - c.last_act).sum()


def action_norm(c: StepContext) -> jax.Array:
  """|action|."""
  return jnp.linalg.norm(c.action)


def action_rate_norm(c: StepContext) -> jax.Array:
  """|action - last action|."""
  return jnp.linalg.norm(c.action - c.last_act)


def action_smoothness_l2(c: StepContext) -> jax.Array:
  """|a - a1|² + |a - 2 a1 + a2|², a1 and a2 the last action and the one before: first and second difference."""
  second = c.action - 2 * c.last_act + c.action_before_last
  return action_rate_l2(c) + jnp.square(second).sum()


def joint_pos_limits(c: StepContext, soft_limit_factor: Annotated[float, positive(1)]) -> jax.Array:
  """Sum over joints of how far q lies outside the soft limits: the range shrunk about its centre by the factor."""
  lower, upper = c.robot.joint_range
  centre, reach = (lower + upper) / 2, (upper - lower) / 2 * soft_limit_factor
  below, above = centre - reach - c.joint_pos, c.joint_pos - (centre + reach)
  return (jnp.maximum(below, 0) + jnp.maximum(above, 0)).sum()


def joint_deviation_l1(c: StepContext, joints: str | Sequence[str] = ".*") -> jax.Array:
  """Sum |q - default| over the joints. (Paper: `stand_still`, k |command_xy|.)

  `joints` are a group of the robot's YAML (`hips`, `knees`), a regular expression of joint names, or several.
  """
  return jnp.abs(c.joint_pos_rel[c.robot.find_joints(joints)]).sum()


def joint_deviation_l2(c: StepContext, joints: str | Sequence[str] = ".*") -> jax.Array:
  """Sum (q - default)² over the joints; see `joint_deviation_l1`."""
  return jnp.square(c.joint_pos_rel[c.robot.find_joints(joints)]).sum()


def joint_torques_l1(c: StepContext) -> jax.Array:
  """|tau|_1, tau the actuators' forces. (Paper: |tau|².)"""
  return jnp.abs(c.data.actuator_force).sum()


def joint_torques_l2(c: StepContext) -> jax.Array:
  """|tau|², tau the actuators' forces."""
  return jnp.square(c.data.actuator_force).sum()


def joint_torques_norms(c: StepContext) -> jax.Array:
  """|tau|_2 + |tau|_1, tau the actuators' forces. (Paper: |tau|².)"""
  return jnp.linalg.norm(c.data.actuator_force) + joint_torques_l1(c)


def joint_power_l1(c: StepContext) -> jax.Array:
  """Sum |qd_j| |tau_j|, W, of a robot that has an actuator for each joint. (Paper: |qd * tau|.)"""
  return (jnp.abs(c.joint_vel) * jnp.abs(c.data.actuator_force)).sum()


def joint_acc_l2(c: StepContext) -> jax.Array:
  """|qdd|², of the joints."""
  return jnp.square(c.data.qacc[c.robot.qvel]).sum()


def joint_vel_l2(c: StepContext) -> jax.Array:
  """|qd|², of the joints."""
  return jnp.square(c.joint_vel).sum()


def joint_vel_limits_l2(c: StepContext, limit: AtLeast0) -> jax.Array:
  """Sum max(|qd_j| - limit, 0)², rad²/s²."""
  return jnp.square(jnp.maximum(jnp.abs(c.joint_vel) - limit, 0.0)).sum()


# Robots on legs: the base.


def track_linear_velocity_exp(c: LeggedContext, std: Positive) -> jax.Array:
  """exp(-|command_xy - v_xy|² / std²), v the base's velocity in its own frame."""
  error = jnp.square(c.command[:2] - c.sensor("linvel")[:2]).sum()
  return jnp.exp(-error / std**2)


def track_angular_velocity_exp(c: LeggedContext, std: Positive) -> jax.Array:
  """exp(-(command_yaw - w_z)² / std²), w the gyro's reading."""
  return jnp.exp(-jnp.square(c.command[2] - c.sensor("gyro")[2]) / std**2)


def lin_vel_z_l2(c: LeggedContext, sensors: Sequence[str] = ("global_linvel",)) -> jax.Array:
  """Sum over the sensors of v_z²."""
  return sum((jnp.square(c.sensor(name)[2]) for name in sensors), jnp.zeros(()))


def lin_vel_z_l2_in_gaits(c: LeggedContext, gaits: Sequence[str]) -> jax.Array:
  """v_z² in the world frame in episodes with one of these gaits; 0 in other gaits, which have a flight phase."""
  command = c.env.config.commands.get("gait")
  if command is None:
    raise ConfigError("it needs env.commands.gait, which draws the gait of an episode.")
  for name in gaits:
    c.robot.gait(name, "params.gaits")
  level = jnp.array([mode in gaits for mode in command.params.modes])
  return lin_vel_z_l2(c) * level[c.info["gait"]]


def lin_vel_xy_l2(c: LeggedContext) -> jax.Array:
  """v_x² + v_y² in the world frame."""
  return jnp.square(c.sensor("global_linvel")[:2]).sum()


def ang_vel_l2(c: LeggedContext) -> jax.Array:
  """|w|², w the base's angular velocity."""
  return jnp.square(c.sensor("global_angvel")).sum()


def ang_vel_xy_l2(c: LeggedContext, sensor: str = "global_angvel") -> jax.Array:
  """w_x² + w_y² of the sensor's reading."""
  return jnp.square(c.sensor(sensor)[:2]).sum()


def flat_orientation_l2(c: LeggedContext) -> jax.Array:
  """up_x² + up_y²."""
  return jnp.square(c.sensor("upvector")[:2]).sum()


def orientation_l2(c: LeggedContext, target: Vector) -> jax.Array:
  """|up - target|². (Paper: `orientation`.)"""
  return jnp.square(c.sensor("upvector") - jnp.array(target)).sum()


def upright_exp(c: LeggedContext) -> jax.Array:
  """exp(-2 |up - e_z|²)."""
  return jnp.exp(-2 * _tilt(c))


def forward_alignment(c: LeggedContext, target: Vector) -> jax.Array:
  """((x · target + 1) / 2)², x the base's forward axis in the world frame."""
  return jnp.square(0.5 * c.forward @ jnp.array(target) + 0.5)


def base_height_l2(c: LeggedContext, target: float) -> jax.Array:
  """(z - target)², z of the root joint, m²."""
  return jnp.square(root_qpos(c)[2] - target)


def base_height_exp(c: LeggedContext, target: float) -> jax.Array:
  """exp(min(h, target) - target), h the height of the base site, m."""
  return jnp.exp(jnp.minimum(c.base_height, target) - target)


def base_height_expm1(c: LeggedContext, target: float) -> jax.Array:
  """exp(min(h, target)) - 1, h the height of the base site, m."""
  return jnp.exp(jnp.minimum(c.base_height, target)) - 1


def root_height_ratio(c: LeggedContext, target: Positive) -> jax.Array:
  """z / target of the root joint, within 0 and 1."""
  return jnp.clip(root_qpos(c)[2] / target, 0.0, 1.0)


def self_contact(c: LeggedContext) -> jax.Array:
  """1 while the robot's parts touch each other as `self_contact` of its YAML lists."""
  return c.robot.touching(c.data, "self_contact").any().astype(jnp.float32)


# Robots on legs: the pose.


def pose_l2(c: LeggedContext) -> jax.Array:
  """Sum_j weight_j (q_j - default_j)², the weights `pose_weights` of the robot's YAML. (Paper: without weights.)"""
  return (jnp.square(c.joint_pos_rel) * c.robot.pose_weights).sum()


def pose_exp(c: LeggedContext) -> jax.Array:
  """exp(-`pose_l2`)."""
  return jnp.exp(-pose_l2(c))


def pose_l2_by_command(c: LeggedContext) -> jax.Array:
  """As `pose_l2`; all joints weigh 1 while standing still; hip rolls weigh 0.01 above 0.3 m/s sideways, else 1.

  (Playground 0.2.0, Apollo.)
  """
  weights = jnp.where(c.still, 1.0, c.robot.pose_weights)
  rolls = jnp.where(jnp.abs(c.command[1]) > 0.3, 0.01, 1.0)
  weights = weights.at[c.robot.find_joints("hip_rolls")].set(rolls)
  return (jnp.square(c.joint_pos_rel) * weights).sum()


def pose_exp_when_still(c: LeggedContext, sharpness: Positive) -> jax.Array:
  """exp(-sharpness |q - default|²) while the command asks to stand still, else 1."""
  return jnp.exp(-sharpness * jnp.square(c.joint_pos_rel).sum() * c.still)


def pose_exp_when_upright(c: LeggedContext, tilt: Positive) -> jax.Array:
  """exp(-|q - default|² / 2) while |up - e_z|² < tilt, else 0."""
  return jnp.exp(-0.5 * jnp.square(c.joint_pos_rel).sum()) * (_tilt(c) < tilt)


def hip_deviation_l1(c: LeggedContext, sideways: AtLeast0 = 0.1) -> jax.Array:
  """Sum |q - default| over the robot's `hips`; `hip_rolls` are free while |command_y| > sideways, m/s."""
  rolls = joint_deviation_l1(c, "hip_rolls")
  return joint_deviation_l1(c, "hips") - rolls * (jnp.abs(c.command[1]) > sideways)


def action_exp_when_up(c: LeggedContext, tilt: Positive, height: float) -> jax.Array:
  """exp(-|action|² / 2) while |up - e_z|² < tilt and the base site is above `height` m, else 0: once up, stay."""
  return _action_exp(c, c.base_height, tilt, height)


def action_exp_when_root_up(c: LeggedContext, tilt: Positive, height: float) -> jax.Array:
  """As `action_exp_when_up`, of the height of the root joint."""
  return _action_exp(c, root_qpos(c)[2], tilt, height)


def _action_exp(c: LeggedContext, z: jax.Array, tilt: Positive, height: float) -> jax.Array:
  return jnp.exp(-0.5 * jnp.square(c.action).sum()) * ((_tilt(c) < tilt) & (z > height))


def _tilt(c: LeggedContext) -> jax.Array:
  """|up - e_z|², from 0 (upright) to 4 (upside down)."""
  return jnp.square(c.sensor("upvector") - jnp.array([0.0, 0.0, 1.0])).sum()


# Robots on legs: the feet.


def feet_clearance(c: LeggedContext, target: Positive) -> jax.Array:
  """Sum over feet of |z - target| sqrt(|v_xy|): a moving foot should be at swing height. (Paper: (z - target)².)"""
  speed = jnp.linalg.norm(c.feet_velocity[:, :2], axis=-1)
  return (jnp.abs(c.feet_height - target) * jnp.sqrt(speed)).sum()


def feet_swing_height_l2(c: LeggedContext, target: Positive) -> jax.Array:
  """Sum over feet that touch down of (peak / target - 1)², peak the highest z of the swing."""
  return (jnp.square(c.swing_peak / target - 1) * c.first_contact).sum()


def feet_slip_l2(c: LeggedContext) -> jax.Array:
  """Sum over feet in contact of |v_xy|²."""
  return (jnp.square(c.feet_velocity[:, :2]).sum(axis=-1) * c.contact).sum()


def base_speed_times_contacts(c: LeggedContext) -> jax.Array:
  """Number of feet in contact times |v_xy| of the base, world frame. (Paper: `feet_slip`.)"""
  return jnp.linalg.norm(c.sensor("global_linvel")[:2]) * c.contact.sum()


def feet_air_time(c: LeggedContext, threshold: AtLeast0, limit: AtLeast0 | None = None) -> jax.Array:
  """Sum over feet that touch down of air time - threshold, s, with a limit at most limit - threshold.

  (Paper: not below 0 either.)
  """
  time = (c.feet_air_time - threshold) * c.first_contact
  return (time if limit is None else jnp.minimum(time, limit - threshold)).sum()


def feet_phase_exp(c: LeggedContext, std: Positive, peak: Positive | None = None) -> jax.Array:
  """exp(-sum (z - swing height)² / std²), the swing height that of the foot's phase in the gait.

  `peak` is the highest swing, m; None is the `foot_height` that the gait command draws for an episode.
  """
  peaks = c.info["foot_height"] if peak is None else peak
  error = jnp.square(c.feet_height - swing_height(c.phase, peaks)).sum()
  return jnp.exp(-error / std**2)


def feet_phase_exp_unless_at_rest(c: LeggedContext, std: Positive, peak: Positive) -> jax.Array:
  """As `feet_phase_exp`; 0 when asked to stand still, unless the base moves or turns at more than 0.1 m/s or rad/s."""
  linvel, angvel = c.sensor("global_linvel"), c.sensor("global_angvel")
  moving = (jnp.linalg.norm(linvel[:2]) > 0.1) | (jnp.abs(angvel[2]) > 0.1) | ~c.still
  return feet_phase_exp(c, std, peak) * moving


def feet_distance(c: LeggedContext, minimum: AtLeast0) -> jax.Array:
  """minimum - d, m, within 0 and 0.1: d is how far the first two feet are apart sideways, seen along the heading."""
  apart = c.data.site_xpos[c.robot.feet[0]] - c.data.site_xpos[c.robot.feet[1]]
  heading = jnp.arctan2(c.forward[1], c.forward[0])
  sideways = jnp.abs(jnp.cos(heading) * apart[1] - jnp.sin(heading) * apart[0])
  return jnp.clip(minimum - sideways, 0.0, 0.1)


def feet_contact_force(c: LeggedContext, limit: AtLeast0) -> jax.Array:
  """Sum over feet of max(|F_z| - limit, 0), N, F the force between the foot and its leg."""
  vertical = jnp.abs(c.robot.foot_sensors(c.data, "foot_force")[:, 2])
  return jnp.maximum(vertical - limit, 0.0).sum()


def feet_contact(c: LeggedContext, feet: Sequence[str]) -> jax.Array:
  """1 while any of the feet touches the floor."""
  return c.contact[c.robot.find_feet(feet)].any().astype(jnp.float32)


# Arms at a table. A tolerance is 1 up to `bound` and falls to 0.1 at `margin` beyond it, in the shape `sigmoid`
# (`playground.mdp.tolerance`). Terms with `tanh` or `tolerance` in their names are within 0 and 1.


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
  """1 while the object is at the goal, by `env.success_distance` and `env.success_angle`."""
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
  """1 while none of the contact sensors of a geom (`floor`, `table`, ...) reports a contact."""
  return 1 - c.robot.touching(c.data, geom).any().astype(jnp.float32)


def contact_normal_horizontal(c: ArmContext) -> jax.Array:
  """|e_z x n|, n the mean normal of the fingers' contacts with the object: 1 for pushing from the side."""
  normal = normalize(c.robot.contact_normals(c.data).mean(axis=0))
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


def no_ik_solution(c: ArmContext) -> jax.Array:
  """1 where the arm cannot go where the action sends it (task PickCubeCartesian)."""
  return c.info["no_solution"]


# Hands with a cube.


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
  """Sum |qd_j| |tau_j|, W, tau the torques of the actuators at the joints, tendons included."""
  return (jnp.abs(c.joint_vel) * jnp.abs(c.data.qfrc_actuator[c.robot.qvel])).sum()
