"""Managers: each computes the terms of one kind. `playground.envs.task.Task` calls them in every step."""

import copy
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Self, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from playground.errors import ConfigError, UnknownNameError, lookup, nearest
from playground.limits import at_least_0
from playground.mdp import delays
from playground.mdp.context import StepContext
from playground.mdp.options import ObservationOptions, is_model_field
from playground.mdp.terms import Term, bind, bind_one
from playground.physics.backend import PhysicsData
from playground.settings import below
from playground.text import format_value

ACTOR = "state"  # the observation group that the policy reads: noisy; the other groups are exact
Info = dict[str, Any]
_WHEN = ("command_above", "command_below")
_NOISE = ("uniform", "gaussian", "same_as")
Settings = Mapping[str, jax.Array]  # numbers in place of the config's, by key (`playground.mdp.traced`)
_Generator = TypeVar("_Generator")


class RewardManager:
  """Weighted reward terms."""

  def __init__(self, section: Mapping[str, Any]):
    """Binds `env.rewards`; raises as `terms.bind`."""
    terms = bind("rewards", section)
    for term in terms:
      for name, value in (term.options.when or {}).items():
        key = f"{term.key}.when.{name}"
        if name not in _WHEN:
          raise UnknownNameError(f"{key} does not exist: choose {' or '.join(_WHEN)}.{nearest(name, _WHEN)}")
        if not at_least_0().allows(value):
          raise ConfigError(f"{key}={format_value(value)} must be {at_least_0()}.")
    self.terms = [term for term in terms if term.options.weight != 0]

  def with_settings(self, values: Settings) -> Self:
    """Returns the same terms with other weights, `<term>.weight`."""
    other = copy.copy(self)
    other.terms = _terms_with(self.terms, values)
    return other

  def compute(self, c: StepContext) -> dict[str, jax.Array]:
    """Returns weight * value of each term, by name, each shape []."""
    return {term.name: term.options.weight * _when(term.options.when, c, term(c)) for term in self.terms}


def _when(condition: Mapping[str, float] | None, c: StepContext, value: jax.Array) -> jax.Array:
  for name, bound in (condition or {}).items():
    speed = jnp.linalg.norm(c.command)
    value = value * (speed > bound if name == "command_above" else speed < bound)
  return value


class TerminationManager:
  """Reasons to end an episode."""

  def __init__(self, section: Mapping[str, Any]):
    """Binds `env.terminations`; raises as `terms.bind`."""
    self.terms = bind("terminations", section)

  def compute(self, c: StepContext) -> dict[str, jax.Array]:
    """Returns whether each term ends the episode, by name, each a bool of shape []."""
    return {term.name: term(c) for term in self.terms}

  def any(self, c: StepContext) -> jax.Array:
    """Returns whether any term ends the episode, a bool of shape []."""
    return jnp.array(list(self.compute(c).values()), bool).any()


