"""The public package's PPO, run by its own interpreter (`playground/benchmark/peer/`)."""

import json
import math
import os
import subprocess
from typing import Any

from playground.benchmark.measures.machine import used_memory
from playground.benchmark.peer import PEERS
from playground.benchmark.worker import Facts
from playground.errors import PlaygroundError
from playground.paper import SUITES, paper_table

EPOCHS = 4  # the first compiles, the second may compile again


class PeerFailedError(PlaygroundError):
  """The peer's process ended with an error."""


def measure(
  facts: Facts,
  task: str,
  seconds: float,
  peer: str,
  python: str,
  path: str,
  menagerie: str,
  backend: str,
  seeds: list[int],
  lock: str | None,
) -> None:
  """Rows for the best epoch's steps a second, time to the first update and memory, as `training` has them of ours."""
  del lock  # a comparison has the machine to itself
  (seed,) = seeds
  job = {"task": task, "backend": backend, "seed": seed, "steps": _epoch_steps(task, seconds), "epochs": EPOCHS}
  with used_memory(facts, seed):
    result = drive(facts, peer, python, path, menagerie, job)
  epochs = result["epochs"]  # seconds of each
  best = result["epoch_steps"] / min(epochs[1:])
  first_update = result["start_s"] + epochs[0] - (result["epoch_steps"] - result["update_steps"]) / best
  facts["conditions"] = f"best of {len(epochs) - 1} epochs of {result['epoch_steps']:,} steps; {result['settings']}"
  facts.emit("start_to_first_update_s", first_update, "s", seed=seed)
  if result["peak_memory_gib"] is not None:
    facts.emit("peak_memory_gib", result["peak_memory_gib"], "GiB", seed=seed)
  facts.emit("training_steps_per_s", best, "steps/s", seed=seed)


def drive(facts: Facts, peer: str, python: str, path: str, menagerie: str, job: dict[str, Any]) -> dict[str, Any]:
  """Has the peer's driver do a job, and fills in the facts that its rows share.

  Raises:
    PeerFailedError: it ended with an error, or was ended.
  """
  env = {**os.environ, "PYTHONPATH": path, "PEER_MENAGERIE": menagerie}
  env.pop("JAX_COMPILATION_CACHE_DIR", None)  # the peer keeps no compiled programs
  command = [python, "-W", "ignore", str(PEERS[peer].driver), json.dumps(job)]
  done = subprocess.run(command, capture_output=True, text=True, errors="replace", env=env)
  lines = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")]
  if done.returncode or not lines:
    raise PeerFailedError(f"{peer} failed: {(done.stderr.strip().splitlines() or ['nothing said'])[-1]}")
  result = json.loads(lines[-1].removeprefix("RESULT "))
  facts.update(backend=job["backend"], devices=1, precision="JAX's default", versions=result["versions"])
  return result


def _epoch_steps(task: str, seconds: float) -> int:
  """Control steps that take about `seconds`, from the paper's rate on its A100."""
  rows = [row for suite in SUITES for row in paper_table(f"{suite}_throughput") if row["registry_env"] == task]
  rate = float(rows[0]["ppo_sps_mean"]) if rows else 250_000.0
  return math.ceil(1.5 * rate * seconds)
