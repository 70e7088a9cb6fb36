"""Numbers of terms that compiled programs take as arguments: another value compiles nothing, and agents may differ.

They are the weights of rewards, the noise of observations, and those parameters of this package's commands and of its
reset and interval events that are numbers or ranges. A 0 stays a constant, for what it switches off is not computed;
so do the weights of `reward_total: product`, which goes by their signs.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from playground.limits import Limit
from playground.mdp.options import is_model_field
from playground.mdp.terms import MODULES, Term, annotation, bind_one
from playground.settings import members


def traced_settings(config: Mapping[str, Any], kinds: Sequence[str]) -> dict[str, np.ndarray]:
  """Returns the numbers of the terms of some kinds in a task's config.

  Returns:
    By dotted key, such as `rewards.action_rate_l2.weight`, float32 arrays: of shape [], or of a list [numbers].

  Raises:
    ConfigError: as `terms.bind_one`.
  """
  found = {key: np.asarray(value, np.float32) for kind in kinds for key, value in _numbers(config, kind)}
  return {key: value for key, value in found.items() if value.any()}


def _numbers(config: Mapping[str, Any], kind: str) -> Iterator[tuple[str, Any]]:
  for key, entry in _entries(config, kind):
    if entry is None or (kind == "events" and is_model_field(key, entry)):
      continue
    if kind == "observations" and not entry.get("noise"):  # `state: {}` of another group names no function
      continue
    term = bind_one(kind, f"env.{key}", key.rpartition(".")[2], entry)
    if kind == "rewards" and config.get("reward_total") != "product":
      yield f"{key}.weight", term.options.weight
    if kind == "observations":
      yield from ((f"{key}.noise.{name}", size) for name, size in term.options.noise.items() if name != "same_as")
    if kind in ("commands", "events"):
      yield from ((f"{key}.params.{name}", value) for name, value in _parameters(kind, term))


def _entries(config: Mapping[str, Any], kind: str) -> Iterator[tuple[str, Any]]:
  """The entries of terms by key, without the first part `env`."""
  for name, entry in (config.get(kind) or {}).items():
    if kind == "observations":
      yield from ((f"{kind}.{name}.{term}", each) for term, each in (entry or {}).items())
    else:
      yield f"{kind}.{name}", entry


def _parameters(kind: str, term: Term) -> Iterator[tuple[str, Any]]:
  if term.func.__module__ != MODULES[kind]:  # another package's function may decide by a number what it computes
    return
  arguments = inspect.signature(term.func).parameters
  for name, value in term.params.items():
    if _is_traced(kind, term.func, arguments[name]):
      yield name, value


def _is_traced(kind: str, func: Callable[..., Any], argument: inspect.Parameter) -> bool:
  options = members(annotation(func, argument))
  if kind == "commands":
    return any("float" in str(option) for option in options)
  limits = [entry for o in options for entry in getattr(o, "__metadata__", ()) if isinstance(entry, Limit)]
  return float in options or any(not limit.whole and (limit.form == "number" or limit.rising) for limit in limits)
