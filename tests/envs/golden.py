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
from playground.envs.base import Env, State
from playground.envs.dm_control.suite import SuiteTask
from playground.envs.locomotion.joystick import Joystick
from playground.envs.locomotion.stand import Stand
from playground.envs.manipulation.arm import ArmTask
from playground.envs.manipulation.bimanual import Bimanual
from playground.envs.manipulation.in_hand import InHand
from playground.envs.manipulation.pick_cartesian import PickCubeCartesian
from playground.envs.manipulation.push import PushCube
from playground.envs.physics import STATE_FIELDS

GOLDEN = Path(__file__).parents[1] / "golden"
TASKS = sorted(path.stem for path in GOLDEN.glob("*.npz"))
_OVERRIDES = {
  "impl": "impl",
  "noise_config.level": "noise.level",
  "obs_noise.level": "noise.level",
  "obs_noise": "noise.level",
  "pert_config.enable": "pushes.enable",
  "velocity_kick": "pushes.velocity",
  "push_config.enable": "pushes.enable",
  "noise_config.action_max_delay": "delays.action_max",
  "noise_config.obs_max_delay": "delays.obs_max",
}
_UNREAD_INFO = {  # upstream has it, nothing reads it
  PickCubeCartesian: {"info/_steps", "metrics/reward/no_box_collision"},
  PushCube: {"info/prev_step_success", "info/angle_curriculum", "info/pos_curriculum"},
  ArmTask: {"info/target_mat", "info/previously_gripped"},
  SuiteTask: {"info/rng", "info/time_out"},
  Bimanual: {"info/target_pos", "info/_steps"},
  InHand: {
    *("info/step", "info/motor_targets", "info/last_cube_angvel", "info/last_pert_step"),
    *("info/qpos_error_history", "info/cube_pos_error_history", "info/cube_ori_error_history", "info/success_count"),
    *("metrics/success_count", "metrics/steps_since_last_success"),
  },
  Stand: {"info/step"},
  Joystick: {
    *("info/step", "info/motor_targets", "info/filtered_linvel", "info/filtered_angvel", "info/lin_vel"),
    *("info/ang_vel", "info/qpos_error_history", "info/qvel_history", "info/last_vel", "info/last_kick_step"),
    *("info/left_contact", "info/right_contact"),
  },
}
_UNPREFIXED = (  # names of rewards that upstream logs without `reward/`
  *("gripper_box", "box_target", "robot_target_qpos", "no_floor_collision", "no_barrier_collision"),
  *("box_handover", "handover_target", "no_table_collision", "left_reward", "right_reward", "left_target_qpos"),
  *("right_target_qpos", "socket_z_up", "peg_z_up", "socket_entrance_reward", "peg_end2_reward"),
  *("peg_insertion_reward", "action_rate", "box_orientation", "gripper_collision_side", "joint_vel"),
  *("joint_vel_limit", "total_command"),
)
_RENAMED = {  # upstream's names for what others of its tasks call otherwise
  "info/vel_kick": "info/pert_mag",
  "info/direction": "info/pert_dir",
  "info/kick_dir": "info/pert_dir",
  "info/kick_duration_steps": "info/pert_duration",
  "info/kick_wait_steps": "info/pert_interval",
  "info/pert_vel": "info/pert_mag",
  "info/pert_duration_steps": "info/pert_duration",
  "info/pert_wait_steps": "info/pert_interval",
  "info/goal_quat_dquat": "info/goal_spin",
  "info/prev_potential": "info/best_potential",
  "info/prev_reward": "info/best_reward",
  "info/prev_action": "info/last_act",
  "info/last_action": "info/last_act",
  "info/curriculum_id": "info/AutoResetWrapper_preserve_info/curriculum_id",
  "info/episode_picked": "info/picked",
  "info/steps_since_last_success": "info/steps_since_success",
  **{f"metrics/{term}": f"metrics/reward/{term}" for term in _UNPREFIXED},
}
_NOT_UPSTREAM = {  # what our general classes carry, and some of upstream's tasks do not; metrics beside
  InHand: {"info/rng", "info/push_step", "info/pert_mass", "info/stuck"},
  PickCubeCartesian: {"info/action_delay", "info/no_solution"},
  PushCube: {"info/action_delay", "info/goals_reached"},
  Joystick: {
    *("info/gait", "info/gait_freq", "info/last_last_act"),
    *("info/feet_air_time", "info/swing_peak", "info/last_contact", "info/command", "info/step"),
    *("info/steps_until_next_pert", "info/steps_since_last_pert", "info/pert_steps", "info/pert_duration"),
    *("info/pert_duration_seconds", "info/pert_mag", "info/pert_dir", "info/pert_mass", "info/push_step"),
  },
}
_UNUSED_KEYS = {"AeroCubeRotateZAxis"}  # whose observations split off keys that nothing is drawn from
_PROGRAMS: dict[Any, Any] = {}  # compiled physics by structure of the model and fields that are kept
BATCH = 8  # T of all recordings
KEYS = jnp.stack([jax.random.PRNGKey(seed) for seed in range(BATCH)])
_ROWS = {"data/sensordata": "sensor", "data/site_xpos": "site", "data/site_xmat": "site"}


def load_task(name: str, overrides: Mapping[str, Any] | None = None) -> Any:
  """Builds a task (typed Any, since tests look into it); `{"reward.scales.energy": 0}` overrides its config."""
  return playground.load(name, overrides=overrides)


