"""Writes and checks the contract that a controller needs to run a policy: `policy.yaml`."""

import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import yaml

from playground.config import format_value
from playground.deploy.graph import OUTPUT, input_names
from playground.envs.base import PIXELS, Env, State
from playground.errors import CheckpointError
from playground.files import read_yaml
from playground.mdp.commands import Gait, UniformVelocity, VelocityWalk
from playground.mdp.managers import ACTOR
from playground.mdp.options import OPTIONS, ObservationOptions
from playground.settings import plain
from playground.text import first_docstring_line

FORMAT = "playground-policy/3"
Contract = dict[str, Any]  # the content of the YAML file, or of its section `env`

_VALUES = {
  "rgb": "red, green and blue, 0 to 255",
  "gray": "the mean of red, green and blue, 0 to 255",
  "depth": "255 * min(1, distance / {farthest} m) along the optical axis, 0 where no geom is",
  "segmentation": "1 + id of the visible geom in the model, 0 where no geom is",
}
_FILTERS = (mujoco.mjtDyn.mjDYN_FILTER.value, mujoco.mjtDyn.mjDYN_FILTEREXACT.value)
_CONSTANT_BASES = ("default_pose", "home", "zero")
_FAR = 1e6  # an action beyond all limits


def describe_policy(
  env: Env,
  env_config: Contract,
  task: str,
  origin: Mapping[str, object],
  inputs: Mapping[str, tuple[int, ...]],
  state: State,
) -> Contract:
  """Returns the contract of a policy.

  Args:
    env: the task.
    env_config: the run's resolved `env` section.
    task: name of the task.
    origin: the policy's run, agent, steps, commit and last evaluation.
    inputs: shapes of the observation groups that the actor reads.
    state: any state of one environment, to test how actions become `ctrl`.

  Returns:
    Plain values, in the order of the file.
  """
  names = input_names(inputs)
  vectors = [entry for entry in inputs if not entry.startswith(PIXELS)]
  images = [entry for entry in inputs if entry.startswith(PIXELS)]
  reads = lambda entry: {
    "name": names[entry],
    "entry": entry,
    "shape": [1, *inputs[entry]],
    "type": "uint8" if entry in images else "float32",
  }
  policy_dt = env.dt * env.action_repeat
  contract = {
    "format": FORMAT,
    "task": task,
    "origin": origin,
    "policy": {
      "inputs": [reads(entry) for entry in inputs],
      "output": OUTPUT,
      "action_size": env.action_size,
      "normalization": "part of the graph: feed the observation as it is",
      "actions": "the mode of the trained distribution, in [-1, 1]",
    },
    "rate_hz": 1 / policy_dt,
    "control_hz": 1 / env.dt,  # of the steps that frames, histories and delays count; above rate_hz with action repeats
    "observation": [term for entry in vectors for term in _observation(env, entry)],
    "cameras": [_camera(env, entry) for entry in images if entry == f"{PIXELS}{env.config.vision.camera}"],
    "frames": env_config.get("observation_frames", 1),
    "delays": dict(_delays(env_config)),
    "action": _action(env, env_config, state),
    "actuators": _actuators(env.mj_model, _home(env, env_config)),
    "joints": [env.mj_model.joint(i).name or "(free)" for i in range(env.mj_model.njnt)],
    **commands_of(env),
    "env": env_config,
  }
  return plain(contract)


def read_contract(file: Path) -> Contract | None:
  """Returns the mapping in a YAML file, unchecked; None if there is none. Raises OSError if it cannot be read."""
  try:
    content = read_yaml(file)
  except (yaml.YAMLError, ValueError, RecursionError):  # such as an invalid date
    return None
  return content if isinstance(content, dict) else None


