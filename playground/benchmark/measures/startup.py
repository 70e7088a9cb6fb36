"""From the command to the first update: `playground-run` itself, with caches of its own, empty and then full."""

import os
import signal
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from playground.benchmark.worker import Facts
from playground.config import RunConfig, compose
from playground.errors import PlaygroundError
from playground.interpreter import PYTHON
from playground.learning.hyperparameters import config_class
from playground.runs.run_dir import RunDirectory

# Of the environment: they would take the place of the run's own.
_CACHES = ("JAX_COMPILATION_CACHE_DIR", "WARP_CACHE_PATH")


class RunFailedError(PlaygroundError):
  """The command ended with an error."""


def measure(facts: Facts, task: str, agent: str, overrides: list[str], seconds: float, lock: str | None) -> None:
  """Rows `cold` and `warm`: the same command twice in fresh processes, its budget cut to the first update that learns.

  Evaluation is compiled, and the one before training is run, as in any run.
  """
  del seconds, lock  # this times one run as it is
  chosen = [f"env={task}", f"agent={agent}", *overrides]
  with tempfile.TemporaryDirectory() as folder:
    short = [f"agent.num_timesteps={_one_update(compose(chosen))}", "agent.num_evals=2", "agent.num_resets_per_eval=0"]
    short += ["video.enable=false", "tracking=csv", f"hardware.cache_dir={folder}/cache"]
    for name in ("cold", "warm"):
      run = Path(folder) / name
      run_training([*chosen, *short, f"run_dir={run}"], without=_CACHES)
      manifest = RunDirectory(run).manifest
      facts.update(facts_of(manifest), conditions="whole command, evaluations included, one update, a cache of its own")
      for quantity in ("trace_s", "compile_s", "start_to_first_update_s"):
        facts.emit(quantity, manifest["timings"][quantity], "s", setting=" ".join((*overrides, name)))


def run_training(overrides: list[str], without: tuple[str, ...] = ()) -> None:
  """Runs `playground-run` in a process of its own; raises RunFailedError with its last line."""
  signal.signal(signal.SIGTERM, lambda *_: None)  # the run gets it, too, and saves: this process waits for that
  env = {key: value for key, value in os.environ.items() if key not in without}
  command = [*PYTHON, "-W", "ignore", "-c", "from playground.cli.run import main; main()", *overrides]
  done = subprocess.run(command, capture_output=True, text=True, errors="replace", env=env)
  if done.returncode:
    lines = (done.stderr or done.stdout).strip().splitlines()
    raise RunFailedError(f"playground-run ended with code {done.returncode}: {lines[-1] if lines else 'nothing said'}")


def facts_of(manifest: Mapping[str, Any]) -> dict[str, Any]:
  """Columns of a row, from a run's manifest."""
  precision = f"physics {manifest['matmul_precision']}, networks {manifest['network_precision']}"
  return {"backend": manifest["impl"], "devices": manifest["num_devices"], "precision": precision}


def _one_update(config: RunConfig) -> int:
  """The budget (control steps) with which something is learned once."""
  settings = config_class(config.agent.name).from_config(config.agent)
  return (settings.prefill_updates + 1) * settings.steps_per_update * config.env.action_repeat
