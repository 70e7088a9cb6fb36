"""Playground: config-driven robot learning on GPU-batched MuJoCo."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
  from playground import registry
  from playground.adapters.migrate import dm_control_suite, locomotion, manipulation
  from playground.envs import wrappers as wrapper
  from playground.envs.wrappers import wrap_for_brax_training
  from playground.registry import load

__version__ = "0.1.0"
__all__ = [
  "__version__",
  "dm_control_suite",
  "load",
  "locomotion",
  "manipulation",
  "registry",
  "wrap_for_brax_training",
  "wrapper",
]

# Imported when first used, so that commands which need no JAX do not wait for it.
_LAZY = {
  "dm_control_suite": "playground.adapters.migrate:dm_control_suite",
  "load": "playground.registry:load",
  "locomotion": "playground.adapters.migrate:locomotion",
  "manipulation": "playground.adapters.migrate:manipulation",
  "registry": "playground.registry:",
  "wrap_for_brax_training": "playground.envs.wrappers:wrap_for_brax_training",
  "wrapper": "playground.envs.wrappers:",
}


def __getattr__(name: str) -> Any:
  if name not in _LAZY:
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
  module_name, _, attribute = _LAZY[name].partition(":")
  module = importlib.import_module(module_name)
  return getattr(module, attribute) if attribute else module
