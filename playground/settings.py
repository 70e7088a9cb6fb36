"""Settings as typed fields of dataclasses: type, default, limit and one line of help in one place.

```python
@dataclasses.dataclass(frozen=True)
class VideoConfig:
  width: Annotated[int, count(1, 8192), "pixels"] = 640
  visuals: Annotated[Literal["primitives", "menagerie"], "geoms that are drawn"] = "primitives"
```

Composition takes the defaults of `configs/` from these classes, checks values with them and quotes their choices; the
reference pages show them. Nothing here imports JAX.
"""

import dataclasses
import functools
import math
import types
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints, is_typeddict

from ml_collections import ConfigDict

from playground.errors import ConfigError, UnknownNameError, nearest
from playground.limits import Limit
from playground.text import format_value, join, wrong_type

T = TypeVar("T")
Plain = Any  # mappings, lists and scalars inside each other, as YAML has them; they are checked where they are read
Section = Mapping[str, Plain]  # of a configuration
TEXTS = ("text", "a list of texts", "a list of lists of texts")


@dataclasses.dataclass(frozen=True)
class Setting:
  """One field of a settings class.

  Attributes:
    name: the field, dotted for a field of a nested class; `*` stands for any key of a mapping.
    default: as YAML has it; `dataclasses.MISSING` if the field has none.
    limit: of the numbers, None if there is none.
    choices: the allowed texts, None if any is allowed.
    text_depth: 0 for text, 1 for a list of texts, 2 for a list of such lists; None if it is no text.
    mapping: whether only a mapping is allowed, as for a nested class.
    nullable: whether null is allowed.
    help: one line.
  """

  name: str
  default: object
  limit: Limit | None
  choices: tuple[str, ...] | None
  text_depth: int | None
  mapping: bool
  nullable: bool
  help: str


@functools.cache
def settings(cls: type) -> dict[str, Setting]:
  """Returns all fields of a settings class by dotted name, those of nested classes included."""
  return {setting.name: setting for setting in _settings(cls)}


def defaults(cls: type) -> dict[str, Plain]:
  """Returns the default values of a settings class as nested plain values; fields without one are left out."""
  hints = _hints(cls)
  values = {field.name: _default(field, hints[field.name]) for field in dataclasses.fields(cls)}
  return {name: value for name, value in values.items() if value is not dataclasses.MISSING}


@functools.cache
def _hints(cls: type) -> dict[str, Any]:
  """The annotation of each field; one that only changes a default (`width: int = 64`) inherits limit and help."""
  hints: dict[str, Any] = {}
  for base in reversed(cls.__mro__):
    own = get_type_hints(base, include_extras=True)
    hints |= {name: hint for name, hint in own.items() if get_args(hints.get(name))[:1] != (hint,)}
  return hints


def build(cls: type[T], values: Section, key: str = "") -> T:
  """Builds a settings class from nested mappings: missing fields get their defaults.

  Args:
    cls: the class.
    values: its fields by name.
    key: where they are, such as agent; without it, unknown fields are ignored.

  Raises:
    ConfigError: a field without default is missing.
    UnknownNameError: the class, whose values are at `key`, has no such field.
  """
  hints = _hints(cls)
  all_fields = dataclasses.fields(cls)  # pyright: ignore[reportArgumentType]
  known = [field.name for field in all_fields]
  if key and (unknown := [name for name in values if name not in known]):
    raise UnknownNameError(f"{key}.{unknown[0]} does not exist.{nearest(str(unknown[0]), known)}")
  fields = {name: values[name] for name in known if name in values}
  needed = [field.name for field in all_fields if field.default is field.default_factory is dataclasses.MISSING]
  if missing := [name for name in needed if name not in fields]:
    raise ConfigError(f"{join(key, missing[0])} is missing.")
  for name, value in fields.items():
    if (inner := nested(hints[name])) and isinstance(value, Mapping):
      fields[name] = build(inner, value, key and f"{key}.{name}")
  return cls(**fields)


