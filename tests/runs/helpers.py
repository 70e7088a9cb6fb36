"""What the tests of whole runs share."""

import os
from collections.abc import Sequence
from pathlib import Path

from playground.config import compose
from playground.runs.run_dir import RunDirectory
from playground.runs.train import train
from playground.settings import Section

TASK = ["env=CartpoleBalance", "tuned=null", "debug=fast", "hardware=cpu", "tracking=csv"]


def make_run(path: str | Path, config: Section, overrides: Sequence[str] = (), numbered: bool = False) -> RunDirectory:
  """Returns a new run without a training; see `RunDirectory.claimed`."""
  with RunDirectory.claimed(path, numbered) as run:
    run.write_config(config, overrides)
  return run


def resume(run: Path) -> int:
  return train(compose([f"resume={run}"]))


def truncate(checkpoint: Path) -> None:
  """Halves the file that holds the arrays of the training state."""
  largest = max((p for p in (checkpoint / "state").rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)
  os.truncate(largest, largest.stat().st_size // 2)
