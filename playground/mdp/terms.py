"""Terms: the named parts of a task's rewards, observations, terminations, commands and events.

A term is one entry of a mapping in the task's config:

```yaml
rewards:
  action_rate_l2: {weight: -0.01}            # the registered function of that name
  knees: {func: joint_deviation_l1, weight: -0.1, params: {joints: [".*_knee_joint"]}}
  mine: {func: "my_package.rewards:mine", weight: 0.5}
  feet_slip: null                            # removes the term that the family file has
```

Every public function or class of the modules in `MODULES` is registered under its name (a class under its name in
snake_case). Its keyword arguments are the term's `params`, its docstring is the term's help. An observation term may
also name a property or method of a step context (`CONTEXTS`): `gravity`, or `site_pos` with `params: {site: gripper}`.
"""

import contextlib
import copy
import functools
import importlib
import inspect
import re
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from playground.errors import ConfigError, PlaygroundError, UnknownNameError, nearest
from playground.mdp.context import Robot
from playground.mdp.options import OPTIONS, is_model_field, keys
from playground.moved import renamed_function
from playground.settings import below, members, problem
from playground.text import first_line, format_value, line_of
from playground.trust import trusted_object

# Modules whose public functions and classes are the registered terms of a kind.
MODULES = {kind: f"playground.mdp.{kind}" for kind in ("rewards", "observations", "terminations", "commands", "events")}
# Classes whose properties and methods that return an array are registered observation terms, too.
CONTEXTS = {
  "playground.mdp.context": ("StepContext",),
  "playground.mdp.legged": ("LeggedContext",),
  "playground.mdp.manipulators": ("ArmContext", "HandContext"),
}
# Number of leading arguments that are not parameters: the context; key, task and initial state of reset events.
_LEADING = {"rewards": 1, "observations": 1, "terminations": 1, "commands": 0, "events": 3}
_ARGUMENTS = {1: "the step `c`", 3: "(key, env, initial)"}
_METHODS = ("bind", "reset", "step")  # of the classes of commands and interval events


class Term(NamedTuple):
  """A term with its function and its checked parameters.

  Attributes:
    name: its name in the config.
    key: its place there, `env.rewards.<name>`.
    func: the function or class.
    params: keyword arguments of `func`.
    options: the other keys of the entry (weight, noise, mode, ...), a NamedTuple of the kind.
    instance: of a command or an interval event: the object of the class `func` for a task.
  """

  name: str
  key: str
  func: Callable[..., Any]
  params: dict[str, Any]
  options: Any
  instance: Any = None

  def __call__(self, *args: Any) -> Any:
    with self.reading(*args):
      value = self.func(*args, **self.params)
    if value is None:
      raise ConfigError(f"{self.key} returns nothing: {self.func.__name__} lacks a `return`.")
    return value

  def array(self, *args: object) -> jax.Array:
    """Returns the function's value; raises ConfigError where it is no array of numbers."""
    value = self(*args)
    try:
      return jnp.asarray(value)
    except (TypeError, ValueError) as error:
      raise ConfigError(f"{self.key} must return an array of numbers, and returns {type(value).__name__}.") from error

  def scalar(self, *args: Any) -> jax.Array:
    """Returns the function's value, shape []; raises ConfigError where it has another shape."""
    value = self.array(*args)
    if value.ndim:
      raise ConfigError(f"{self.key} must return one number, and returns {value.size} of them: add .sum() or .any().")
    return value

  @contextlib.contextmanager
  def reading(self, *args: Any) -> Iterator[None]:
    """Raises ConfigError, with the term's key, if it reads an attribute that task, robot or context in `args` lack.

    So do arrays whose sizes do not match, in a term of this package, and all errors in another's.
    """
    try:
      yield
    except ConfigError as error:
      has_key = str(error).startswith(tuple(f"env.{kind}." for kind in MODULES))  # of a term that this one reads
      key = f"{self.key}." if str(error).startswith("params.") else f"{self.key}: "
      raise error if has_key else type(error)(f"{key}{error}") from None
    except Exception as error:
      if vars(error).setdefault("term", self) is not self:  # of a term that this one reads, as `is_terminated` does
        raise
      ours = self.func.__module__.startswith("playground.mdp.")
      parts = [part for arg in args for part in (arg, getattr(arg, "env", arg), getattr(arg, "robot", arg))]
      if isinstance(error, AttributeError) and any(error.obj is part for part in parts):
        near = "" if ours else nearest(str(error.name), dir(error.obj))
        robots = [getattr(arg, "robot", None) for arg in args]
        if any(error.obj is robot for robot in robots) and hasattr(Robot, str(error.name)):
          near = f" It has a {type(error.obj).__name__}, and no {Robot.__module__}.Robot, as its robot."
        raise ConfigError(f"{self.key} needs {error.name!r}, which this task does not have.{near}") from error
      if ours and type(error) in (TypeError, ValueError):
        raise ConfigError(f"{self.key} does not fit this task: {first_line(error)}.") from error
      if not ours and not isinstance(error, PlaygroundError):
        why = f"{type(error).__name__}: {first_line(error)}"
        if isinstance(error, jax.errors.JAXTypeError):
          why = "write jnp.where in place of `if`, and jnp in place of np and float()."
        raise ConfigError(f"{self.key}: {line_of(error, self.func.__module__)}{why}") from error
      error.add_note(f"in {self.key}")
      raise

  def instantiate(self, env: Any) -> "Term":
    """Returns the same term with an instance of its class, bound to a task."""
    instance = self()
    with self.reading(env):
      instance.bind(env)
    return self._replace(instance=instance)

  def run(self, method: str, *args: Any) -> Any:
    """Calls a method of the instance; raises as `reading`."""
    with self.reading(*args):
      return getattr(self.instance, method)(*args)

  def with_settings(self, values: Mapping[str, Any]) -> "Term":
    """Returns the same term with other numbers (`weight`, `noise.<kind>`, `params.<name>`), by key in the config."""
    own = below(self.key.removeprefix("env."), values)
    params, noise = below("params", own), below("noise", own)
    options = {name: value for name, value in own.items() if "." not in name} | ({"noise": noise} if noise else {})
    instance = copy.copy(self.instance)  # with what its `bind` looked up
    for name, value in params.items() if instance is not None else ():
      setattr(instance, name, value)
    return self._replace(params=self.params | params, options=self.options._replace(**options), instance=instance)


