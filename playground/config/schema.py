"""Checks which keys exist and the types of their values. The schema is a nested dict of default values."""

import sys
from collections.abc import Mapping, Sequence

from playground.config.definitions import defined, definition
from playground.config.files import DELTAS
from playground.errors import UnknownNameError, nearest
from playground.mdp.options import OPTIONS, keys
from playground.moved import check_not_moved
from playground.settings import Plain, Section, nodes, select
from playground.text import format_value, join, nearest_in, wrong_type

_KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "text", list: "a list"}


def check_key(key: str, schema: Section) -> None:
  """Raises UnknownNameError, with the keys that exist, if the schema has no such dotted key."""
  if is_open(key.split("."), schema):
    return
  node: Plain = schema
  parts = key.split(".")
  for i, part in enumerate(parts):
    if isinstance(node, list) and part.isdigit() and int(part) < len(node):
      node = node[int(part)]
    elif isinstance(node, Mapping) and part in node:
      node = node[part]
    else:
      check_not_moved(key)
      raise _unknown_key(key, ".".join(parts[:i]), part, node, schema)


# Names of other libraries.
_MEANT = {
  "task": "env",
  "algo": "agent",
  "algorithm": "agent",
  "lr": "learning_rate",
  "gamma": "discounting",
  "lam": "gae_lambda",
  "num_steps_per_env": "unroll_length",
  "num_learning_epochs": "num_updates_per_batch",
  "num_mini_batches": "num_minibatches",
  "clip_param": "clipping_epsilon",
  "entropy_coef": "entropy_cost",
  "max_iterations": "num_timesteps",
}


def is_open(parts: Sequence[str], schema: Section) -> bool:
  """Whether a key is in a mapping of terms (`env.rewards`, ...), which may have entries of any name.

  Raises:
    UnknownNameError: a term has no such key.
  """
  if not is_of_terms(".".join(parts)) or parts[1] not in schema.get("env", {}):
    return False
  name = 3 if parts[1] == "observations" else 2  # observations are in groups
  if len(parts) > name + 1 and parts[name + 1] not in keys(parts[1]):
    near = nearest(parts[name + 1], keys(parts[1]))
    has = f"a term of env.{parts[1]} has {', '.join(keys(parts[1]))}"
    raise UnknownNameError(f"{'.'.join(parts)} does not exist: {has}.{near}")
  return True


def check_removed(key: str, values: Section) -> None:
  """Raises UnknownNameError if `key` is a term or a group of observations that `values` do not have to remove."""
  *parents, name = key.split(".")
  if not is_term(key):
    return
  node = select(values, ".".join(parents)) or {}
  if name not in node:
    raise unknown_term(key, list(node))


def unknown_term(key: str, known: Sequence[str]) -> UnknownNameError:
  """Returns the error for a term that is to be removed, where the task has those that are `known`."""
  parent, _, name = key.rpartition(".")
  has = f"has {', '.join(known)}" if known else "is empty"
  return UnknownNameError(f"{key} does not exist: {parent} {has}.{nearest_in(parent, name, known)}")


def is_of_terms(key: str) -> bool:
  """Whether a dotted key is in a mapping of terms (`env.rewards`, ...), which may have entries of any name."""
  parts = key.split(".")
  return len(parts) > 2 and parts[0] == "env" and parts[1] in OPTIONS


def is_term(key: str) -> bool:
  """Whether a dotted key is that of a term or of a group of observations, not of something inside a term."""
  return is_of_terms(key) and key.count(".") <= (3 if key.startswith("env.observations.") else 2)


def is_terms(key: str) -> bool:
  """Whether a key is that of a mapping of terms: `env.rewards`, ..."""
  return key.startswith("env.") and key[4:] in OPTIONS


def fit(value: Plain, default: Plain, names: Mapping[str, object], key: str = "") -> Plain:
  """Returns a value in the type of its default, e.g. 1e6 as the whole number that the default is.

  Args:
    value: a value or section of the configuration.
    default: the same key of the schema; None and ??? (no default) take any single value or list, an empty mapping any
      mapping.
    names: the chosen agent, launcher and search, as `definition` takes them.
    key: dotted key, for errors.

  Raises:
    ConfigError: the value has another type.
    UnknownNameError: the value has a key that the default has not.
  """
  if is_terms(key):
    return _fit_terms(value, key)
  if value is None and (setting := definition(key, names)) and setting.nullable:
    return None
  if isinstance(default, Mapping) and default:
    return _fit_mapping(value, default, names, key)
  if isinstance(default, list) and isinstance(value, list):
    return _fit_list(value, default, names, key)
  if default is None or default == "???":
    if isinstance(value, Mapping):
      raise wrong_type(key, value, "a single value, a list or null")
    return value
  if not _fits(value, default):
    allowed = _KINDS.get(type(default), "a mapping")
    raise wrong_type(key, value, f"{allowed}, as its default {format_value(default)} is")
  kind: Plain = type(default)
  return kind(value) if isinstance(default, int | float) else value


