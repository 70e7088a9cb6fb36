"""`playground export <run>`: writes `policy.onnx` and `policy.yaml` if they match the trained policy."""

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import yaml

from playground.deploy.contract import Contract, read_contract
from playground.deploy.policy import ExportedPolicy
from playground.deploy.trained import export_policy, load_exact, record
from playground.errors import ConfigError, PlaygroundError
from playground.extras import need
from playground.files import need_folder, replacing, write_text
from playground.learning.checkpoints import of_a_better_one

TOLERANCE = 1e-5  # largest difference between an exported and a trained policy's actions
_ENVS, _DECISIONS = 8, 125  # 1000 observations


class ParityError(PlaygroundError):
  """The actions of an exported policy differ from those of the trained one."""


def export_run(path: str, *, out: str | None = None) -> int:
  """Exports a run's newest checkpoint, or the one at `path`.

  The exported policy must return the trained policy's actions on 1000 observations in C MuJoCo.

  Args:
    path: a run directory, or one of its checkpoints.
    out: the folder to write to; by default `export/` in the run directory.

  Returns:
    The exit code, 0.

  Raises:
    ParityError: the exported policy's actions differ; nothing is written.
    PlaygroundError: no such run or checkpoint, a policy without an ONNX form, or a folder that is not writable or holds
      the policy of another task.
  """
  need("deploy", "onnx", "onnxruntime")
  folder = Path(os.path.expanduser(out)) if out else None
  if folder:
    need_folder(folder, f"--out={out}")
  trained = load_exact(path)
  if folder is None:
    folder = trained.run_dir.path / "export"
    need_folder(folder, str(folder), trained.run_dir.path)
  _check_task(folder, trained.task)
  obs, actions, state = record(trained, _ENVS, _DECISIONS)
  exported = export_policy(trained, state)
  error = check_parity(exported, obs, actions)
  folder.mkdir(parents=True, exist_ok=True)
  # The contract is written first. It has the model's hash, so loading refuses the pair of files that remains if the
  # process ends between the two, even over an older export without a hash.
  write_text(folder / "policy.yaml", _yaml(exported.contract))
  with replacing(folder / "policy.onnx") as temporary:
    temporary.write_bytes(exported.model)
  for sentence in of_a_better_one(path, trained.checkpoint):
    print(sentence)
  print(_summary(exported.contract, len(actions), error, 1e6 * exported.latency(obs)))
  print(f"written to {folder / 'policy.onnx'} and policy.yaml")
  return 0


def _check_task(folder: Path, task: str) -> None:
  """Raises ConfigError where a folder holds the policy of another task, which an export would replace."""
  try:
    there = read_contract(folder / "policy.yaml") or {}
  except OSError:  # none
    return
  if (other := there.get("task", task)) != task:
    raise ConfigError(f"{folder} holds a policy of {other}, not of {task}: give another folder, --out=<folder>.")


def check_parity(exported: ExportedPolicy, obs: Mapping[str, np.ndarray], actions: np.ndarray) -> float:
  """Returns the largest absolute difference between an exported policy's actions and those of the trained one.

  Args:
    exported: the policy to check.
    obs: inputs of the actor by group, [N, ...].
    actions: the trained policy's, [N, action_size].

  Raises:
    ParityError: the difference is above `TOLERANCE`, or NaN.
  """
  error = float(np.abs(exported.actions(obs) - actions).max())
  if not error <= TOLERANCE:
    difference = f"differ by {error:.1e}, more than {TOLERANCE:g}"
    raise ParityError(f"The exported policy's actions {difference}: nothing is written.")
  return error


def _yaml(contract: Contract) -> str:
  return yaml.safe_dump(contract, sort_keys=False, default_flow_style=None, width=120, allow_unicode=True)


def _summary(contract: Contract, count: int, error: float, micros: np.ndarray) -> str:
  policy, rate = contract["policy"], contract["rate_hz"]
  shapes = [row["shape"][1:] for row in policy["inputs"]]
  seen = [f"{s[0]} numbers" if len(s) == 1 else f"images of {' x '.join(map(str, s))}" for s in shapes]
  sizes = f"{' and '.join(seen)} in, {policy['action_size']} out"
  return (
    f"{contract['task']}, {contract['origin']['steps']:,} steps trained: {sizes}\n"
    f"same actions on {count} observations of its own in C MuJoCo: largest difference {error:.1e}\n"
    f"inference on one core here: {np.median(micros):.0f} µs (median), {np.quantile(micros, 0.99):.0f} µs (99 %) "
    f"of the {1e6 / rate:,.0f} µs of a step at {rate:g} Hz"
  )
