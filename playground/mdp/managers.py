"""Managers: each computes the terms of one kind. `playground.envs.task.Task` calls them in every step."""

import copy
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np

from playground.errors import ConfigError, UnknownNameError, lookup, nearest
from playground.limits import at_least_0
from playground.mdp import delays
from playground.mdp.context import StepContext
from playground.mdp.options import ObservationOptions
from playground.mdp.terms import Term, bind, bind_one, plain
from playground.physics.backend import PhysicsData, mjx
from playground.text import format_value

ACTOR = "state"  # the observation group that the policy reads: noisy; the other groups are exact
Info = dict[str, Any]
_WHEN = ("command_above", "command_below")
_NOISE = ("uniform", "gaussian", "same_as")


class _Manager:
  """Terms of one kind.

  Attributes:
    groups: the terms of each group, in their order; kinds that have no groups have one, named as the kind.
  """

  groups: dict[str, list[Term]]

  @property
  def terms(self) -> list[Term]:
    """The terms of all groups."""
    return [term for terms in self.groups.values() for term in terms]

  def with_settings(self, values: Mapping[str, jax.Array]) -> Self:
    """Returns the same terms with other numbers, by their keys in the task's config (`playground.mdp.traced`)."""
    other = copy.copy(self)
    other.groups = {name: [term.with_settings(values) for term in terms] for name, terms in self.groups.items()}
    return other


class RewardManager(_Manager):
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
    self.groups = {"rewards": [term for term in terms if term.options.weight != 0]}

  def compute(self, c: StepContext) -> dict[str, jax.Array]:
    """Returns weight * value of each term, by name, each shape []."""
    return {term.name: term.options.weight * _value(term, c) for term in self.terms}


def _value(term: Term, c: StepContext) -> jax.Array:
  """The value of a reward term, 0 where its `when` is not met."""
  value = term.scalar(c)
  for name, bound in (term.options.when or {}).items():
    with term.reading(c):
      speed = jnp.linalg.norm(c.command)
    value = value * (speed > bound if name == "command_above" else speed < bound)
  return value


TIME_OUT = "time_out"  # entry of `info`: 1 where nothing but terms with `time_out` ends the episode; if there are any


class TerminationManager(_Manager):
  """Reasons to end an episode."""

  def __init__(self, section: Mapping[str, Any]):
    """Binds `env.terminations`; raises as `terms.bind`."""
    self.groups = {"terminations": bind("terminations", section)}
    self._has_time_out = any(term.options.time_out for term in self.terms)

  def compute(self, c: StepContext) -> dict[str, jax.Array]:
    """Returns whether each term ends the episode, by name, each a bool of shape []."""
    values = {term.name: term.scalar(c) for term in self.terms}
    for term in self.terms:
      kind = values[term.name].dtype
      if not jnp.issubdtype(kind, jnp.bool_):  # any number but 0 would end the episode
        raise ConfigError(f"{term.key} must return a bool, and returns {kind}: compare it with a limit.")
    return values

  def any(self, c: StepContext, time_out: bool = False) -> jax.Array:
    """Returns whether any of the terms with that `time_out` ends the episode, a bool of shape []."""
    values = self.compute(c)
    return jnp.array([values[term.name] for term in self.terms if term.options.time_out == time_out], bool).any()

  def start(self) -> Info:
    """Returns the entries of `info` at the start of an episode."""
    return {TIME_OUT: jnp.zeros(())} if self._has_time_out else {}

  def end(self, c: StepContext) -> tuple[jax.Array, Info]:
    """Returns whether the episode ends, 0 or 1, shape [], and the entries of `info` after the step."""
    terminated = c.terminated
    if not self._has_time_out:
      return terminated.astype(jnp.float32), {}
    cut = self.any(c, time_out=True) & ~terminated
    return (terminated | cut).astype(jnp.float32), {TIME_OUT: cut.astype(jnp.float32)}


