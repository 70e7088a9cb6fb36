"""What a controller must know to run a policy: `policy.yaml`."""

from collections.abc import Iterator, Mapping
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from playground.deploy.graph import OUTPUT, input_names
from playground.deploy.parts import describe_part
from playground.envs.base import PIXELS, Env, State
from playground.runs.files import plain

FORMAT = "playground-policy/2"

_VALUES = {
  "rgb": "red, green and blue, 0 to 255",
  "gray": "the mean of red, green and blue, 0 to 255",
  "depth": "255 * min(1, distance / {farthest} m) along the optical axis, 0 where nothing is",
  "segmentation": "the number of the geom that is seen, counted from 1 in the order of the model, 0 where nothing is",
}
_HISTORY = "_history"
_CONSTANT_BASES = ("default_pose", "home", "zero")
_FAR = 1e6  # an action beyond all limits


def describe_policy(
  env: Env,
  env_config: Mapping[str, Any],
  task: str,
  origin: Mapping[str, Any],
  inputs: Mapping[str, tuple[int, ...]],
  state: State,
) -> dict[str, Any]:
  """Writes the contract down.

  Args:
    env: the task.
    env_config: its resolved `env` section.
    task: its name.
    origin: where the policy comes from: run, step, commit.
    inputs: shapes of the entries of the task's observation that the actor reads.
    state: any state of one environment, to try the action's law on.

  Returns:
    What YAML knows, in the order to be read in.
  """
  names = input_names(inputs)
  vectors = [entry for entry in inputs if not entry.startswith(PIXELS)]
  pictures = [entry for entry in inputs if entry.startswith(PIXELS)]
  reads = lambda entry: {
    "name": names[entry],
    "entry": entry,
    "shape": [1, *inputs[entry]],
    "type": "uint8" if entry in pictures else "float32",
  }
  decision = env.dt * env.action_repeat
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
    "rate_hz": 1 / decision,
    "observation": [part for entry in vectors for part in _observation(env, env_config, entry)],
    "cameras": [_camera(env, entry) for entry in pictures if entry == f"{PIXELS}{env.config.vision.camera}"],
    "frames": env_config.get("frames", 1),
    "history": env_config.get("history", {}),
    "delays": dict(_delays(env_config)),
    "action": _action(env, env_config, state),
    "actuators": _actuators(env.mj_model, _home(env.mj_model, env_config)),
    "joints": [env.mj_model.joint(i).name or "(free)" for i in range(env.mj_model.njnt)],
    **{key: env_config[key] for key in ("command", "gait") if key in env_config},
    "env": env_config,
  }
  return plain(contract)


def _observation(env: Env, config: Mapping[str, Any], entry: str) -> list[dict[str, Any]]:
  """Each part in its order: where it begins, its length, the factor and the noise on it, what it is, in which frame."""
  slips = config.get("parity_obs", {}) if config["parity"] else {}
  noise, scales = config.get("noise", {}), config.get("obs_scales", {})
  parts, start = [], 0
  for name, size in env.observation_parts.get(entry, {}).items():
    base = name.removesuffix(_HISTORY)
    part: dict[str, Any] = {"part": name, "start": start, "size": size, "scale": scales.get(base, 1.0)}
    if base in noise.get("scales", {}):
      part["noise"] = (noise["level"] * np.asarray(noise["scales"][base])).tolist()
    if said := describe_part(env, slips.get(base, base)):
      part["what"] = said
    parts.append(part)
    start += size
  return parts


def _camera(env: Env, entry: str) -> dict[str, Any]:
  """What `env.vision` shows: the channels in their order, what a value says, and where the camera is."""
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


def _delays(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
  """The delays that the task simulates, by dotted key."""
  for key, value in config.items():
    if isinstance(value, Mapping):
      yield from _delays(value, f"{prefix}{key}.")
    elif "delay" in f"{prefix}{key}":
      yield f"{prefix}{key}", value


def _action(env: Env, config: Mapping[str, Any], state: State) -> dict[str, Any]:
  """How an action becomes `ctrl`: base + scale * action, where the task's own `control` agrees that this is the law."""
  base = config.get("action_base", "last_target" if "action_scale" in config else "zero")
  scale = np.asarray(config.get("action_scale", 1.0))
  control = lambda action: np.asarray(env.control(state, jnp.asarray(action)))
  held, size = control(np.zeros(env.action_size)), env.action_size
  low, high = (control(np.full(size, sign * _FAR)) for sign in (-1, 1))
  tried = np.linspace(-0.2, 0.3, size)
  law: dict[str, Any] = {"class": config["task"], "law": None}
  if held.shape == tried.shape and np.allclose(control(tried), np.clip(held + scale * tried, low, high), atol=1e-5):
    law |= {"law": "ctrl = base + scale * action", "base": base, "scale": scale}
    if base in _CONSTANT_BASES:
      law["base_value"] = held
    if np.all(high - low < scale * _FAR):
      law |= {"clipped_to": {"lower": low, "upper": high}}
  return law


def _home(mj_model: mujoco.MjModel, config: Mapping[str, Any]) -> tuple[str, np.ndarray]:
  """The configuration that poses are told from, and what it is called."""
  keyframes = [mj_model.key(i).name for i in range(mj_model.nkey)]
  if not keyframes:
    return "qpos0", mj_model.qpos0
  name = config.get("robot", {}).get("keyframe", "home")
  name = name if name in keyframes else keyframes[0]
  return f"keyframe {name}", mj_model.key(name).qpos


def _actuators(mj_model: mujoco.MjModel, home: tuple[str, np.ndarray]) -> list[dict[str, Any]]:
  """Each actuator in the order of the actions, with its joint where it has one.

  A position servo's force is kp * (ctrl - q) - kv * qd; the joint's own damping comes on top.
  """
  rows = []
  for i in range(mj_model.nu):
    gain, bias = mj_model.actuator_gainprm[i], mj_model.actuator_biasprm[i]
    row: dict[str, Any] = {"name": mj_model.actuator(i).name}
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
    row["gear"] = mj_model.actuator_gear[i, 0]
    row["force_limit"] = min((limit[1] for limit in limits), default=None)
    row["ctrl_range"] = mj_model.actuator_ctrlrange[i] if mj_model.actuator_ctrllimited[i] else None
    rows.append(row)
  return rows
