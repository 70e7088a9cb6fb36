"""Recorded rolls of Playground 0.2.0 as states of this package's tasks.

A file `tests/golden/<Task>.npz` holds T + 1 records of data, info, obs, ... and the T actions between them, from
`reset(PRNGKey(0))` on, with the randomness of noise and pushes switched off (its header lists the overrides).
"""

import functools
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import playground
from playground.config.files import options
from playground.envs.base import Env, State
from playground.envs.dm_control.suite import SuiteTask
from playground.envs.locomotion.legged import LeggedTask
from playground.envs.manipulation.arm import ArmTask, Bimanual
from playground.envs.manipulation.in_hand import HandTask
from playground.envs.manipulation.pick_cartesian import PickCubeCartesian
from playground.envs.manipulation.push import PushCube
from playground.envs.task import Task
from playground.physics.backend import STATE_FIELDS

GOLDEN = Path(__file__).parents[1] / "golden"
TASKS = sorted(path.stem for path in GOLDEN.glob("*.npz"))
_OVERRIDES = {  # 0.2.0's key: ours, where a task has it
  "noise_config.level": "noise_level",
  "obs_noise.level": "noise_level",
  "obs_noise": "noise_level",
  "pert_config.enable": "events.push.enabled",
  "push_config.enable": "events.push.enabled",
  "velocity_kick": "events.push.params.velocity",
  "noise_config.action_max_delay": "action_delay",
  "noise_config.obs_max_delay": "observation_delay",
}
_UNREAD_INFO = {  # upstream has it, nothing reads it
  PickCubeCartesian: {"info/_steps", "info/target_pos", "info/newly_reset"},
  PushCube: {"info/prev_step_success", "info/angle_curriculum", "info/pos_curriculum"},
  ArmTask: {"info/target_mat", "info/target_pos", "info/previously_gripped"},
  SuiteTask: {"info/rng", "info/time_out"},
  Bimanual: {"info/target_pos", "info/_steps"},
  HandTask: {"info/step", "info/motor_targets", "info/last_cube_angvel", "info/last_pert_step"},
  LeggedTask: {
    *("info/motor_targets", "info/filtered_linvel", "info/filtered_angvel", "info/lin_vel", "info/ang_vel"),
    *("info/last_vel", "info/left_contact", "info/right_contact"),
  },
}
# What pushes and commands count, which our events and commands count otherwise: nothing of it happens in the rolls.
_COUNTERS = {
  *("info/vel_kick", "info/direction", "info/kick_dir", "info/kick_duration_steps", "info/kick_wait_steps"),
  *("info/last_kick_step", "info/pert_vel", "info/pert_duration_steps", "info/pert_wait_steps", "info/pert_mag"),
  *("info/pert_dir", "info/pert_duration", "info/pert_duration_seconds", "info/pert_steps", "info/push"),
  *("info/push_step", "info/push_interval_steps", "info/steps_since_last_pert", "info/steps_until_next_pert"),
  *("info/steps_until_next_cmd", "info/step", "info/rng", "info/last_pert_step"),
}
_HISTORIES = {
  "info/qpos_error_history",
  "info/qvel_history",
  "info/cube_pos_error_history",
  "info/cube_ori_error_history",
}
_SMOOTH = {f"metrics/reward/{term}" for term in ("upright", "centered", "small_control", "small_velocity")}
_SPARSE = {f"metrics/reward/{term}" for term in ("angle_in_bounds", "cart_in_bounds")}
_CONSTANT = {  # metrics that upstream logs and never changes, see docs/differences.md
  "AcrobotSwingup": {"metrics/distance"},
  "AcrobotSwingupSparse": {"metrics/distance"},
  "CartpoleBalance": _SPARSE,
  "CartpoleBalanceSparse": _SMOOTH,
  "CartpoleSwingup": _SPARSE,
  "CartpoleSwingupSparse": _SMOOTH,
  "PandaPickCubeCartesian": {"metrics/reward/no_box_collision"},
  "WalkerStand": {"metrics/reward/move"},
}
# The sum of two terms of ours (test_golden.py).
_SUMS = {"ApolloJoystickFlatTerrain": {"metrics/reward/tracking"}}
# Names of reward terms that upstream logs, with or without `reward/`: ours, the first that a task has.
_REWARDS: dict[str, tuple[str, ...]] = {
  "tracking_lin_vel": ("track_linear_velocity_exp",),
  "tracking_ang_vel": ("track_angular_velocity_exp",),
  "lin_vel_z": ("lin_vel_z_l2_in_gaits", "lin_vel_z_l2_in_other_gaits", "lin_vel_z_l2"),
  "lin_vel": ("lin_vel_xy_l2",),
  "ang_vel": ("ang_vel_l2",),
  "ang_vel_xy": ("ang_vel_xy_l2",),
  "orientation": (
    "flat_orientation_l2",
    "orientation_l2",
    "upright_exp",
    "forward_alignment",
    "cube_orientation_linear",
  ),
  "base_height": ("base_height_l2",),
  "height": ("base_height_exp",),
  "torso_height": ("base_height_expm1", "root_height_ratio"),
  "dof_pos_limits": ("joint_pos_limits", "joint_pos_limits_scaled"),
  "dof_acc": ("joint_acc_l2",),
  "dof_vel": ("joint_vel_limits_l2",),
  "pose": ("pose_exp", "pose_l2", "pose_l2_by_command", "lifted_leg_deviation_l2"),
  "posture": ("pose_exp_when_still", "pose_exp_when_upright"),
  "stand_still": ("stand_still", "action_exp_when_up", "action_exp_when_root_up"),
  "zero_cmd": ("action_l2",),
  "hip_splay": ("hip_deviation_l2",),
  "joint_deviation_knee": ("knee_deviation_l1",),
  "joint_deviation_hip": ("hip_deviation_l1",),
  "torques": ("joint_torques_norms", "joint_torques_l1", "joint_torques_l2"),
  "energy": ("joint_power_l1", "joint_power_qfrc_l1"),
  "action_rate": ("action_rate_l2", "action_smoothness_l2", "action_rate_norm"),
  "termination": ("is_terminated",),
  "alive": ("constant",),
  "collision": ("self_contact",),
  "contact": ("feet_contact",),
  "contact_force": ("feet_contact_force",),
  "feet_clearance": ("feet_clearance",),
  "feet_height": ("feet_swing_height_l2",),
  "feet_slip": ("feet_slip_l2", "base_speed_times_contacts"),
  "feet_air_time": ("feet_air_time",),
  "feet_phase": ("feet_phase_exp", "feet_phase_exp_unless_at_rest"),
  "feet_distance": ("feet_distance",),
  # Hands.
  "position": ("cube_position_linear",),
  "angvel": ("cube_ang_vel_z",),
  "linvel": ("cube_lin_vel_l1",),
  "hand_pose": ("joint_deviation_l2",),
  # Arms.
  "gripper_box": ("object_gripper_distance_tanh", "gripper_behind_object_tolerance", "grippers_at_box_exp"),
  "box_target": ("object_goal_distance_tanh", "object_goal_distance_xy_tolerance"),
  "box_orientation": ("object_goal_angle_tolerance",),
  "box_handover": ("box_at_meeting_exp",),
  "handover_target": ("box_at_goal_exp",),
  "robot_target_qpos": ("joint_deviation_tanh", "joint_deviation_tolerance"),
  "no_floor_collision": ("no_contact",),
  "no_barrier_collision": ("no_contact",),
  "no_table_collision": ("no_contact",),
  "gripper_collision_side": ("contact_normal_horizontal",),
  "joint_vel": ("joint_vel_tolerance",),
  "joint_vel_limit": ("joint_vel_within_limits",),
  "total_command": ("action_norm",),
  "no_solution": ("no_ik_solution",),
  "lifted": ("object_lifted",),
  "success": ("success", "object_at_goal"),
  "left_reward": ("gripper_at_socket",),
  "right_reward": ("gripper_at_peg",),
  "left_target_qpos": ("left_arm_home",),
  "right_target_qpos": ("right_arm_home",),
  "socket_z_up": ("socket_upright",),
  "peg_z_up": ("peg_upright",),
  "socket_entrance_reward": ("socket_position",),
  "peg_end2_reward": ("peg_position",),
  "peg_insertion_reward": ("peg_inserted",),
}
_RENAMED = {  # upstream's names for what others of its tasks call otherwise
  "info/goal_quat_dquat": "info/goal_spin",
  "info/prev_potential": "info/best_potential",
  "info/prev_reward": "info/best_potential",
  "info/prev_action": "info/last_act",
  "info/last_action": "info/last_act",
  "info/curriculum_id": "info/AutoResetWrapper_preserve_info/curriculum_id",
  "info/episode_picked": "info/picked",
  "info/steps_since_last_success": "info/steps_since_success",
  "metrics/termination/fall_termination": "metrics/fall",
  "metrics/out_of_bounds": "metrics/fall",  # nothing else ends an episode in the rolls
}
_RENAMED_IN = {
  "PandaRobotiqPushCube": {
    "info/last_action": "info/applied_act",
    "info/success_step_count": "info/goal_steps",
    "info/obs_history": "info/observation_buffers/delayed",
  }
}
_SETTINGS = {"PandaPickCubeCartesian": {"guide_probability": 0.0}}  # the roll does not begin with the cube in the hand
_FAR = 1000  # control steps until the next command, in rolls of 8
_PROGRAMS: dict[Any, Any] = {}  # compiled physics by structure of the model and fields that are kept
BATCH = 8  # T of all recordings
KEYS = jnp.stack([jax.random.PRNGKey(seed) for seed in range(BATCH)])
_ROWS = {"data/sensordata": "sensor", "data/site_xpos": "site", "data/site_xmat": "site"}


