"""A training from beginning to end, `playground-run` itself: its evaluations' returns and its time."""

import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from playground.benchmark.measures.startup import facts_of, run_training
from playground.benchmark.measures.subject import alone
from playground.benchmark.worker import Facts
from playground.runs.run_dir import RunDirectory

RESULT = ("steps", "wall_clock_s", "training_steps_per_s", "best_return", "final_return")
_UNITS = {"steps": "steps", "wall_clock_s": "s", "training_steps_per_s": "steps/s"}
_RETURN, _TIME = "eval/episode_reward", "time/wall_clock_s"


def measure(
  facts: Facts, task: str, agent: str, overrides: list[str], told: list[str], seeds: list[int], lock: str | None
) -> None:
  """A row for each evaluation, `step=<steps trained>`, then those of the whole run, the last evaluation's return last.

  The whole run has the device to itself, its compiling too. `told` is the job's setting, to which an evaluation's row
  adds its step.
  """
  (seed,) = seeds
  with tempfile.TemporaryDirectory() as folder:
    run = RunDirectory(Path(folder) / "run")
    chosen = [f"env={task}", f"agent={agent}", *overrides, f"seed={seed}"]
    with alone(lock):
      run_training([*chosen, "video.enable=false", "tracking=csv", f"run_dir={run.path}"])
    facts.update(facts_of(run.manifest), conditions="a whole run, evaluations and saving in its time, compiling not")
    evaluations = pd.read_csv(run.metrics_csv).dropna(subset=[_RETURN])
    emit_returns(facts, evaluations[["step", _RETURN, _TIME]].itertuples(index=False), told, seed)
    result = {**run.summary, "training_steps_per_s": run.manifest["timings"]["steady_steps_per_second"]}
    emit_result(facts, result, RESULT, seed=seed)


def emit_returns(facts: Facts, evaluations: Iterable[Sequence[Any]], setting: Sequence[str], seed: int) -> None:
  """A row for each evaluation: (steps trained, mean return, seconds into the run)."""
  for step, score, seconds in evaluations:
    columns = {"setting": " ".join((*setting, f"step={step:.0f}")), "seed": seed}
    facts.emit("return", score, "", **columns, conditions=f"{facts['conditions']}; after {seconds:.1f} s")


def emit_result(facts: Facts, result: Mapping[str, Any], quantities: Sequence[str], **columns: Any) -> None:
  """A row for each quantity that the result of a run has, in their order."""
  for quantity in quantities:
    if result.get(quantity) is not None:
      facts.emit(quantity, result[quantity], _UNITS.get(quantity, ""), **columns)