class ObservationManager(_Manager):
  """Concatenates the terms of each observation group. Noise, delays and history keep their state in `info`.

  The entry `state: {}` of another group stands for the whole of the group `state`, as the policy reads it.
  The group `state` is the first of `groups`; an empty group is left out.
  """

  def __init__(self, config: Any, delay: tuple[int, int] | None = None):
    """Binds `observations` of a task's config, with the settings of `TermsConfig`; raises as `terms.bind`.

    `delay` = (lowest, highest) delays the whole group `state` by a number of steps that is drawn in each step, both
    ends included. The buffer starts filled with the episode's first observation.
    """
    section, order = getattr(config, "observations", None) or {}, config.observation_order or {}
    self._delay = delay
    self._level: float = config.noise_level
    self._frames: int = config.observation_frames
    self.groups = {}
    for group in order:
      lookup(section, group, "env.observation_order")
    for group in sorted(section, key=lambda name: (name != ACTOR, name)):
      entries = {name: entry for name, entry in (section[group] or {}).items() if entry is not None}
      first = list(order.get(group) or ())
      for name in first:
        lookup(entries, name, f"env.observation_order.{group}")
      noisy: list[str] = []
      for name in dict.fromkeys([*first, *entries]):
        term = _bind_observation(group, name, entries, noisy)
        noisy += [name] if term.options.noise and "same_as" not in term.options.noise else []
        self.groups.setdefault(group, []).append(term)
    if ACTOR not in self.groups:
      raise ConfigError(f"env.observations.{ACTOR} is missing or empty: the policy would read nothing.")

  def compute(self, c: StepContext, key: jax.Array, buffers: Info | None = None) -> tuple[Any, Info]:
    """Returns the observation and the buffers for the next step; `buffers` is None at the start of an episode.

    The observation is a dict of vectors by group, or one vector where `state` is the only group.
    """
    past: Info = {}
    obs: dict[str, jax.Array] = {}
    whole_key = key
    if self._delay:
      key, whole_key = jax.random.split(key)
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
      if group == ACTOR and self._delay:
        now, depth = obs[group], self._delay[1] + 1
        past["delayed"] = delays.start(now, depth) if buffers is None else delays.push(buffers["delayed"], now)
        obs[group] = delays.delayed(past["delayed"], delays.draw_delay(whole_key, self._delay))
    return obs if len(obs) > 1 else obs[ACTOR], past

  def _read(self, term: Term, c: StepContext, key: jax.Array, drawn: dict[str, jax.Array]) -> jax.Array:
    value, options = term.array(c).astype(float).ravel(), term.options
    kind, size = next(iter(options.noise.items())) if options.noise else (None, 0.0)
    if kind == "same_as":
      if drawn[str(size)].shape != value.shape:
        sizes = f"{drawn[str(size)].size} elements, and this one has {value.size}"
        raise ConfigError(f"{term.key}.noise.same_as={size}: that term has {sizes}.")
      value = value + drawn[str(size)]
    elif kind is not None:
      pattern = self._level * _per_element(f"{term.name}.noise.{kind}", size, value.size)
      # Noise of 0 is not computed. A setting of the program, an array of JAX, is 0 only if the noise level is.
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
          sizes[term.name] = sum(found[ACTOR].values()) if actor else jnp.size(term(c)) * term.options.history
        found[group] = sizes
        if group == ACTOR and self._frames > 1:
          found[group] = sizes | {"past_frames": (self._frames - 1) * sum(sizes.values())}

    jax.eval_shape(trace)
    return found