def _shapes(env: Any) -> State:
  """Shapes of what a reset returns, which do not depend on the dynamics."""
  physics = env.physics
  env.physics = still = physics.without_dynamics()
  del still.forward, still.step  # which are compiled, see `compiled_task`
  try:
    return jax.eval_shape(env.reset, KEYS[0])
  finally:
    env.physics = physics


def load_task(name: str, overrides: Mapping[str, Any] | None = None) -> Any:
  """Builds a task (typed Any, since tests look into it); `{"action_scale": 0}` overrides its config."""
  return playground.load(name, overrides=overrides)


def compiled_task(name: str, overrides: Mapping[str, Any] | None = None) -> Any:
  """Builds a task in pieces, each compiled once: its physics, together with all tasks whose models differ in numbers
  only, and its `post_step`. Map its `reset` and `step` over a batch of `BATCH`, and do not jit them.
  """
  env = load_task(name, {**(overrides or {}), "impl": "jax"})
  physics = env.physics
  programs = jax.jit(physics.forward), jax.jit(physics.step, static_argnames="num_substeps")
  physics.forward, physics.step = _PROGRAMS.setdefault((jax.tree.structure(physics.model), env.derived), programs)
  env.post_step = jax.jit(env.post_step)
  return env


def compat_name(task: str) -> str:
  """The task that reproduces 0.2.0: `v020/<task>`, or the task itself where the two do not differ."""
  return f"v020/{task}" if f"v020/{task}" in options("env") else task


