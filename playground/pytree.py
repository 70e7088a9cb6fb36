"""The type of trees of arrays."""

from typing import Any

# Nested dataclasses, dicts, tuples and None of arrays. Programs may register classes more, so JAX excludes none either.
PyTree = Any
