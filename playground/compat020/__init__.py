"""Playground 0.2.0 bug for bug: tasks `env=v020/<TaskName>`, whose functions equal the recordings in tests/golden.

A package of tasks like any other (entry point `playground.tasks`): config deltas, subclasses and functions. Nothing
else in this project knows it.
"""

from pathlib import Path

CONFIGS = Path(__file__).parent / "configs"
