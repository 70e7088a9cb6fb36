"""Keys of earlier versions and of 0.2.0, and what stands in their place."""

from playground.errors import UnknownNameError

_REWARDS = {  # several names where it depends on the task
  "tracking_lin_vel": "track_linear_velocity_exp",
  "tracking_ang_vel": "track_angular_velocity_exp",
  "lin_vel_z": "lin_vel_z_l2",
  "lin_vel": "lin_vel_xy_l2",
  "ang_vel": "ang_vel_l2",
  "ang_vel_xy": "ang_vel_xy_l2",
  "orientation": "flat_orientation_l2 cube_orientation_linear",
  "base_height": "base_height_l2",
  "dof_pos_limits": "joint_pos_limits",
  "dof_acc": "joint_acc_l2",
  "dof_vel": "joint_vel_limits_l2",
  "hip_splay": "hip_deviation_l2",
  "joint_deviation_knee": "knee_deviation_l1",
  "joint_deviation_hip": "hip_deviation_l1",
  "torques": "joint_torques_norms joint_torques_l2",
  "energy": "joint_power_l1 joint_power_qfrc_l1",
  "action_rate": "action_rate_l2 action_smoothness_l2 action_rate_norm",
  "termination": "is_terminated",
  "alive": "constant",
  "collision": "self_contact",
  "feet_height": "feet_swing_height_l2",
  "feet_slip": "feet_slip_l2",
  "feet_phase": "feet_phase_exp",
  "contact_force": "feet_contact_force",
  "position": "cube_position_linear",
  "angvel": "cube_ang_vel_z",
  "linvel": "cube_lin_vel_l1",
  "hand_pose": "joint_deviation_l2",
  "gripper_box": "object_gripper_distance_tanh gripper_behind_object_tolerance grippers_at_box_exp",
  "box_target": "object_goal_distance_tanh object_goal_distance_xy_tolerance",
  "box_orientation": "object_goal_angle_tolerance",
  "box_handover": "box_at_meeting_exp",
  "handover_target": "box_at_goal_exp",
  "no_floor_collision": "no_contact",
  "no_barrier_collision": "no_contact",
  "no_table_collision": "no_contact",
  "robot_target_qpos": "joint_deviation_tanh joint_deviation_tolerance",
  "no_solution": "no_ik_solution",
  "lifted": "object_lifted",
  "success": "object_at_goal",
  "gripper_collision_side": "contact_normal_horizontal",
  "joint_vel": "joint_vel_tolerance",
  "joint_vel_limit": "joint_vel_within_limits",
  "total_command": "action_norm",
  "left_reward": "gripper_at_socket",
  "right_reward": "gripper_at_peg",
  "left_target_qpos": "left_arm_home",
  "right_target_qpos": "right_arm_home",
  "socket_z_up": "socket_upright",
  "peg_z_up": "peg_upright",
  "socket_entrance_reward": "socket_position",
  "peg_end2_reward": "peg_position",
  "peg_insertion_reward": "peg_inserted",
}
_FUNCTIONS = {  # where they are not their terms' names
  "hip_splay": "joint_deviation_l2",
  "joint_deviation_knee": "joint_deviation_l1",
  "left_reward": "site_body_distance_tolerance",
  "right_reward": "site_body_distance_tolerance",
  "socket_z_up": "body_upright_at_position",
  "peg_z_up": "body_upright_at_position",
  "socket_entrance_reward": "body_position_tolerance",
  "peg_end2_reward": "body_position_tolerance",
}
_PARAMS = {
  "env.command.duration": "resample_s",
  "env.command.timer": "exponential",
  "env.pushes.duration": "duration_s",
  "env.pushes.interval": "interval_s",
  "env.pushes.velocity_kick": "velocity",
  "env.pushes.kick_durations": "duration_s",
  "env.pushes.kick_wait_times": "interval_s",
}
_OF_020 = {  # sections of 0.2.0, and those of an earlier version with the same keys
  "env.reward_config": "env.reward",
  "env.noise_config": "env.noise",
  "env.command_config": "env.command",
  "env.pert_config": "env.pushes",
  "env.push_config": "env.pushes",
}
_PREFIXES = {
  "env.reward.scales": "env.rewards.<term>.weight",
  "env.reward.total": "env.reward_total",
  "env.reward.clip": "env.reward_clip",
  "env.reward.functions": "env.rewards.<term>.func",
  "env.reward.when_moving": "env.rewards.<term>.when: {command_above: x}",
  "env.reward.when_still": "env.rewards.<term>.when: {command_below: x}",
  "env.reward": "env.rewards.<term>.params",
  "env.noise.level": "env.noise_level",
  "env.noise.pose": "env.pose_noise",
  "env.noise": "env.observations.state.<term>.noise",
  "env.obs_scales": "env.observations.state.<term>.scale",
  "env.obs": "env.observations.<group>.<term>",
  "env.history": "env.observations.state.<term>.history",
  "env.frames": "env.observation_frames",
  "env.termination": "env.terminations.<term>.params",
  "env.command": "env.commands.velocity.params",
  "env.gait": "env.commands.gait.params",
  "env.pushes.enable": "env.events.push.enabled",
  "env.pushes": "env.events.push.params",
  "env.scene.rough": "env.scene.terrain_params",
  "env.reset": "env.events.<term>.params",
  "env.parity": "env=v020/<TaskName>",
  "env.parity_obs": "env=v020/<TaskName>",
  "env.hand": "env.robot",
  "env.min_cube_height": "env.terminations.cube_height_below.params.limit",
  "env.success_reward": "env.rewards.success.weight",
  "env.delays": "env.action_delay or env.observation_delay",
  "randomization": "env.events.<term>, of mode startup",
}


def check_not_moved(key: str) -> None:
  """Raises UnknownNameError, with the key to write instead, for a key of an earlier version or of 0.2.0."""
  section = ".".join(key.split(".")[:2])
  moved = _OF_020.get(section, section) + key[len(section) :]
  prefix = next((p for p in _PREFIXES if moved == p or moved.startswith(f"{p}.")), None)
  if prefix is None:
    return
  new, name = _PREFIXES[prefix], moved[len(prefix) + 1 :]
  if moved == "env.hand":
    new = "robot=<name>"
  elif prefix == "env.reward.scales" and name:
    new = " or ".join(new.replace("<term>", term) for term in _REWARDS.get(name, name).split())
    new += f" (func: {_FUNCTIONS[name]})" if name in _FUNCTIONS else ""
  elif prefix in ("env.command", "env.gait", "env.pushes", "env.hand", "env.noise.pose", "env.scene.rough") and name:
    new = f"{new}.{_PARAMS.get(moved, name)}"
  raise UnknownNameError(f"{key} is of an earlier version: write {new} (docs/migrate.md has all names).")


def renamed_function(kind: str, name: str) -> str | None:
  """Returns the function that a term of an earlier version's name computes, in most tasks; None if there was none."""
  found = _FUNCTIONS.get(name, _REWARDS.get(name)) if kind == "rewards" else None
  return found.split()[0] if found else None
