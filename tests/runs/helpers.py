"""What the tests of whole runs share."""

import os
from pathlib import Path

from playground.config import compose
from playground.runs.train import train

TASK = ["env=CartpoleBalance", "tuned=null", "debug=fast", "hardware=cpu", "tracking=csv"]


def resume(run: Path) -> int:
  return train(compose([f"resume={run}"]))


def truncate(checkpoint: Path) -> None:
  """Halves the file that holds the arrays of the training state."""
  largest = max((p for p in (checkpoint / "state").rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)
  os.truncate(largest, largest.stat().st_size // 2)