def check(config: object, key: str = "") -> None:
  """Checks all values of a settings class, as composing does: choices, texts and limits; null is not checked.

  Args:
    config: an instance.
    key: where it is, such as agent.

  Raises:
    ConfigError: the first invalid value.
  """
  for name, setting in settings(type(config)).items():
    if "*" not in name and (value := functools.reduce(getattr, name.split("."), config)) is not None:
      check_value(join(key, name), value, setting)


def check_value(key: str, value: object, setting: Setting) -> None:
  """Raises ConfigError, which names the key, the value and what is allowed, for a value that a setting refuses."""
  if setting.choices and value not in setting.choices:
    allowed = f"{', '.join(setting.choices)}.{nearest(str(value), setting.choices)}"
    raise ConfigError(f"{key}={format_value(value)} is unknown: choose from {allowed}")
  if (depth := setting.text_depth) is not None and not is_text(value, depth):
    raise wrong_type(key, value, TEXTS[depth] + " (put quotes around a number)" * (depth == 0))
  if setting.limit is not None and not setting.limit.allows(value):
    raise ConfigError(f"{key}={format_value(value)} must be {setting.limit}.")


def nested(hint: object) -> type | None:
  """Returns the settings class that an annotation names, None if it names another type."""
  kind = get_args(hint)[0] if get_origin(hint) is Annotated else hint
  return kind if dataclasses.is_dataclass(kind) and isinstance(kind, type) else None


def below(key: str, values: Mapping[str, T]) -> dict[str, T]:
  """Returns the values whose dotted keys begin with `key.`, by the rest of their keys."""
  return {name.removeprefix(f"{key}."): value for name, value in values.items() if name.startswith(f"{key}.")}


def select(values: Plain, key: str) -> Plain:
  """Returns the value at a dotted key of nested mappings and lists, None if there is none."""
  for part in key.split("."):
    if isinstance(values, list):
      values = values[int(part)] if part.isdecimal() and int(part) < len(values) else None
    else:
      values = values.get(part) if isinstance(values, Mapping) else None
  return values


def nodes(node: Section, prefix: str = "") -> Iterator[tuple[str, Plain]]:
  """Yields all dotted keys with their values, a mapping before its own keys."""
  for name, value in node.items():
    yield join(prefix, name), value
    if isinstance(value, Mapping):
      yield from nodes(value, join(prefix, name))


def plain(value: Plain, finite: bool = False) -> Plain:
  """Returns a value (dataclass, ConfigDict, tuple, path, array, …) as the dicts, lists and scalars of YAML and JSON.

  Args:
    value: it.
    finite: whether NaN and infinity, which JSON has not, become None.
  """
  if dataclasses.is_dataclass(value) and not isinstance(value, type):
    value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
  elif hasattr(value, "to_dict"):  # ml_collections.ConfigDict
    value = value.to_dict()
  if isinstance(value, Mapping):
    return {str(key): plain(entry, finite) for key, entry in value.items()}
  if isinstance(value, list | tuple | set):
    return [plain(entry, finite) for entry in value]
  if hasattr(value, "tolist"):  # NumPy and JAX arrays and scalars
    return plain(value.tolist(), finite)
  if isinstance(value, float):
    return None if finite and not math.isfinite(value) else value
  return value if value is None or isinstance(value, bool | int | str) else str(value)


def config_dict(values: Section | ConfigDict) -> Plain:
  """Returns a ConfigDict whose keys keep their order, in which terms apply; ConfigDict itself sorts them.

  Raises:
    ConfigError: a key that is no text or has a dot.
  """
  config: Plain = ConfigDict(sort_keys=False)
  for key, value in values.items():
    if not isinstance(key, str) or "." in key:
      raise ConfigError(f"{key!r} cannot be the name of a key or a term: write text without a dot.")
    config[key] = config_dict(value) if isinstance(value, Mapping | ConfigDict) else value
  return config


