"""Measures the public package's training, run by its own interpreter (`playground/benchmark/peer/`)."""

import json
import math
import os
import subprocess
import time
from collections.abc import Mapping
from typing import Any

from playground.benchmark.measures.machine import used_memory
from playground.benchmark.measures.runs import RESULT, emit_result, emit_returns
from playground.benchmark.measures.subject import alone
from playground.benchmark.peer import PEERS
from playground.benchmark.worker import Rows
from playground.errors import PlaygroundError
from playground.paper import SUITES, paper_table

EPOCHS = 4  # the first compiles, the second may compile again


class PeerFailedError(PlaygroundError):
  """The peer's process ended with an error."""


def rates(rows: Rows, task: str, seconds: float, backend: str, seeds: list[int], peer: dict[str, str]) -> None:
  """Emits rows for steps/s of the best epoch, time to the first update and memory, like `training` for ours."""
  (seed,) = seeds
  job = {"task": task, "backend": backend, "seed": seed, "steps": _epoch_steps(task, seconds), "epochs": EPOCHS}
  with used_memory(rows, seed):
    result = drive(rows, peer, job)
  epochs = result["epochs"]  # seconds of each
  best = result["epoch_steps"] / min(epochs[1:])
  first_update = result["start_s"] + epochs[0] - (result["epoch_steps"] - result["update_steps"]) / best
  rows["conditions"] = f"best of {len(epochs) - 1} epochs of {result['epoch_steps']:,} steps; {result['settings']}"
  rows.emit("start_to_first_update_s", first_update, "s", seed=seed)
  if result["peak_memory_gib"] is not None:
    rows.emit("peak_memory_gib", result["peak_memory_gib"], "GiB", seed=seed)
  rows.emit("training_steps_per_s", best, "steps/s", seed=seed)


def whole(
  rows: Rows, task: str, agent: str, num_timesteps: int | None, backend: str, setting: list[str], seeds: list[int],
  peer: dict[str, str],
) -> None:  # fmt: skip
  """Emits rows like `runs.whole` for ours, with the peer's own evaluations.

  The peer's wall-clock time includes compiling: it compiles its training while it runs.
  """
  (seed,) = seeds
  job = {"task": task, "agent": agent, "backend": backend, "seed": seed}
  job |= {"evaluate": True, "num_timesteps": num_timesteps}
  with alone(rows.lock):
    begin = time.perf_counter()
    result = drive(rows, peer, job)
    result["command_s"] = time.perf_counter() - begin
  when = "time from the end of the evaluation before training to that of the last, compiling the training in it"
  rows["conditions"] = f"a whole run, {when}; {result['settings']}"
  emit_returns(rows, result["evaluations"], setting, seed)
  trained = [score for step, score, _ in result["evaluations"] if step > 0]
  result |= {"best_return": max(trained), "final_return": trained[-1]}
  emit_result(rows, result, RESULT, seed=seed)


def drive(rows: Rows, peer: dict[str, str], job: Mapping[str, object]) -> dict[str, Any]:
  """Runs a job in the peer's driver, fills in the columns that its rows share, and returns the driver's result.

  Args:
    rows: columns of the rows.
    peer: `name`, `python` (interpreter), `path` (PYTHONPATH) and `menagerie` (folder of robot models) of the peer.
    job: the driver's argument.

  Raises:
    PeerFailedError: the driver failed, or was killed.
  """
  env = {**os.environ, "PYTHONPATH": peer["path"], "PEER_MENAGERIE": peer["menagerie"]}
  env.pop("JAX_COMPILATION_CACHE_DIR", None)  # the peer does not cache compiled programs
  command = [peer["python"], "-W", "ignore", str(PEERS[peer["name"]].driver), json.dumps(job)]
  done = subprocess.run(command, capture_output=True, text=True, errors="replace", env=env)
  lines = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")]
  if done.returncode or not lines:
    raise PeerFailedError(f"{peer['name']} failed: {(done.stderr.strip().splitlines() or ['no output'])[-1]}")
  result = json.loads(lines[-1].removeprefix("RESULT "))
  rows.update(backend=job["backend"], devices=1, precision="JAX's default", versions=result["versions"])
  return result


def _epoch_steps(task: str, seconds: float) -> int:
  """Returns the number of control steps that take about `seconds`, from the paper's rate on its A100."""
  rows = [row for suite in SUITES for row in paper_table(f"{suite}_throughput") if row["registry_env"] == task]
  rate = float(rows[0]["ppo_sps_mean"]) if rows else 250_000.0
  return math.ceil(1.5 * rate * seconds)