def _fits(value: object, default: object) -> bool:
  if isinstance(default, bool) or not isinstance(default, int | float):
    return isinstance(value, type(default))
  if not isinstance(value, int | float) or isinstance(value, bool) or value != value:  # NaN fits nothing
    return False
  if isinstance(value, int):
    return abs(value) <= sys.float_info.max
  return isinstance(default, float) or value.is_integer()


def _fit_terms(value: object, key: str) -> Plain:
  """Returns a mapping of terms unchanged; the task checks its entries when it binds them."""
  if not isinstance(value, Mapping):
    raise wrong_type(key, value, "a mapping of terms by name")
  for name, entry in value.items():
    if entry is not None and not isinstance(entry, Mapping):
      group = key == "env.observations"
      raise wrong_type(join(key, name), entry, "a mapping of terms by name" if group else "a mapping or null")
    if key == "env.observations":
      _fit_terms(entry or {}, join(key, name))
    else:
      _check_mappings(entry or {}, join(key, name))
  return dict(value)


def _check_mappings(entry: Section, key: str) -> None:
  """Raises ConfigError where `params`, `when` or `noise` of a term is no mapping."""
  for name in ("params", "when", "noise"):
    if entry.get(name) is not None and not isinstance(entry[name], Mapping):
      raise wrong_type(join(key, name), entry[name], "a mapping or null")


def _fit_mapping(value: object, default: Section, names: Mapping[str, object], key: str) -> dict[str, Plain]:
  if not isinstance(value, Mapping):
    raise wrong_type(key, value, f"a mapping with the keys {', '.join(map(str, default))}")
  for name in value:
    if name not in default:
      near = nearest_in(key, str(name), default)
      raise UnknownNameError(f"{join(key, name)}, set by a chosen file or mapping, does not exist.{near}")
  return {name: fit(value[name], default[name], names, join(key, name)) for name in value}


def _fit_list(value: list[Plain], default: list[Plain], names: Mapping[str, object], key: str) -> list[Plain]:
  """Lists may differ in length; if the default's entries are all of one scalar type, so must the value's be."""
  kinds = {type(entry) for entry in default}
  if float in kinds:
    kinds.discard(int)  # [0, 0.5] is a list of numbers
  if len(kinds) != 1 or not kinds <= {bool, int, float, str}:
    return value
  sample = next(entry for entry in default if type(entry) in kinds)
  return [fit(entry, sample, names, f"{key}[{i}]") for i, entry in enumerate(value)]


def _unknown_key(key: str, parent: str, part: str, node: Plain, schema: Section) -> UnknownNameError:
  if not isinstance(node, Mapping):
    what = f"a list of {len(node)}" if isinstance(node, list) else "a single value"
    return UnknownNameError(f"{key} does not exist: {parent} is {what}.")
  if not node:
    return UnknownNameError(f"{key} does not exist: {parent} is empty. Set it whole: {parent}={{{part}: <value>}}.")
  classes, meant = defined().get(parent, {}), _MEANT.get(part, part)
  owners = [f"{parent}={name}" for name, cls in classes.items() if meant in cls.__dataclass_fields__]
  if owners and meant not in node:
    own = key if meant == part else f"{key} is {join(parent, meant)}, which"
    return UnknownNameError(f"{own} does not exist for {parent}={node['name']}, only for {', '.join(owners)}.")
  if parent == "env" and part in OPTIONS:
    return UnknownNameError(f"{key} does not exist: this task has no terms in env.{part}.")
  known = [str(k) for k in node] if parent else [*schema, "robot", *DELTAS]
  near = nearest_in(parent, meant, known)
  if not parent and meant not in known:  # perhaps only the section is missing
    keys_of_all = [name for name, _ in nodes(schema)]
    whole = [name for name in keys_of_all if name.endswith(f".{meant}")]
    near = f" Did you mean {whole[0]!r}?" if whole else near or nearest(part, keys_of_all)
  has = f"has {', '.join(known)}" if len(known) <= 12 or not near else f"has {len(known)} keys (--cfg job shows them)"
  return UnknownNameError(f"{key} does not exist: {parent or 'the configuration'} {has}.{near}")