def members(hint: Any) -> tuple[Any, ...]:
  """Returns the types of a union, or the one type that an annotation names."""
  return get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)


def problem(value: object, hint: Any) -> str:
  """Returns what a value must be that an annotation (of a parameter) does not allow, to follow 'must be'; else ""."""
  problems = [_problem(value, kind) for kind in members(hint) if kind is not type(None)]
  return " or ".join(dict.fromkeys(problems)) if all(problems) else ""


def _problem(value: object, hint: Any) -> str:
  limit = next((entry for entry in getattr(hint, "__metadata__", ()) if isinstance(entry, Limit)), None)
  kind = get_args(hint)[0] if limit else hint
  if limit is None and kind in (int, float):
    limit = Limit(whole=kind is int)
  if limit is None and get_args(kind) == (float,):
    limit = Limit(form="list")
  if limit is not None:
    return "" if limit.allows(value) else str(limit)
  if kind is bool:
    return "" if isinstance(value, bool) else "true or false"
  depth = _text_depth(kind)
  return "" if depth is None or is_text(value, depth) else TEXTS[depth]


def is_text(value: object, depth: int) -> bool:
  """Whether a value is text, or with `depth` 1 a list of texts, with 2 a list of such lists (`TEXTS`)."""
  if depth == 0:
    return isinstance(value, str)
  return isinstance(value, list | tuple) and all(is_text(entry, depth - 1) for entry in value)


def _settings(cls: type, prefix: str = "") -> Iterator[Setting]:
  """Yields the fields of a dataclass or a TypedDict, those of nested classes and values of mappings (`*`) included."""
  if not dataclasses.is_dataclass(cls):
    for name, hint in get_type_hints(cls, include_extras=True).items():
      yield from _setting(f"{prefix}{name}", hint, dataclasses.MISSING)
    return
  hints = _hints(cls)
  for field in dataclasses.fields(cls):
    yield from _setting(f"{prefix}{field.name}", hints[field.name], _default(field, hints[field.name]))


def _setting(name: str, hint: Any, default: object) -> Iterator[Setting]:
  metadata = get_args(hint)[1:] if get_origin(hint) is Annotated else ()
  options = members(get_args(hint)[0] if metadata else hint)
  depths = [_text_depth(option) for option in options]
  mappings = [option for option in options if get_origin(option) is Mapping]
  classes = [option for option in options if dataclasses.is_dataclass(option) and isinstance(option, type)]
  limit = next((entry for entry in metadata if isinstance(entry, Limit)), None)
  text = next((entry for entry in metadata if isinstance(entry, str)), "")
  yield Setting(
    name=name,
    default=default,
    limit=None if mappings else limit,
    choices=next((get_args(option) for option in options if get_origin(option) is Literal), None),
    text_depth=next((depth for depth in depths if depth is not None), None),
    mapping=all(option in (*mappings, *classes, type(None)) for option in options),
    nullable=type(None) in options,
    help=text,
  )
  for option in classes:
    yield from _settings(option, f"{name}.")
  for _, value in map(get_args, mappings):
    if is_typeddict(value):
      yield from _settings(value, f"{name}.*.")
    else:
      yield Setting(f"{name}.*", dataclasses.MISSING, limit, None, _text_depth(value), False, False, text)


def _default(field: "dataclasses.Field[object]", hint: object) -> object:
  inner = nested(hint)
  if inner is not None and field.default_factory is dataclasses.MISSING and field.default is dataclasses.MISSING:
    return defaults(inner)
  value = field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
  return value if value is dataclasses.MISSING else plain(value)


def _text_depth(kind: object) -> int | None:
  """How deep texts are nested in lists; None if the type holds none."""
  if kind is str:
    return 0
  if get_origin(kind) in (Sequence, list):
    inner = _text_depth(get_args(kind)[0])
    return None if inner is None else inner + 1
  return None
