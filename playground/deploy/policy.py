"""Runs an exported policy, `policy.onnx` with its contract `policy.yaml`, in ONNX Runtime on one core."""

import hashlib
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

import jax
import numpy as np

from playground.deploy.contract import FORMAT, Contract, check_contract, read_contract
from playground.envs.base import Observation, observation_groups
from playground.errors import CheckpointError, ConfigError
from playground.extras import need

Seen = Observation | np.ndarray | Mapping[str, np.ndarray]  # inputs of a policy, with any leading axes


class ActingPolicy(Protocol):
  """An exported policy or a script that acts in a player or an evaluation."""

  contract: Contract

  def actions(self, obs: Seen) -> np.ndarray:
    """Returns actions in [-1, 1], [..., action_size], for observations with any leading axes."""
    ...

  def act(self, policy: object, obs: Observation, key: jax.Array) -> jax.Array:
    """Returns actions [..., action_size] inside jitted code, as evaluations call a policy."""
    ...


class ExportedPolicy:
  """Maps an observation to an action, with ONNX Runtime."""

  def __init__(self, model: bytes, contract: Contract):
    """Loads an ONNX model with its contract (`playground.deploy.contract`).

    Raises:
      CheckpointError: the model is damaged, has other inputs or outputs, or does not belong to the contract.
    """
    need("deploy", "onnxruntime")
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # errors of a model are raised below
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    try:
      self._session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors have no common base
      raise CheckpointError(f"The policy is no model that ONNX Runtime can read: {error}") from None
    policy = contract["policy"]
    known = {row["name"]: row["shape"] for row in policy["inputs"]} | {policy["output"]: [1, policy["action_size"]]}
    found = {end.name: end.shape for end in (*self._session.get_inputs(), *self._session.get_outputs())}
    if found != known:
      raise CheckpointError(f"The policy has other inputs or outputs than its contract: {found} instead of {known}.")
    own = hashlib.sha256(model).hexdigest()
    if policy.get("sha256", own) != own:  # older exports have none
      raise CheckpointError("The policy and its contract are not of one export (sha256): export the run again.")
    self.model = model
    self.contract = contract

  @classmethod
  def load(cls, path: str | Path) -> "ExportedPolicy":
    """Reads `<name>.onnx` and `<name>.yaml` beside it.

    Raises:
      CheckpointError: a file is missing, or was not written by `playground export`.
    """
    path = Path(path).expanduser()
    for file in (path, path.with_suffix(".yaml")):
      if not file.is_file():
        raise CheckpointError(f"{file} does not exist: `playground export <run>` writes a policy and its contract.")
    model = path.read_bytes()  # before its contract, which is written first: this detects a concurrent export
    contract = read_contract(path.with_suffix(".yaml"))
    if contract is None or contract.get("format") != FORMAT:
      raise CheckpointError(f"{path.with_suffix('.yaml')} is not a policy's contract ({FORMAT}): export the run again.")
    try:
      check_contract(contract)
    except CheckpointError as error:
      raise CheckpointError(f"{path.with_suffix('.yaml')} is not a policy's contract: {error}") from None
    try:
      return cls(model, contract)
    except CheckpointError as error:
      raise CheckpointError(f"{path}: {error}") from None

  def actions(self, obs: Seen) -> np.ndarray:
    """Returns actions in [-1, 1], [..., action_size], for observations with any leading axes: one inference each.

    Raises:
      ConfigError: a group is missing, or has another shape than the contract says.
    """
    feeds, entries = {}, self._read(obs)
    for row in self.contract["policy"]["inputs"]:
      feeds[row["name"]] = np.asarray(entries[row["entry"]], row["type"]).reshape(-1, *row["shape"])
    output = self.contract["policy"]["output"]
    one = lambda *values: np.asarray(self._session.run([output], dict(zip(feeds, values, strict=True)))[0])
    out = np.concatenate([one(*values) for values in zip(*feeds.values(), strict=True)])
    return out.reshape(*self._batch(entries), -1)

  def act(self, policy: object, obs: Observation, key: jax.Array) -> jax.Array:
    """Returns the same actions inside jitted code, as evaluations call a policy."""
    del policy, key
    entries = self._read(obs)
    out = jax.ShapeDtypeStruct((*self._batch(entries), self.contract["policy"]["action_size"]), np.float32)
    return jax.pure_callback(self.actions, out, entries, vmap_method="broadcast_all")

  def latency(self, obs: Mapping[str, np.ndarray]) -> np.ndarray:
    """Returns the seconds of each inference on this machine, [N], for inputs by group [N, ...]."""
    seconds = []
    for i in range(*self._batch(obs)):
      row = {entry: values[i] for entry, values in obs.items()}
      began = time.perf_counter()
      self.actions(row)
      seconds.append(time.perf_counter() - began)
    return np.array(seconds)

  def _read(self, obs: Seen) -> dict[str, np.ndarray | jax.Array]:
    """Returns the groups that the actor reads; a flat observation counts as `state`."""
    entries = observation_groups(obs)
    for row in self.contract["policy"]["inputs"]:
      name, shape = row["entry"], tuple(row["shape"][1:])
      if name not in entries:
        raise ConfigError(f"The observation lacks {name}, which the policy reads: it has {', '.join(entries)}.")
      found = np.shape(entries[name])
      if found[len(found) - len(shape) :] != shape:
        sizes = ", ".join(map(str, shape))
        raise ConfigError(f"The policy reads {name} of the shape [..., {sizes}], not {list(found)}.")
    return {row["entry"]: entries[row["entry"]] for row in self.contract["policy"]["inputs"]}

  def _batch(self, entries: Mapping[str, np.ndarray | jax.Array]) -> tuple[int, ...]:
    """Returns the leading axes of groups."""
    row = self.contract["policy"]["inputs"][0]
    shape = np.shape(entries[row["entry"]])
    return shape[: len(shape) + 1 - len(row["shape"])]
