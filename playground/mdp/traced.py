"""Numbers of terms that compiled programs take as arguments: a new value compiles nothing, and agents may differ.

They are the weights of rewards, the noise of observations, and those parameters of this package's commands and of its
reset and interval events that are numbers or ranges. A 0 stays a constant, so that its term is not computed. The
weights of `reward_total: product` stay constants, as their signs decide the formula.
"""

import inspect
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from playground.limits import Limit
from playground.mdp.managers import ObservationManager
from playground.mdp.terms import MODULES, Term, annotation, bind
from playground.settings import Section, members


def traced_settings(config: Section, kinds: Sequence[str]) -> dict[str, np.ndarray]:
  """Returns the numbers of the terms of some kinds in a task's config.

  Returns:
    By dotted key, such as `rewards.action_rate_l2.weight`, float32 arrays: of shape [], or of a list [numbers].

  Raises:
    ConfigError: as `terms.bind`.
  """
  traced = (pair for kind in kinds for term in _terms(config, kind) for pair in _numbers(config, kind, term))
  found = {key.removeprefix("env."): np.asarray(value, np.float32) for key, value in traced}
  return {key: value for key, value in found.items() if value.any()}


def _terms(config: Section, kind: str) -> list[Term]:
  return ObservationManager(config).terms if kind == "observations" else bind(kind, config.get(kind))


def _numbers(config: Section, kind: str, term: Term) -> Iterator[tuple[str, Any]]:
  if kind == "rewards" and config.get("reward_total") != "product":
    yield f"{term.key}.weight", term.options.weight
  if kind == "observations":
    yield from (
      (f"{term.key}.noise.{name}", size) for name, size in (term.options.noise or {}).items() if name != "same_as"
    )
  # A function of another package may branch on a number in Python.
  if kind in ("commands", "events") and term.func.__module__ == MODULES[kind]:
    arguments = inspect.signature(term.func).parameters
    traced = [name for name in term.params if _is_traced(kind, term.func, arguments[name])]
    yield from ((f"{term.key}.params.{name}", term.params[name]) for name in traced)


def _is_traced(kind: str, func: Callable[..., Any], argument: inspect.Parameter) -> bool:
  options = members(annotation(func, argument))
  if kind == "commands":
    return any("float" in str(option) for option in options)
  limits = [entry for o in options for entry in getattr(o, "__metadata__", ()) if isinstance(entry, Limit)]
  return float in options or any(not limit.whole and (limit.form == "number" or limit.rising) for limit in limits)
