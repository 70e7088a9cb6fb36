"""What the tests of whole runs share."""

from pathlib import Path

from playground.config import compose
from playground.runs.train import train

TASK = ["env=CartpoleBalance", "tuned=null", "debug=fast", "hardware=cpu", "tracking=csv"]


def resume(run: Path) -> int:
  return train(compose([f"resume={run}"]))