class Golden:
  """One recording, and the task that should reproduce it.

  Attributes:
    env: the task.
    states: the recorded states, leading axis T + 1.
    actions: shape [T, action_size].
  """

  def __init__(self, name: str, task: str | None = None):
    with np.load(GOLDEN / f"{name}.npz") as file:
      names = _RENAMED | _RENAMED_IN.get(name, {})
      self._arrays: dict[str, np.ndarray] = {names.get(key, key): file[key] for key in map(str, file.files)}
    header = json.loads(str(self._arrays.pop("header")))
    task = task or compat_name(name)
    config = playground.registry.config(task)
    self.name = name
    self.env: Env = compiled_task(task, dict(_overrides(header["overrides"], config)) | _SETTINGS.get(name, {}))
    self._rename_rewards(header["config"])
    for key in self._arrays.keys() & _ROWS.keys():
      self._arrays[key] = self._our_rows(self._arrays[key], _ROWS[key], header["model"])
    self.actions = jnp.array(self._arrays.pop("action"))
    self._ours = _shapes(self.env)
    self._default = self.env.physics.make()
    states: State = jax.tree_util.tree_map_with_path(self._recorded, self._ours)
    # Tied to a device as what the task computes is, else its program would be compiled again.
    self.states = jax.device_put(states, jax.devices()[0])

  def _rename_rewards(self, config: Mapping[str, Any]) -> None:
    """Gives recorded metrics of reward terms our names; those of most arms were logged before they were weighted."""
    weights = _weights(config)
    self._unweighted = {f"metrics/reward/{term}" for term, weight in weights.items() if weight == 0}
    if not isinstance(self.env, Task):
      return
    ours = {term.name: term.options.weight for term in self.env.rewards.terms}
    raw = isinstance(self.env, ArmTask) and not isinstance(self.env, PushCube)
    for key in [k for k in self._arrays if k.startswith("metrics/")]:
      if key.removeprefix("metrics/") in self.env.summaries:
        continue
      name = key.removeprefix("metrics/").removeprefix("reward/")
      new = next((n for n in (*_REWARDS.get(name, ()), name) if n in ours), None)
      if new is None:
        continue
      self._arrays[f"metrics/reward/{new}"] = self._arrays.pop(key) * (ours[new] if raw else 1.0)

  def recorded(self, name: str) -> np.ndarray:
    """Returns what upstream recorded under a name, leading axis T + 1."""
    return self._arrays[name]

  def _recorded(self, path: tuple[Any, ...], ours: jax.ShapeDtypeStruct) -> jax.Array:
    name = _name(path)
    shape = (len(self.actions) + 1, *ours.shape)
    if name == "info/first_step":
      return jnp.arange(shape[0]) == 0
    if name == "info/action_delay":
      return jnp.full(shape, self.env.config.get("action_delay", [0])[0])
    if name.startswith("info/observation_buffers/") and name not in self._arrays:
      return self._buffer(name.removeprefix("info/observation_buffers/"), shape)
    if name == "info/command_steps_left":
      left = self._arrays.get("info/steps_until_next_cmd")
      return jnp.full(shape, _FAR) if left is None else jnp.array(left).reshape(shape)
    if name in self._arrays and name not in _COUNTERS:
      kept = self._arrays[name].reshape(shape[0], -1)[:, : math.prod(shape[1:])]  # newest first, fewer than upstream
      return jnp.array(kept).reshape(shape)  # one number upstream may be a list of one
    # Recordings leave out state that is the model's default.
    if name.startswith("data/") and (field := name.removeprefix("data/")) in STATE_FIELDS:
      return jnp.broadcast_to(getattr(self._default, field), shape)
    return jnp.zeros(shape, ours.dtype)

  def _buffer(self, name: str, shape: tuple[int, ...]) -> jax.Array:
    """What an observation remembers, read out of the recorded observation that shows it: the newest first."""
    group, _, term = name.partition("/")
    obs = self._arrays["obs" if "obs" in self._arrays else f"obs/{group}"]
    if not term:  # frames
      return jnp.array(obs).reshape(shape)
    parts = self.env.observation_parts[group]
    start = sum(size for part, size in list(parts.items())[: list(parts).index(term)])
    return jnp.array(obs[:, start : start + math.prod(shape[1:])]).reshape(shape)

  def _our_rows(self, recorded: np.ndarray, kind: str, names: Mapping[str, list[Any]]) -> np.ndarray:
    """Sensors or sites in our model's order; NaN for those not recorded, so that reading one shows."""
    model = self.env.mj_model
    ours = [getattr(model, kind)(i) for i in range(getattr(model, f"n{kind}"))]
    if kind == "sensor":
      rows = {name: list(range(start, start + size)) for name, start, size in names[kind]}
    else:
      rows = {name: [i] for i, name in enumerate(names[kind])}
    sizes = [int(model.sensor_dim[entry.id]) if kind == "sensor" else 1 for entry in ours]
    picked = [row for entry, size in zip(ours, sizes, strict=True) for row in rows.get(entry.name, [-1] * size)]
    nothing = np.full_like(recorded[:, :1], np.nan)
    return np.concatenate([recorded, nothing], axis=1)[:, picked]

  def missing(self) -> list[str]:
    """What was recorded and the task does not have: all but what is listed here and reward terms of weight 0.

    What 0.2.0 computes from the state (`data/` but the state's own fields) is compared where a task reads it.
    """
    ours = {_name(path) for path, _ in jax.tree_util.tree_flatten_with_path(self._ours)[0]}
    constant = {name for name in _CONSTANT.get(self.name, ()) if not np.ptp(self._arrays[name][1:])}
    excused = self._unweighted | constant | _of_class(_UNREAD_INFO, self.env) | _COUNTERS | _HISTORIES
    excused |= _SUMS.get(self.name, set())
    excused |= {name for name in self._arrays if name.startswith("data/")} - {f"data/{name}" for name in STATE_FIELDS}
    return [name for name in self._arrays if name not in ours | excused]

  def _compared(self, name: str) -> bool:
    """Whether upstream recorded a leaf of our state, or its default."""
    return name in self._arrays.keys() - _COUNTERS or name.removeprefix("data/") in STATE_FIELDS

  def pairs(self, actual: State, expected: State) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """The recorded leaves of two states as (name, actual, expected), in double precision.

    Both are NaN at sensors and sites that were not recorded. A command is not compared where 0.2.0 drew another.
    """
    drawn = self._arrays.get("info/steps_until_next_cmd")
    due = None if drawn is None else drawn[:-1].ravel() <= 1
    leaves = jax.tree_util.tree_flatten_with_path(actual)[0]
    for (path, a), b in zip(leaves, jax.tree.leaves(expected), strict=True):
      name = _name(path)
      if not self._compared(name):
        continue
      ours, theirs = np.asarray(a, np.float64), np.asarray(b, np.float64)
      if name == "info/command" and due is not None and len(due) == len(ours):
        ours, theirs = ours[~due], theirs[~due]
      yield name, np.where(np.isnan(theirs), np.nan, ours) if name in _ROWS else ours, theirs


