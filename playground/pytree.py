"""The type of trees of arrays."""

from typing import Any

PyTree = Any  # nested dataclasses, dicts, tuples and None of arrays: JAX lets programs register more, so none is excluded