@functools.cache
def registered(kind: str) -> dict[str, Callable[..., Any]]:
  """Functions and classes of a kind (a key of `MODULES`) by name."""
  found: dict[str, Callable[..., Any]] = {}
  module = importlib.import_module(MODULES[kind])
  for key, value in vars(module).items():
    if not key.startswith("_") and callable(value) and getattr(value, "__module__", None) == module.__name__:
      name = re.sub(r"(?<!^)(?=[A-Z])", "_", key).lower() if isinstance(value, type) else key  # in snake_case
      found[name] = value
      if value.__name__ == "<lambda>":  # of a helper that makes terms
        value.__name__ = value.__qualname__ = name
  return _of_contexts() | found if kind == "observations" else found


def _of_contexts() -> dict[str, Callable[..., Any]]:
  """Returns functions that read the properties and methods of `CONTEXTS`, by name; a subclass may override them."""
  found: dict[str, Callable[..., Any]] = {}
  for module, classes in CONTEXTS.items():
    for member in (m for cls in classes for m in vars(getattr(importlib.import_module(module), cls)).values()):
      getter = getattr(member, "fget", None) or getattr(member, "func", member)
      if inspect.isfunction(getter) and inspect.signature(getter).return_annotation is jax.Array:
        found[getter.__name__] = _reader(getter, is_method=getter is member)
  return found


def _reader(getter: Callable[..., Any], is_method: bool) -> Callable[..., Any]:
  @functools.wraps(getter)
  def read(c: Any, **params: Any) -> Any:
    value = getattr(c, getter.__name__)
    return value(**params) if is_method else value

  return read


def bind(kind: str, section: Mapping[str, Any] | None) -> list[Term]:
  """Binds the terms of `env.<kind>`, in their order; null entries and events that draw model fields are left out.

  Raises:
    ConfigError: an unknown or missing key, function or parameter, or a value of the wrong type.
  """
  entries = {name: entry for name, entry in (section or {}).items() if entry is not None}
  own = [name for name, entry in entries.items() if kind != "events" or not is_model_field(name, entry)]
  return [bind_one(kind, f"env.{kind}.{name}", name, entries[name], entries) for name in own]


def bind_one(kind: str, key: str, name: str, entry: Any, others: Iterable[str] = ()) -> Term:
  """Binds one term; `key` is its place in the config, `others` are the terms there, to suggest one. See `bind`."""
  if not hasattr(entry, "items"):
    raise ConfigError(f"{key}={entry!r} is no mapping such as {{func: {name}, params: {{}}}}.")
  entry = dict(entry.items())
  options: Any = OPTIONS[kind]
  known = keys(kind)
  for field in entry:
    if field not in known:
      raise UnknownNameError(f"{key}.{field} does not exist: a term has {', '.join(known)}.{nearest(field, known)}")
  given_func = entry.get("func")
  if given_func is not None and not isinstance(given_func, str):
    raise ConfigError(f"{key}.func={format_value(given_func)} must be text: a registered function or module:function.")
  func = find(kind, given_func or name, key, () if given_func else [other for other in others if other != name])
  for field in options._fields:
    if field not in options._field_defaults and entry.get(field) is None:
      raise ConfigError(f"{key}.{field} is missing: every term of env.{kind} has one.")
  params = check_params(func, entry.get("params") or {}, f"{key}.params", _LEADING[kind])
  hints = typing.get_type_hints(options, include_extras=True)
  values = {field: plain(entry.get(field)) for field in options._fields}
  given = {
    field: _checked(f"{key}.{field}", value, hints[field])
    for field, value in values.items()
    if value is not None and (value != {} or field not in options._field_defaults)
  }
  return Term(name, key, func, params, options(**given))