def _bind_observation(group: str, name: str, entries: Mapping[str, Any], noisy: list[str]) -> Term:
  """Binds a term of a group; `noisy` are those above it that have noise of their own."""
  key = f"env.observations.{group}.{name}"
  if group != ACTOR and name == ACTOR:
    if (given := plain(entries[name])) != {}:
      raise ConfigError(
        f"{key}={format_value(given)} must be {{}}, for all of env.observations.{ACTOR}: give a term another name."
      )
    return Term(name, key, lambda c: None, {}, ObservationOptions())
  term = bind_one("observations", key, name, entries[name], entries)
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
  """Returns a number or a list of numbers for each of `size` elements; a shorter list repeats. Raises ConfigError."""
  count = np.size(numbers)
  if size % count:
    raise ConfigError(f"env.observations: {name} has {count} numbers, which do not divide its {size} elements.")
  return (jnp if isinstance(numbers, jax.Array) else np).tile(numbers, size // count)


def _is_actor(group: str, term: Term) -> bool:
  return group != ACTOR and term.name == ACTOR


def _depth(term: Term) -> int:
  """Returns the number of values that the buffer of a term holds."""
  delay = term.options.delay
  return term.options.history + (delay[1] if delay else 0)


def _look_back(term: Term, value: jax.Array, key: jax.Array, buffer: jax.Array | None) -> tuple[jax.Array, jax.Array]:
  """Returns a term's delayed value or its history, and the buffer for the next step."""
  delay, depth = term.options.delay, _depth(term)
  if buffer is None:  # a delay begins with the first value, a history with zeros
    buffer = delays.start(value, depth) if delay else jnp.zeros((depth, *value.shape), value.dtype)
  buffer = delays.push(buffer, value)
  if not delay:
    return buffer, buffer
  return jax.lax.dynamic_slice_in_dim(buffer, delays.draw_delay(key, delay), term.options.history), buffer


class CommandManager(_Manager):
  """Generators of commands: each term has an instance with `reset` and `step` (see `playground.mdp.commands`)."""

  def __init__(self, section: Mapping[str, Any], env: Any):
    """Binds `env.commands` and builds each generator with its parameters; raises as `terms.bind`."""
    self.groups = {"commands": [term.instantiate(env) for term in bind("commands", section)]}

  def reset(self, key: jax.Array) -> Info:
    """Returns the entries of `info` that an episode starts with."""
    return _union((term, term.run("reset", k)) for term, k in _with_keys(self.terms, key))

  def step(self, c: StepContext, key: jax.Array) -> Info:
    """Returns the entries of `info` for the next step; raises ConfigError as `checked`."""
    parts = [(term, term.run("step", c, k)) for term, k in _with_keys(self.terms, key)]
    return _union((term, checked(part, c.info, f"{term.key}.step", "reset")) for term, part in parts)


class EventManager(_Manager):
  """Events, which change the initial state (group `reset`) and act on the running simulation (group `interval`).

  Trainers draw the model fields of mode `startup` (`playground.randomization`) and pass them to `reset` and `step`.
  """

  def __init__(self, section: Mapping[str, Any], env: Any):
    """Binds `env.events`; raises as `terms.bind`."""
    self.groups = {"reset": [], "interval": []}
    for term in bind("events", section):
      mode = "interval" if isinstance(term.func, type) else "reset"
      if term.options.mode != mode:
        raise ConfigError(f"{term.key}.mode={term.options.mode}: {term.func.__name__} is for mode: {mode}.")
      if mode == "interval":
        self.groups[mode].append(term.instantiate(env))
      elif term.options.enabled:
        self.groups[mode].append(term)

  def start(self, key: jax.Array, env: Any, initial: Any) -> Any:
    """Applies the reset events, in order, to the state that an episode starts with.

    Raises ConfigError where one returns no such state, or parts of another shape.
    """
    for term, k in _with_keys(self.groups["reset"], key):
      changed = term(k, env, initial)
      if not isinstance(changed, type(initial)):
        what = f"and returns {type(changed).__name__}: return initial.replace(...)"
        raise ConfigError(f"{term.key} must return the state that an episode starts with, {what}.")
      model = env.mj_model
      shapes = {"ctrl": (model.nu,), "mocap_pos": (model.nmocap, 3), "mocap_quat": (model.nmocap, 4)}  # may be None
      for name, value in vars(initial).items():
        old, new = shapes.get(name, np.shape(value)), np.shape(vars(changed)[name])
        if new != old and (value is not None or vars(changed)[name] is not None):
          raise ConfigError(f"{term.key} returns {name} of shape {list(new)}, and this task's is {list(old)}.")
      initial = changed
    return initial

  def reset(self, key: jax.Array, model: Any) -> Info:
    """Returns the entries of `info` of the interval events that an episode starts with."""
    return _union((term, term.run("reset", k, model)) for term, k in _with_keys(self.groups["interval"], key))

  def of_model(self, model: mjx.Model) -> Info:
    """Returns the entries of `info` that interval events compute from the model, which an episode may change."""
    terms = [term for term in self.groups["interval"] if hasattr(term.instance, "of_model")]
    return _union((term, term.run("of_model", model)) for term in terms)

  def step(self, data: PhysicsData, info: Mapping[str, Any]) -> tuple[PhysicsData, Info]:
    """Returns the physics after the interval events, and `info`.

    Raises:
      ConfigError: an event returns no such pair, or as `checked`.
    """
    changed = dict(info)
    for term in self.groups["interval"]:
      if term.options.enabled:
        pair = term.run("step", data, changed)
        if not (isinstance(pair, tuple) and len(pair) == 2 and isinstance(pair[1], dict)):
          raise ConfigError(f"{term.key}.step must return the physics and the entries of info that it changes.")
        data = pair[0]
        changed |= checked(pair[1], info, f"{term.key}.step", "reset")
    return data, changed


def checked(entries: Info, info: Mapping[str, object], method: str, first: str) -> Info:
  """Returns entries of `info` for the next step, as they are.

  Args:
    entries: what `method` returned.
    info: of this step.
    method: for messages, as `first`, which returns what an episode starts with.

  Raises:
    ConfigError: `info` lacks an entry, or has it with another type or shape.
  """
  described = lambda entry: jax.tree.map(lambda x: f"{jnp.result_type(x)}{list(jnp.shape(x))}", entry)
  for name, entry in entries.items():
    if name not in info:
      raise ConfigError(f"{method} returns {name!r}, which {first} lacks: add it there.")
    if (new := described(entry)) != (old := described(info[name])):
      raise ConfigError(f"{method} returns {name!r} as {new}, where an episode starts with {old}: make them the same.")
  return entries


def _with_keys(terms: list[Term], key: jax.Array) -> Iterable[tuple[Term, jax.Array]]:
  """Each term with a random key of its own."""
  return zip(terms, jax.random.split(key, len(terms)) if terms else (), strict=True)


def _union(parts: Iterable[tuple[Term, Info]]) -> Info:
  """Returns the entries of `info` of all terms; those of an event that is switched off yield to another's.

  Raises ConfigError where two terms write the same entry: each would go on from the other's.
  """
  found: Info = {}
  writers: dict[str, Term] = {}
  for term, part in parts:
    for name, value in part.items():
      writer = writers.get(name)
      if writer is not None and not _is_on(term):
        continue
      if writer is not None and _is_on(writer):
        raise ConfigError(f"{writer.key} and {term.key} both write info[{name!r}]: keep one of them.")
      found[name], writers[name] = value, term
  return found


def _is_on(term: Term) -> bool:
  return getattr(term.options, "enabled", True)
