"""Terms of my own."""

from pathlib import Path

CONFIGS = Path(__file__).parent / "configs"