def compiled_task(name: str, overrides: Mapping[str, Any] | None = None) -> Any:
  """Builds a task in pieces, each compiled once: its physics, together with all tasks whose models differ in numbers
  only, and its `evaluate`. Map its `reset` and `step` over a batch of `BATCH`, and do not jit them.
  """
  env = load_task(name, {**(overrides or {}), "impl": "jax"})
  physics = env.physics
  programs = jax.jit(physics.forward), jax.jit(physics.step, static_argnames="num_substeps")
  physics.forward, physics.step = _PROGRAMS.setdefault((jax.tree.structure(physics.model), env.derived), programs)
  env.evaluate = jax.jit(env.evaluate)
  return env


class Golden:
  """One recording, and the task, in parity mode, that should reproduce it.

  Attributes:
    env: the task.
    states: the recorded states, leading axis T + 1.
    actions: shape [T, action_size].
  """

  def __init__(self, name: str):
    with np.load(GOLDEN / f"{name}.npz") as file:
      self._arrays: dict[str, np.ndarray] = {_RENAMED.get(key, key): file[key] for key in map(str, file.files)}
    header = json.loads(str(self._arrays.pop("header")))
    silent = [key for key in header["overrides"] if "noise" in key and "scales." in key]  # all of them are 0
    overrides = {_OVERRIDES[key]: value for key, value in header["overrides"].items() if key not in silent}
    overrides |= {"noise.level": 0.0} if silent else {}
    if name in _UNUSED_KEYS:
      del self._arrays["info/rng"]
    self.name = name
    self.env: Env = compiled_task(name, {**overrides, "parity": True})
    if isinstance(self.env, ArmTask):  # upstream logs their rewards before they are weighted
      for term, scale in self.env.config.reward.scales.items():
        if (key := f"metrics/reward/{term}") in self._arrays:
          self._arrays[key] = self._arrays[key] * scale
    for key in self._arrays.keys() & _ROWS.keys():
      self._arrays[key] = self._our_rows(self._arrays[key], _ROWS[key], header["model"])
    self.actions = jnp.array(self._arrays.pop("action"))
    self._ours = jax.eval_shape(self.env.reset, KEYS[0])
    self._default = self.env.physics.make()
    states: State = jax.tree_util.tree_map_with_path(self._recorded, self._ours)
    # Tied to a device as what the task computes is, else its program would be compiled again.
    self.states = jax.device_put(states, jax.devices()[0])

  @functools.cached_property
  def first(self) -> State:
    """The task's own state after reset from PRNGKey(0)."""
    return jax.tree.map(lambda x: x[0], jax.vmap(self.env.reset)(KEYS))

  def _recorded(self, path: tuple[Any, ...], ours: jax.ShapeDtypeStruct) -> jax.Array:
    name = _name(path)
    shape = (len(self.actions) + 1, *ours.shape)
    if name in self._arrays:
      recorded = self._arrays[name].reshape(shape[0], -1)  # one number upstream may be a list of one
      newest = math.prod(ours.shape) if name.endswith("_history") else None  # upstream keeps more than it reads
      return jnp.array(recorded[:, :newest]).reshape(shape)
    # Recordings leave out state that is the model's default. Anything else that we have, upstream had.
    if name.startswith("data/") and (field := name.removeprefix("data/")) in STATE_FIELDS:
      return jnp.broadcast_to(getattr(self._default, field), shape)
    assert self._only_ours(name), f"{name} was not recorded"
    return jnp.zeros(shape, ours.dtype)

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
    """What was recorded and the task does not have, except unread data and metrics that are zero throughout."""
    ours = {_name(path) for path, _ in jax.tree_util.tree_flatten_with_path(self._ours)[0]}
    unread = _of_class(_UNREAD_INFO, self.env)
    return [
      name
      for name, values in self._arrays.items()
      if name not in ours | unread
      and not name.startswith("data/")
      and not (name.startswith("metrics/") and not values.any())
    ]

  def _only_ours(self, name: str) -> bool:
    """Whether upstream has no such entry, and need not have: we log more."""
    more = name.startswith("metrics/") or name in _of_class(_NOT_UPSTREAM, self.env)
    return more and name not in self._arrays

  def pairs(self, actual: State, expected: State) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """The recorded leaves of two states as (name, actual, expected), NaN where nothing was recorded.

    Floats are in double precision.
    """
    leaves = jax.tree_util.tree_flatten_with_path(actual)[0]
    for (path, a), b in zip(leaves, jax.tree.leaves(expected), strict=True):
      if not self._only_ours(_name(path)):
        theirs = np.asarray(b, np.float64)
        yield _name(path), np.where(np.isnan(theirs), np.nan, np.asarray(a, np.float64)), theirs


def without_physics(name: str, **overrides: Any) -> Any:
  """A task whose resets compute no kinematics and whose `evaluate` is compiled."""
  env: Any = load_task(name, overrides)
  env.physics.forward = lambda model, data: data
  env.evaluate = jax.jit(env.evaluate)
  return env


def terms(state: State) -> dict[str, jax.Array]:
  """The weighted terms of a step's reward, by name."""
  return {name: value for name, value in state.metrics.items() if name.startswith("reward/")}


def recorded(name: str, **info: jax.Array) -> State:
  """A recorded state amid an episode, with some of its `info` replaced: any variant of the task may go on from it."""
  state = jax.tree.map(lambda x: x[4], golden(name).states)
  return state.replace(info=state.info | info)


def _of_class(table: Mapping[type, set[str]], env: Env) -> set[str]:
  return next((names for task, names in table.items() if isinstance(env, task)), set())


def _name(path: tuple[Any, ...]) -> str:
  return "/".join(str(getattr(key, "name", getattr(key, "key", key))) for key in path)


@functools.cache
def golden(name: str) -> Golden:
  """One recording, built and compiled once for all tests."""
  return Golden(name)