def find(kind: str, name: str, key: str, others: Iterable[str] = ()) -> Callable[..., Any]:
  """Returns the registered function or the one that `module:function` names; raises ConfigError if there is none.

  The error suggests a function, or one of `others`.
  """
  table = registered(kind)
  if name in table:
    return table[name]
  if ":" not in name:
    renamed = renamed_function(kind, name)
    module, _, function = name.rpartition(".")
    meant = f"{module}:{function}" if module else renamed
    near = f" Did you mean {meant!r}?" if meant else nearest(name, [*others, *table])
    raise UnknownNameError(
      f"{key}: no function {name!r} is registered for env.{kind}; name one, or write func: module:function.{near}"
    )
  found = trusted_object(f"{key}.func", name)
  if not callable(found):
    raise ConfigError(f"{key}.func={name} is not a function.")
  # Binding calls these with nothing but `params`, which may come from another user.
  builds = kind == "commands" or (kind == "events" and isinstance(found, type))
  if builds and not (isinstance(found, type) and all(hasattr(found, method) for method in _METHODS)):
    raise ConfigError(f"{key}.func={name} must be a class with the methods {', '.join(_METHODS)}.")
  if isinstance(found, type) and not builds:
    raise ConfigError(f"{key}.func={name} is a class: a term of env.{kind} is a function.")
  leading = inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD
  taken = [argument.kind for argument in inspect.signature(found).parameters.values()]
  many = inspect.Parameter.VAR_POSITIONAL in taken
  if not builds and not many and sum(kind in leading for kind in taken) < _LEADING[kind]:
    raise ConfigError(f"{key}.func={name} must take {_ARGUMENTS[_LEADING[kind]]} before its parameters.")
  return found


def check_params(func: Callable[..., Any], given: Any, key: str, skip: int = 1) -> dict[str, Any]:
  """Returns keyword arguments of a function, after its first `skip`, as plain values; null is the argument's default.

  Raises:
    ConfigError: an unknown or missing argument, or a value that its annotation does not allow.
  """
  if not hasattr(given, "items"):
    raise ConfigError(f"{key}={given!r} is no mapping of parameters.")
  params = {name: plain(value) for name, value in given.items() if value is not None}
  arguments = dict(list(inspect.signature(func).parameters.items())[skip if not isinstance(func, type) else 0 :])
  many = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)  # *args and **kwargs name no parameters
  arguments = {name: a for name, a in arguments.items() if not name.startswith("_") and a.kind not in many}
  for name, value in params.items():
    if name not in arguments:
      has = f"takes {', '.join(arguments)}" if arguments else "takes no parameters"
      raise UnknownNameError(f"{key}.{name} does not exist: {func.__name__} {has}.{nearest(name, arguments)}")
    params[name] = _checked(f"{key}.{name}", value, annotation(func, arguments[name]))
  for name, argument in arguments.items():
    if argument.default is inspect.Parameter.empty and name not in params:
      raise ConfigError(f"{key}.{name} is missing: {func.__name__} needs it.")
  return params


def plain(value: Any) -> Any:
  """Mappings as dicts without their null entries, lists as tuples."""
  if hasattr(value, "items"):
    return {name: plain(entry) for name, entry in value.items() if entry is not None}
  return tuple(plain(entry) for entry in value) if isinstance(value, list | tuple) else value


def annotation(func: Callable[..., Any], argument: inspect.Parameter) -> Any:
  """A parameter's annotation; one that is text (`from __future__ import annotations`) is looked up."""
  if not isinstance(argument.annotation, str):
    return argument.annotation
  return typing.get_type_hints(func, include_extras=True).get(argument.name)


def _checked(key: str, value: Any, hint: Any) -> Any:
  """Returns a value, whole numbers as floats where the annotation says float; raises ConfigError if it is invalid."""
  if typing.get_origin(hint) is typing.Literal and value not in (known := typing.get_args(hint)):
    raise UnknownNameError(f"{key}={value!r} is unknown: choose from {', '.join(known)}.{nearest(str(value), known)}")
  if wanted := problem(value, hint):
    raise ConfigError(f"{key}={format_value(value)} must be {wanted}.")
  return _as_float(value) if any("float" in str(kind) for kind in members(hint)) else value


def _as_float(value: Any) -> Any:
  if isinstance(value, tuple):
    return tuple(map(_as_float, value))
  return float(value) if isinstance(value, int) and not isinstance(value, bool) else value