def check_contract(contract: Contract) -> None:
  """Checks types and values of a contract, which another program may have written or changed.

  Raises:
    CheckpointError: an entry is missing or invalid.
  """
  _check(contract, "task", lambda x: isinstance(x, str), "a task's name")
  _check(contract, "env", lambda x: isinstance(x, Mapping) and _names(x), "a mapping")
  _check(contract, "origin.steps", _counts, "a whole number")
  scores = lambda x: isinstance(x, Mapping) and _names(x) and (not x or _counts(x.get("steps")))
  _check(
    contract, "origin.evaluation", lambda x: scores(x) and all(map(_is_number, x.values())), "{} or steps and scores"
  )
  _check(contract, "origin.impl", lambda x: x is None or isinstance(x, str), "text or null", optional=True)
  _check(contract, "policy.sha256", lambda x: isinstance(x, str), "text", optional=True)
  _check(contract, "policy.output", lambda x: isinstance(x, str), "text")
  _check(contract, "policy.action_size", lambda x: _counts(x) and x > 0, "a whole number above 0")
  _check(contract, "policy.inputs", lambda x: isinstance(x, list) and x, "a list")
  for i, row in enumerate(contract["policy"]["inputs"]):
    at = lambda key, holds, what: _check(row, key, holds, what, f"policy.inputs[{i}].")  # noqa: B023
    at("name", lambda x: isinstance(x, str), "text")
    at("entry", lambda x: isinstance(x, str), "text")
    at("type", lambda x: x in ("float32", "uint8"), "float32 or uint8")
    at("shape", lambda x: isinstance(x, list) and len(x) > 1 and all(map(_counts, x)) and x[0] == 1, "a shape [1, ...]")
  ends = lambda x: isinstance(x, list) and len(x) == 3 and all(map(_is_number, x))
  command = contract.get("command")
  if command is not None:
    _check(contract, "command.max", ends, "three numbers")
    _check(contract, "command.min", lambda x: x is None or ends(x), "three numbers or null", optional=True)
    low = command.get("min") or [-high for high in command["max"]]
    if any(least > most for least, most in zip(low, command["max"], strict=True)):
      raise CheckpointError(f"command={format_value(command)} must not have its minimum above its maximum.")


def _check(
  node: object, key: str, holds: Callable[[Any], object], what: str, at: str = "", optional: bool = False
) -> None:
  """Raises CheckpointError if the value of a dotted key is invalid."""
  parent, name = None, ""
  for name in key.split("."):
    parent, node = node, node.get(name) if isinstance(node, Mapping) else None
  if optional and isinstance(parent, Mapping) and name not in parent:
    return
  if not isinstance(parent, Mapping) or name not in parent or not holds(node):
    raise CheckpointError(f"{at}{key}={format_value(node)} must be {what}.")


def _names(node: Mapping[object, object]) -> bool:
  return all(isinstance(name, str) for name in node)


def _counts(value: object) -> bool:
  return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**63


def _is_number(value: object) -> bool:
  return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _observation(env: Env, group: str, start: int = 0) -> list[dict[str, object]]:
  """Returns each term of an observation group, which begins at `start`, in order: name, start, length, and its options.

  `scale` multiplies the term; `noise` (with the noise level in it), `delay` and `history` are present if the task has
  them; `what` is the first line of the docstring of the term's function. A term that stands for the group `state` gives
  the rows of that group.
  """
  observations = getattr(env.unwrapped, "observations", None)
  bound = {term.name: term for term in observations.groups.get(group, ())} if observations else {}
  rows = []
  for name, size in env.observation_parts.get(group, {}).items():
    if name == ACTOR != group and bound:
      rows += _observation(env, ACTOR, start)
      start += size
      continue
    row: dict[str, object] = {"name": name, "start": start, "size": size, "scale": 1.0}
    if name in bound:
      row |= _options(bound[name].options, env.config.noise_level)
      row["what"] = first_docstring_line(bound[name].func)
    elif bound:
      row["what"] = "All terms above in the steps before, newest first."
    rows.append({key: value for key, value in row.items() if value is not None})
    start += size
  return rows


def _options(options: ObservationOptions, noise_level: float) -> dict[str, object]:
  """Returns scale, clip, noise, delay and history of an observation term; None for a missing one."""
  noise = dict(options.noise or {})
  for kind in {"uniform", "gaussian"} & set(noise):
    noise[kind] = (noise_level * np.asarray(noise[kind])).tolist()
  return {
    "scale": 1.0 if options.scale is None else options.scale,
    "clip": options.clip,
    "noise": noise or None,
    "delay": options.delay,
    "history": options.history if options.history > 1 else None,
  }


def commands_of(env: Env) -> Contract:
  """Returns the parameters of the task's velocity command (as `command`) and of its gait, if it has them."""
  manager = getattr(env.unwrapped, "commands", None)
  terms = manager.terms if manager else []
  kinds = (("command", UniformVelocity | VelocityWalk), ("gait", Gait))
  return {key: plain(term.params) for key, kind in kinds for term in terms if isinstance(term.instance, kind)}


def _camera(env: Env, entry: str) -> dict[str, object]:
  """Returns the images of `env.vision`: channels in order, meaning of values, pose of the camera."""
  vision = env.config.vision
  camera = env.mj_model.camera(vision.camera)
  return {
    "entry": entry,
    "camera": camera.name,
    "channels": list(env.observation_parts[entry]),
    "values": _VALUES[vision["image"]].format(**vision),
    "body": env.mj_model.body(camera.bodyid[0]).name,
    "mode": mujoco.mjtCamLight(camera.mode[0]).name.removeprefix("mjCAMLIGHT_").lower(),
    "pos": camera.pos,
    "quat": camera.quat,
    "fovy": camera.fovy[0],
    **{key: vision[key] for key in ("width", "height", "frames", "image", "brightness", "shadows", "textures")},
  }


