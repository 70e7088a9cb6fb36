"""Parameters of which `make test` takes some, and `make test-slow` the others."""

from collections.abc import Iterable
from typing import Any

import pytest


def some(values: Iterable[Any], every: int) -> list[Any]:
  """Returns all values as parameters; all but one in so many are slow."""
  return [pytest.param(value, marks=[pytest.mark.slow] * (i % every != 0)) for i, value in enumerate(values)]
