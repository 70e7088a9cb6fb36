"""What a task's config says of its physics backend. No JAX here: a command asks before it imports that."""

from collections.abc import Mapping
from typing import Any


def sees(env: Mapping[str, Any]) -> bool:
  """Whether a task of this `env` config sees through a camera."""
  return "vision" in env and env["vision"]["enable"]


def auto_impl(cuda_impl: str, renders: bool, on_gpu: bool) -> str:
  """What `impl: auto` means: the backend that was measured faster, or the one that renders."""
  return "warp" if renders else cuda_impl if on_gpu else "jax"