def _delays(config: Mapping[str, object], prefix: str = "") -> Iterator[tuple[str, object]]:
  """Yields the delays that the task simulates, by dotted key."""
  for key, value in config.items():
    if key in OPTIONS:  # an observation term's delay is in its row
      continue
    if isinstance(value, Mapping):
      yield from _delays(value, f"{prefix}{key}.")
    elif "delay" in f"{prefix}{key}":
      yield f"{prefix}{key}", value


def _action(env: Env, config: Contract, state: State) -> dict[str, object]:
  """Returns how an action becomes `ctrl`: base + scale * action, if the task's `action_to_ctrl` computes that."""
  base = config.get("action_base", "last_target" if "action_scale" in config else "zero")
  scale = np.asarray(config.get("action_scale", 1.0))
  home = jnp.asarray(_home(env, config)[1], state.data.qpos.dtype)  # within all ranges, as a start may not be
  state = state.replace(data=state.data.replace(qpos=home))
  control = lambda action: np.asarray(env.action_to_ctrl(state, jnp.asarray(action)))
  held, size = control(np.zeros(env.action_size)), env.action_size
  low, high = (control(np.full(size, sign * _FAR)) for sign in (-1, 1))
  tried = np.linspace(-0.2, 0.3, size)
  law: dict[str, object] = {"class": config["task"], "law": None}
  if held.shape == tried.shape and np.allclose(control(tried), np.clip(held + scale * tried, low, high), atol=1e-5):
    law |= {"law": "ctrl = base + scale * action", "base": base, "scale": scale}
    if base in _CONSTANT_BASES:
      law["base_value"] = held
    if np.all(high - low < scale * _FAR):
      law |= {"clipped_to": {"lower": low, "upper": high}}
  return law


def _home(env: Env, config: Contract) -> tuple[str, np.ndarray]:
  """Returns the name of the reference pose, and its `qpos` [nq]."""
  mj_model = env.mj_model
  keyframes = [mj_model.key(i).name for i in range(mj_model.nkey)]
  if not keyframes:
    return "qpos0", mj_model.qpos0
  name = config.get("keyframe") or config.get("robot", {}).get("keyframe", "home")
  name = name if name in keyframes else keyframes[0]
  qpos = mj_model.key(name).qpos
  start = np.asarray(getattr(getattr(env.unwrapped, "robot", None), "init_qpos", qpos))  # an arm's is within its limits
  return f"keyframe {name}", np.where(np.isclose(start, qpos, atol=1e-6), qpos, start)


def _actuators(mj_model: mujoco.MjModel, home: tuple[str, np.ndarray]) -> list[dict[str, object]]:
  """Returns each actuator in the order of the actions, with its joint if it has one.

  A position servo's force is kp * (ctrl - q) - kv * qd; the joint's own damping is added. An actuator with a
  `time_constant`, s, filters `ctrl`: its first-order activation acts in place of it.
  """
  rows = []
  for i in range(mj_model.nu):
    gain, bias = mj_model.actuator_gainprm[i], mj_model.actuator_biasprm[i]
    row: dict[str, object] = {"name": mj_model.actuator(i).name}
    limits = [mj_model.actuator_forcerange[i]] if mj_model.actuator_forcelimited[i] else []
    if mj_model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT:
      joint = mj_model.joint(mj_model.actuator_trnid[i, 0])
      row |= {"joint": joint.name, "default": home[1][joint.qposadr[0]], "default_of": home[0]}
      row["damping"] = mj_model.dof_damping[joint.dofadr[0]]
      limits += [mj_model.jnt_actfrcrange[joint.id]] if mj_model.jnt_actfrclimited[joint.id] else []
    if mj_model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE:
      row |= {"kp": gain[0], "kv": abs(bias[2])}
    else:
      row["gain"] = gain[0]
    if mj_model.actuator_dyntype[i] in _FILTERS:
      row["time_constant"] = mj_model.actuator_dynprm[i, 0]
    row["gear"] = mj_model.actuator_gear[i, 0]
    row["force_limit"] = min((limit[1] for limit in limits), default=None)
    row["ctrl_range"] = mj_model.actuator_ctrlrange[i] if mj_model.actuator_ctrllimited[i] else None
    rows.append(row)
  return rows
