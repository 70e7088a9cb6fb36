"""Playground: config-driven robot learning on GPU-batched MuJoCo."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
  from playground import registry
  from playground.envs.wrappers import wrap_for_brax_training
  from playground.registry import load

__version__ = "0.1.0"
__all__ = ["__version__", "load", "registry", "wrap_for_brax_training"]

# Imported when first used, so that commands which need no JAX do not wait for it.
_LAZY = {
  "load": "playground.registry:load",
  "registry": "playground.registry:",
  "wrap_for_brax_training": "playground.envs.wrappers:wrap_for_brax_training",
}


def __getattr__(name: str) -> Any:
  if name not in _LAZY:
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
  module_name, _, attribute = _LAZY[name].partition(":")
  module = importlib.import_module(module_name)
  return getattr(module, attribute) if attribute else module
