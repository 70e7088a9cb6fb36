"""Many runs at once, `playground-run -m`: sweep files and globs, and the jobs that they stand for.

A file of sweeps/ says what varies, in the syntax of the command line; a list stands for its values one by one:

```yaml
params:
  env: [CheetahRun, glob(Walker*)]
  agent: sac
  seed: range(5)
```
"""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.types import ChoiceSweep, Glob
from hydra.core.override_parser.types import Override as HydraOverride
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from playground.config.files import config_roots, groups, listed_options, shipped
from playground.config.overrides import is_hydras, is_of_sweep, parse, parse_with_hydra
from playground.config.text import first_line, format_value
from playground.errors import ConfigError, UnknownNameError, nearest

_HYDRAS_OWN = ("hydra.sweep", "hydra.launcher", "hydra/launcher", "hydra/sweeper")


def expand(overrides: Sequence[str], config_dir: Path | None = None) -> list[str]:
  """Spells out what `-m` is given: `sweep=<name>` becomes what its file says, a glob the options it stands for.

  What the command line says of a key replaces what the file says of it.

  Raises:
    ConfigError: a sweep file that is none, a value that cannot be.
    UnknownNameError: no such sweep or option, or a glob that stands for none.
  """
  roots = config_roots(config_dir)
  given = [parse_with_hydra(text) for text in overrides if not is_hydras(text)]
  named = [override for override in given if override.key_or_group == "sweep"]
  if len(named) > 1 or any(override.is_sweep_override() for override in named):
    raise ConfigError(f"{' '.join(str(o.input_line) for o in named)}: one sweep at a time.")
  keys = {override.key_or_group for override in given}
  listed = [parse_with_hydra(text) for override in named for text in _read(str(override.value()))]
  chosen = [*(o for o in listed if o.key_or_group not in keys), *(o for o in given if o not in named)]
  lines = [_spell_out(override, roots) for override in chosen]
  for line in lines:
    for one in _values(line):
      parse(one, roots)
  return [*lines, *filter(is_hydras, overrides)]


def split(lines: Iterable[str]) -> tuple[list[str], list[str]]:
  """Divides what `expand` returns into what is said of the sweep itself and what is said of its jobs.

  Raises:
    ConfigError: a key that a sweep's jobs cannot have.
  """
  settings, ours = [], []
  for line in lines:
    key = parse_with_hydra(line).key_or_group
    if key in ("run_dir", "resume"):
      instead = "sweep_dir=<path> says where a sweep lies, the same command again continues it"
      raise ConfigError(f"{line} cannot be given with -m, whose jobs lie in the sweep's folder: {instead}.")
    if line.lstrip("+~").startswith(_HYDRAS_OWN):
      raise ConfigError(f"{line}: -m does not use Hydra's launchers and sweepers, launcher=<name> is ours.")
    (settings if is_of_sweep(key) else ours).append(line)
  return settings, ours


def combinations(lines: Sequence[str]) -> list[list[str]]:
  """The overrides of each job that a sweep's lines stand for: every combination of their values.

  Raises:
    ConfigError: an interval, which has no values to combine.
  """
  for line in lines:
    override = parse_with_hydra(line)
    if override.is_sweep_override() and not override.is_discrete_sweep():
      raise ConfigError(f"{line} is a range to draw from: add search=optuna, or list values.")
  return [list(job) for job in dict.fromkeys(itertools.product(*map(_values, lines)))]


def varying(lines: Iterable[str]) -> list[str]:
  """The keys and groups that have more than one value."""
  parsed = [(parse_with_hydra(line), line) for line in lines]
  return [o.key_or_group for o, line in parsed if o.is_sweep_override() and len(_values(line)) != 1]


def sweep_names() -> list[str]:
  """Names of the sweeps we ship, sorted."""
  return sorted(path.stem for path in shipped("sweeps").glob("*.yaml"))


def _values(text: str) -> list[str]:
  """An override once for each of its values."""
  override = parse_with_hydra(text)
  if not override.is_sweep_override():
    return [text]
  if not override.is_discrete_sweep():  # an interval: a search draws from it
    return []
  return [f"{override.get_key_element()}={value}" for value in override.sweep_string_iterator()]


def _spell_out(override: HydraOverride, roots: Sequence[Path]) -> str:
  """The override as typed, its globs replaced: Hydra's also take files that are only parts of an option."""
  text, group, value = str(override.input_line), override.key_or_group, override.value()
  entries = value.list if isinstance(value, ChoiceSweep) else [value]
  if not any(isinstance(entry, Glob) for entry in entries):
    return text
  if group not in groups(roots):
    raise ConfigError(f"{text}: {group} has no options that a glob could stand for.")
  known, names = listed_options(group, roots), []
  for entry in entries:
    names += entry.filter(known) if isinstance(entry, Glob) else [str(entry)]
  if not names:
    raise UnknownNameError(f"{text} matches no option of {group}.{nearest(str(override.get_value_string()), known)}")
  return f"{override.get_key_element()}={','.join(dict.fromkeys(names))}"


def _read(name: str) -> list[str]:
  """What a sweep file says, as overrides."""
  known = sweep_names()
  if name not in known:
    raise UnknownNameError(f"sweep={name} does not exist: choose from {', '.join(known)}.{nearest(name, known)}")
  try:
    content = OmegaConf.to_container(OmegaConf.load(shipped("sweeps") / f"{name}.yaml"))
  except (YAMLError, OmegaConfBaseException) as error:
    raise ConfigError(f"sweep={name}: its file cannot be read: {first_line(error)}.") from None
  params = content.get("params") if isinstance(content, Mapping) and set(content) == {"params"} else None
  if not isinstance(params, Mapping) or not params:
    raise ConfigError(f"sweep={name}: its file must hold `params:`, a mapping from keys to values, and nothing else.")
  return [_override(name, str(key), value) for key, value in params.items()]


def _override(name: str, key: str, value: Any) -> str:
  values = value if isinstance(value, list) else [value]
  if not values or any(isinstance(entry, Mapping) for entry in values):
    raise ConfigError(f"sweep={name}: params.{key}={format_value(value)} must be a value or a list of values.")
  return f"{key}={','.join(map(format_value, values))}"
