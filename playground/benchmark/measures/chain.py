"""A fine-tuning curriculum from beginning to end: each stage's return and time."""

import hashlib
import itertools
from pathlib import Path
from typing import Any

from playground.benchmark.measures.run import emit_result
from playground.benchmark.measures.startup import facts_of, run_training
from playground.benchmark.schema import commit_of
from playground.benchmark.worker import Facts
from playground.runs.run_dir import RunDirectory


def measure(
  facts: Facts, experiment: str, overrides: list[str], runs: str, again: bool, seeds: list[int], lock: str | None
) -> None:
  """Rows for each stage, `stage=<name>`, and for all together, `stage=all`.

  An unfinished run of the same experiment, overrides and seed is resumed; its times are sums over its starts. A
  finished one is read, and its commit is the rows', unless `again` wants a new one.
  """
  del lock  # a chain has its device to itself
  (seed,) = seeds
  chain = _run_of(Path(runs), experiment, overrides, seed, again)
  if not _finished(chain):
    begun = chain.config_path.is_file()
    new = [f"experiment={experiment}", f"seed={seed}", "video.enable=false", *overrides, f"run_dir={chain.path}"]
    run_training([f"resume={chain.path}"] if begun else new)
  for stage in [*chain.summary["stages"], {**chain.summary, "name": "all"}]:
    run = chain if stage["name"] == "all" else RunDirectory(chain.path / stage["folder"])
    columns: dict[str, Any] = {"seed": seed, "setting": " ".join((*overrides, f"stage={stage['name']}"))}
    columns |= facts_of(run.manifest) if run.manifest else {}
    if git := run.manifest.get("git"):
      columns["commit"] = commit_of(git)
    columns["conditions"] = f"task {stage['env']}, evaluations included, compiling not"
    emit_result(facts, stage, ("steps", "final_return", "wall_clock_s"), **columns)


def _run_of(runs: Path, experiment: str, overrides: list[str], seed: int, again: bool) -> RunDirectory:
  """The run directory, one for each set of overrides; if `again`, the first of the numbered that is not finished."""
  told = [hashlib.sha256(" ".join(overrides).encode()).hexdigest()[:8]] if overrides else []
  name = "_".join([experiment, *told, f"seed_{seed}"])
  numbered = (name if number == 1 else f"{name}_{number}" for number in itertools.count(1))
  return next(run for path in numbered if not _finished(run := RunDirectory(runs / path)) or not again)


def _finished(run: RunDirectory) -> bool:
  return run.status.get("status") == "finished"