class ObservationManager:
  """Concatenates the terms of each observation group. Noise, delays and history keep their state in `info`.

  The entry `state: {}` of another group stands for the whole of the group `state`, as the policy reads it.

  Attributes:
    groups: the terms of each group, the group `state` first; an empty group is left out.
  """

  def __init__(
    self,
    section: Mapping[str, Any],
    noise_level: float = 1.0,
    frames: int = 1,
    order: Mapping[str, Any] | None = None,
  ):
    """Binds `env.observations`; raises as `terms.bind`. The other arguments are those of `TermsConfig`."""
    self._level = noise_level
    self._frames = frames
    self.groups: dict[str, list[Term]] = {}
    for group in sorted(section, key=lambda name: (name != ACTOR, name)):
      entries = {name: entry for name, entry in (section[group] or {}).items() if entry is not None}
      first = list((order or {}).get(group) or ())
      for name in first:
        lookup(entries, name, f"env.observation_order.{group}")
      noisy: list[str] = []
      for name in dict.fromkeys([*first, *entries]):
        term = _bind_observation(group, name, entries[name], noisy)
        noisy += [name] if term.options.noise and "same_as" not in term.options.noise else []
        self.groups.setdefault(group, []).append(term)
    if ACTOR not in self.groups:
      raise ConfigError(f"env.observations.{ACTOR} is missing or empty: the policy would read nothing.")

  def with_settings(self, values: Settings) -> Self:
    """Returns the same terms with other noise, `<group>.<term>.noise.<kind>`."""
    other = copy.copy(self)
    other.groups = {group: _terms_with(terms, below(group, values)) for group, terms in self.groups.items()}
    return other

  def compute(self, c: StepContext, key: jax.Array, buffers: Info | None = None) -> tuple[Any, Info]:
    """Returns the observation and the buffers for the next step; `buffers` is None at the start of an episode.

    The observation is a dict of vectors by group, or one vector where `state` is the only group.
    """
    past: Info = {}
    obs: dict[str, jax.Array] = {}
    for group, terms in self.groups.items():
      drawn: dict[str, jax.Array] = {}
      parts = []
      for term in terms:
        if _is_actor(group, term):
          parts.append(obs[ACTOR])
          continue
        noise_key = delay_key = key
        if term.options.noise or term.options.delay:  # the others draw nothing
          key, noise_key, delay_key = jax.random.split(key, 3)
        value = self._read(term, c, noise_key, drawn)
        if _depth(term) > 1:
          name = f"{group}/{term.name}"
          value, past[name] = _look_back(term, value, delay_key, None if buffers is None else buffers[name])
        parts.append(value.ravel())
      obs[group] = jnp.concatenate(parts)
      if group == ACTOR and self._frames > 1:
        empty = jnp.zeros((self._frames, obs[group].size))
        past[group] = delays.push(empty if buffers is None else buffers[group], obs[group])
        obs[group] = past[group].ravel()
    return obs if len(obs) > 1 else obs[ACTOR], past

  def _read(self, term: Term, c: StepContext, key: jax.Array, drawn: dict[str, jax.Array]) -> jax.Array:
    value, options = jnp.asarray(term(c), float).ravel(), term.options
    kind, size = next(iter(options.noise.items())) if options.noise else (None, 0.0)
    if kind == "same_as":
      value = value + drawn[str(size)]
    elif kind is not None:
      pattern = self._level * _per_element(f"{term.name}.noise.{kind}", size, value.size)
      # A level of 0 computes nothing, and a setting (an array of JAX) is none unless the level of all noise is.
      if self._level and (isinstance(pattern, jax.Array) or pattern.any()):
        uniform = kind == "uniform"
        draw = jax.random.uniform(key, value.shape) * 2 - 1 if uniform else jax.random.normal(key, value.shape)
        drawn[term.name] = jnp.asarray(pattern) * draw
        value = value + drawn[term.name]
      else:
        drawn[term.name] = jnp.zeros_like(value)
    value = value if options.clip is None else jnp.clip(value, *options.clip)
    return value if options.scale is None else value * _per_element(f"{term.name}.scale", options.scale, value.size)

  def sizes(self, first: Callable[[], StepContext]) -> dict[str, dict[str, int]]:
    """Returns the length of each term, by group, from a context that is only traced.

    With frames the terms are those of the newest step, and `past_frames` are the others.
    """
    found: dict[str, dict[str, int]] = {}

    def trace() -> None:
      c = first()
      for group, terms in self.groups.items():
        sizes = {}
        for term in terms:
          actor = _is_actor(group, term)
          sizes[term.name] = sum(found[ACTOR].values()) if actor else term(c).size * term.options.history
        found[group] = sizes
        if group == ACTOR and self._frames > 1:
          found[group] = sizes | {"past_frames": (self._frames - 1) * sum(sizes.values())}

    jax.eval_shape(trace)
    return found


def _bind_observation(group: str, name: str, entry: Any, noisy: list[str]) -> Term:
  """Binds a term; `noisy` are those above it in its group that have noise of their own."""
  key = f"env.observations.{group}.{name}"
  if group != ACTOR and name == ACTOR and not dict(entry.items() if hasattr(entry, "items") else {"func": entry}):
    return Term(name, key, lambda c: None, {}, ObservationOptions())
  term = bind_one("observations", key, name, entry)
  if term.options.noise is None:
    return term
  noise = term.options.noise
  if not isinstance(noise, dict) or len(noise) != 1 or not set(noise) <= {*_NOISE}:
    raise ConfigError(f"{key}.noise={noise!r} must have one of the keys {', '.join(_NOISE)}.")
  kind, size = next(iter(noise.items()))
  if kind == "same_as" and size not in noisy:
    raise UnknownNameError(f"{key}.noise.{kind}={size} is no term with noise above it.{nearest(str(size), noisy)}")
  if kind != "same_as" and not at_least_0().each.allows(size):
    raise ConfigError(f"{key}.noise.{kind}={format_value(size)} must be {at_least_0().each}.")
  return term


