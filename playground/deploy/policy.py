"""A policy as a controller has it: `policy.onnx`, run by ONNX Runtime on one core, and its contract `policy.yaml`."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import yaml

from playground.deploy.contract import FORMAT
from playground.envs.base import Observation
from playground.errors import CheckpointError
from playground.extras import need


class ExportedPolicy:
  """Maps an observation to an action, as the contract says."""

  def __init__(self, model: bytes, contract: Mapping[str, Any]):
    """Takes the ONNX model and what `playground.deploy.contract` says of it."""
    need("deploy", "onnxruntime")
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    self._session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    self.model = model
    self.contract = contract

  @classmethod
  def load(cls, path: str | Path) -> "ExportedPolicy":
    """Reads `<name>.onnx` and `<name>.yaml` beside it.

    Raises:
      CheckpointError: one of them is missing, or is not what `playground export` writes.
    """
    path = Path(path).expanduser()
    for file in (path, path.with_suffix(".yaml")):
      if not file.is_file():
        raise CheckpointError(f"{file} does not exist: `playground export <run>` writes a policy and its contract.")
    try:
      contract = yaml.safe_load(path.with_suffix(".yaml").read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError):
      contract = None
    if not isinstance(contract, dict) or contract.get("format") != FORMAT:
      raise CheckpointError(f"{path.with_suffix('.yaml')} is not a policy's contract ({FORMAT}).")
    return cls(path.read_bytes(), contract)

  def actions(self, obs: np.ndarray) -> np.ndarray:
    """Actions in [-1, 1], [..., action_size], for observations [..., n]: one inference each."""
    rows = np.asarray(obs, np.float32).reshape(-1, 1, obs.shape[-1])
    name_in, name_out = (self.contract["policy"][key] for key in ("input", "output"))
    out = np.concatenate([np.asarray(self._session.run([name_out], {name_in: row})[0]) for row in rows])
    return out.reshape(*obs.shape[:-1], -1)

  def act(self, policy: Any, obs: Observation, key: jax.Array) -> jax.Array:
    """The same from within jitted code, as evaluations call a policy."""
    del policy, key
    entry = obs[self.contract["policy"]["entry"]] if isinstance(obs, Mapping) else obs
    shape = (*entry.shape[:-1], self.contract["policy"]["action_size"])
    return jax.pure_callback(self.actions, jax.ShapeDtypeStruct(shape, np.float32), entry, vmap_method="broadcast_all")

  def latency(self, obs: np.ndarray) -> np.ndarray:
    """Seconds that each inference of observations [N, n] takes here, [N]."""
    seconds = []
    for row in obs:
      began = time.perf_counter()
      self.actions(row)
      seconds.append(time.perf_counter() - began)
    return np.array(seconds)
