"""A fine-tuning curriculum from beginning to end: each stage's return and time."""

from pathlib import Path
from typing import Any

from playground.benchmark.measures.run import emit_result
from playground.benchmark.measures.startup import facts_of, run_training
from playground.benchmark.worker import Facts
from playground.runs.run_dir import RunDirectory


def measure(facts: Facts, experiment: str, overrides: list[str], runs: str, seeds: list[int], lock: str | None) -> None:
  """Rows for each stage, `stage=<name>`, and for all together, `stage=all`.

  An unfinished run of the same name is resumed; its times are sums over its starts.
  """
  del lock  # a chain has its device to itself
  (seed,) = seeds
  path = Path(runs) / f"{experiment}_seed_{seed}"
  chain = RunDirectory(path)
  if chain.status.get("status") != "finished":
    begun = chain.config_path.is_file()
    new = [f"experiment={experiment}", f"seed={seed}", "video.enable=false", *overrides, f"run_dir={path}"]
    run_training([f"resume={path}"] if begun else new)
  for stage in [*chain.summary["stages"], {**chain.summary, "name": "all"}]:
    run = chain if stage["name"] == "all" else RunDirectory(path / stage["folder"])
    columns: dict[str, Any] = {"seed": seed, "setting": " ".join((*overrides, f"stage={stage['name']}"))}
    columns |= facts_of(run.manifest) if run.manifest else {}
    columns["conditions"] = f"task {stage['env']}, evaluations included, compiling not"
    emit_result(facts, stage, ("steps", "final_return", "wall_clock_s"), **columns)