def without_physics(name: str, **overrides: Any) -> Any:
  """A task whose resets compute no kinematics and whose `post_step` is compiled."""
  env: Any = load_task(name, overrides)
  env.physics.forward = lambda model, data: data
  env.post_step = jax.jit(env.post_step)
  return env


def terms(state: State) -> dict[str, jax.Array]:
  """The weighted terms of a step's reward, by name."""
  return {name: value for name, value in state.metrics.items() if name.startswith("reward/")}


def recorded(name: str, **info: jax.Array) -> State:
  """A recorded state amid an episode, with some of its `info` replaced: any variant of the task may go on from it."""
  state = jax.tree.map(lambda x: x[4], golden(name).states)
  return state.replace(info=state.info | info)


def _overrides(theirs: Mapping[str, Any], config: Any) -> Iterator[tuple[str, Any]]:
  """0.2.0's overrides as ours."""
  for key, value in theirs.items():
    if "noise" in key and "scales." in key:  # all of them are 0
      yield "noise_level", 0.0
      continue
    ours = _OVERRIDES.get(key, key)
    if ours.endswith("_delay"):  # theirs is the end of the range, not in it, and above its start by one
      yield ours, [value - 1, value - 1]
      continue
    if ours.startswith("events.push") and "push" not in config.events:
      continue
    yield ours, value


def _weights(config: Mapping[str, Any]) -> Mapping[str, float]:
  """The weights of reward terms in one of upstream's configs, which has them in one of three places."""
  rewards = config.get("reward_config", config)
  return next((rewards[key] for key in ("scales", "reward_scales") if key in rewards), {})


def _of_class(table: Mapping[type, set[str]], env: Env) -> set[str]:
  return next((names for task, names in table.items() if isinstance(env, task)), set())


def _name(path: tuple[Any, ...]) -> str:
  return "/".join(str(getattr(key, "name", getattr(key, "key", key))) for key in path)


@functools.cache
def golden(name: str) -> Golden:
  """One recording, built and compiled once for all tests."""
  return Golden(name)