def _per_element(name: str, numbers: Any, size: int) -> np.ndarray | jax.Array:
  """A number or a list of numbers for each of `size` elements; a shorter list repeats. Raises ConfigError."""
  count = np.size(numbers)
  if size % count:
    raise ConfigError(f"env.observations: {name} has {count} numbers, which do not divide its {size} elements.")
  return (jnp if isinstance(numbers, jax.Array) else np).tile(numbers, size // count)


def _is_actor(group: str, term: Term) -> bool:
  return group != ACTOR and term.name == ACTOR


def _depth(term: Term) -> int:
  """How many values of a term are kept."""
  delay = term.options.delay
  return term.options.history + (delay[1] if delay else 0)


def _look_back(term: Term, value: jax.Array, key: jax.Array, buffer: jax.Array | None) -> tuple[jax.Array, jax.Array]:
  """A term's late value or its history, and the buffer for the next step."""
  delay, depth = term.options.delay, _depth(term)
  if buffer is None:  # a delayed sensor has read the start for long; a history has no past
    buffer = delays.start(value, depth) if delay else jnp.zeros((depth, *value.shape), value.dtype)
  buffer = delays.push(buffer, value)
  if not delay:
    return buffer, buffer
  return jax.lax.dynamic_slice_in_dim(buffer, delays.draw_delay(key, delay), term.options.history), buffer


class CommandManager:
  """Generators of commands: each is an object with `reset` and `step` (see `playground.mdp.commands`)."""

  def __init__(self, section: Mapping[str, Any], env: Any):
    """Binds `env.commands` and builds each generator with its parameters; raises as `terms.bind`."""
    self.terms = bind("commands", section)
    self._generators = [term() for term in self.terms]
    for generator in self._generators:
      generator.bind(env)

  def with_settings(self, values: Settings) -> Self:
    """Returns the same generators with other parameters, `<term>.params.<name>`."""
    other = copy.copy(self)
    pairs = zip(self.terms, self._generators, strict=True)
    other._generators = [_generator_with(generator, below(term.name, values)) for term, generator in pairs]
    return other

  def reset(self, key: jax.Array) -> Info:
    """Returns the entries of `info` that an episode starts with."""
    return _union(generator.reset(k) for generator, k in _with_keys(self._generators, key))

  def step(self, c: StepContext, key: jax.Array) -> Info:
    """Returns the entries of `info` for the next step."""
    return _union(generator.step(c, k) for generator, k in _with_keys(self._generators, key))


class EventManager:
  """What acts on the simulation from outside: on its start state and while it runs.

  Model fields of mode `startup` are the trainers' (`playground.randomization`), which hand them to `reset` and `step`.

  Attributes:
    resets: the terms of mode reset.
  """

  def __init__(self, section: Mapping[str, Any], env: Any):
    """Binds `env.events`; raises as `terms.bind`."""
    self.resets: list[Term] = []
    self._intervals: dict[str, tuple[Any, bool]] = {}  # and whether it is enabled
    for name, entry in (section or {}).items():
      if entry is None or is_model_field(name, entry):
        continue
      term = bind_one("events", f"env.events.{name}", name, entry)
      if term.options.mode not in ("reset", "interval"):
        raise ConfigError(f"env.events.{name}.mode={term.options.mode}: only func model_field has the mode startup.")
      if isinstance(term.func, type) != (term.options.mode == "interval"):
        mode = "interval" if isinstance(term.func, type) else "reset"
        raise ConfigError(f"env.events.{name}.mode={term.options.mode}: {term.func.__name__} is for mode: {mode}.")
      if term.options.mode == "interval":
        event = term.func(**term.params)
        event.bind(env)
        self._intervals[name] = event, term.options.enabled
      elif term.options.enabled:
        self.resets.append(term)

  def with_settings(self, values: Settings) -> Self:
    """Returns the same events with other parameters, `<term>.params.<name>`."""
    other = copy.copy(self)
    other.resets = _terms_with(self.resets, values)
    other._intervals = {
      name: (_generator_with(event, below(name, values)), enabled) for name, (event, enabled) in self._intervals.items()
    }
    return other

  def start(self, key: jax.Array, env: Any, initial: Any) -> Any:
    """Applies the reset events, in order, to the state that an episode starts with."""
    for term, k in _with_keys(self.resets, key):
      initial = term.func(k, env, initial, **term.params)
    return initial

  def reset(self, key: jax.Array, model: Any) -> Info:
    """Returns the entries of `info` of the interval events that an episode starts with."""
    return _union(event.reset(k, model) for (event, _), k in _with_keys([*self._intervals.values()], key))

  def step(self, data: PhysicsData, info: Mapping[str, Any]) -> tuple[PhysicsData, Info]:
    """Returns the physics after the interval events, and `info`."""
    changed = dict(info)
    for event, enabled in self._intervals.values():
      if enabled:
        data, entries = event.step(data, changed)
        changed |= entries
    return data, changed


def _terms_with(terms: Iterable[Term], values: Settings) -> list[Term]:
  return [term.with_settings(below(term.name, values)) for term in terms]


def _generator_with(generator: _Generator, values: Settings) -> _Generator:
  """The same command or event with other values of its fields, what `bind` found included."""
  other = copy.copy(generator)
  for name, value in below("params", values).items():
    setattr(other, name, value)
  return other


def _with_keys(terms: list[Any], key: jax.Array) -> Iterable[tuple[Any, jax.Array]]:
  """Each term with a random key of its own."""
  return zip(terms, jax.random.split(key, len(terms)) if terms else (), strict=True)


def _union(parts: Iterable[Info]) -> Info:
  return {name: value for part in parts for name, value in part.items()}
