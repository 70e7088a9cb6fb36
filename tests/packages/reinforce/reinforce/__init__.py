"""REINFORCE for playground-run."""

from pathlib import Path

CONFIGS = Path(__file__).parent / "configs"
