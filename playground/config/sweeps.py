"""Sweeps, `playground-run -m`: expands sweep files and globs into jobs.

A sweep file, ours in sweeps/ or your own, holds overrides as on the command line; a list is one job for each value.
Text with a comma, or another sign of the command line, needs its quotes, too: `"'a,b'"`.

```yaml
params:
  env: [CheetahRun, glob(Walker*)]
  agent: sac
  seed: range(5)
```

It may also list jobs, each a command line that is combined with `params`:

```yaml
params:
  seed: range(2)
jobs:
  - experiment=go1_joystick_chain curriculum.scale=0.5
  - env=CheetahRun agent=sac
```
"""

import contextlib
import itertools
import math
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from hydra.core.override_parser.types import ChoiceSweep, Glob, RangeSweep
from hydra.core.override_parser.types import Override as HydraOverride
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from playground.config.files import config_roots, groups, listed_options, shipped
from playground.config.overrides import SHORT_KEYS, is_hydras, is_of_command, is_of_sweep, parse, parse_with_hydra
from playground.errors import ConfigError, UnknownNameError, nearest
from playground.files import check_aliases
from playground.text import first_line, format_value, quoted

MAX_JOBS = 10_000  # of a sweep; 1,000 take 10 s to compose
_ONE_VALUE = "give one value, which applies to all jobs of the sweep"
_RESOLVER = re.compile(r"(?<!\\)(\\\\)*\$\{.*:", re.DOTALL)  # ${oc.env:HOME}, but not escaped, nor ${agent.num_envs}
_HYDRAS_OWN = ("hydra.sweep", "hydra.launcher", "hydra/launcher", "hydra/sweeper")


def expand(overrides: Sequence[str]) -> list[str]:
  """Expands the overrides of `-m`: `sweep=<name or path>` becomes the overrides of its file, a glob its options.

  The command line wins over the file.

  Raises:
    ConfigError: an invalid sweep file or value.
    UnknownNameError: no such sweep or option, or a glob without a match.
  """
  roots = config_roots()
  given = [parse_with_hydra(text) for text in overrides if not is_hydras(text)]
  named = [override for override in given if override.key_or_group == "sweep"]
  if len(named) > 1 or any(override.is_sweep_override() for override in named):
    raise ConfigError(f"{' '.join(str(o.input_line) for o in named)}: one sweep at a time.")
  keys = set(map(_key, given))
  listed = [parse_with_hydra(text) for override in named for text in _read(str(override.value()))[0]]
  chosen = [*(o for o in listed if _key(o) not in keys), *(o for o in given if o not in named)]
  for override in chosen:
    twice = [str(o.input_line) for o in chosen if _key(o) == _key(override)]
    if override.is_sweep_override() and len(twice) > 1:
      raise ConfigError(f"{' '.join(twice)}: give all values of {override.key_or_group} in one list.")
  return [*_checked(chosen, roots), *filter(is_hydras, overrides)]


def listed_jobs(overrides: Sequence[str]) -> list[list[str]]:
  """Returns the expanded `jobs` of the sweep file of `-m`, without keys that the command line sets.

  Raises:
    ConfigError: an invalid job, or one that sets a key of the whole sweep.
    UnknownNameError: as `expand`.
  """
  given = [parse_with_hydra(text) for text in overrides if not is_hydras(text)]
  keys = set(map(_key, given))
  found = []
  for override in (override for override in given if override.key_or_group == "sweep"):
    for text in _read(str(override.value()))[1]:
      try:
        parts = shlex.split(text)
      except ValueError as error:
        raise ConfigError(f"{override.input_line}: its job {text!r} cannot be read: {error}.") from None
      parsed = [parse_with_hydra(part) for part in parts]
      lines = _checked([o for o in parsed if _key(o) not in keys], config_roots())
      if whole := [*split(lines)[0], *filter(is_of_command, lines)]:
        raise ConfigError(f"{override.input_line}: {whole[0]} in its job {text!r} is of the whole sweep.")
      found.append(lines)
  return found


def _key(override: HydraOverride) -> str:
  """Returns the key that an override sets, whichever form of it the line has."""
  return SHORT_KEYS.get(override.key_or_group, override.key_or_group)


def with_listed(lines: Sequence[str], jobs: Sequence[Sequence[str]]) -> list[list[str]]:
  """Returns the overrides of each listed job, which win over `lines`; without jobs, `lines` alone."""
  key = lambda line: _key(parse_with_hydra(line))
  together = []
  for job in jobs or [[]]:
    own = set(map(key, job))
    together.append([*(line for line in lines if key(line) not in own), *job])
  return together


def split(lines: Iterable[str]) -> tuple[list[str], list[str]]:
  """Divides expanded overrides into those of the sweep itself and those of its jobs.

  Raises:
    ConfigError: a key that jobs of a sweep must not set, several values of a setting, or a job's value that calls a
      resolver, which another user's sweep.yaml may have read environment variables.
  """
  settings, ours = [], []
  for line in lines:
    override = parse_with_hydra(line)
    key = override.key_or_group
    if key in ("run_dir", "resume"):
      instead = "sweep_dir=<path> says where a sweep lies, the same command again continues it"
      raise ConfigError(f"{line} cannot be given with -m, whose jobs lie in the sweep's folder: {instead}.")
    if line.lstrip("+~").startswith(_HYDRAS_OWN):
      raise ConfigError(f"{line}: -m does not use Hydra's launchers and sweepers, launcher=<name> is ours.")
    if is_of_sweep(key) and override.is_sweep_override():
      raise ConfigError(f"{line}: {_ONE_VALUE}.")
    if not (is_of_sweep(key) or is_of_command(line)) and _RESOLVER.search(line):
      raise ConfigError(f"{line}: a job calls no resolver, write the value itself.")
    (settings if is_of_sweep(key) else ours).append(line)
  return settings, ours


def command_lines(overrides: Sequence[str]) -> list[str]:
  """Returns the overrides of `-m` that every job's command gets but no file of the sweep (`is_of_command`).

  Raises:
    ConfigError: as `expand`, and for several values.
  """
  lines = [line for line in expand(overrides) if is_of_command(line)]
  for line in lines:
    if parse_with_hydra(line).is_sweep_override():
      raise ConfigError(f"{line}: {_ONE_VALUE}.")
  return lines


def check_saved_job(name: str, overrides: Iterable[str]) -> None:
  """Checks a job read from a sweep's folder, which another user may have written, before it runs.

  Raises:
    ConfigError: as `split`, or an override that only a command line may set.
  """
  for text in overrides:
    if is_of_command(text) or split([text])[0]:
      raise ConfigError(f"Job {name} in sweep.yaml says {text}, which only a command line can: start a new sweep.")


def combinations(*sets: Sequence[str]) -> list[list[str]]:
  """Returns the overrides of each job of a sweep: every combination of values, for each set of lines.

  Raises:
    ConfigError: an interval, which has no values to combine; no combination, or more than `MAX_JOBS`.
  """
  for line in itertools.chain(*sets):
    override = parse_with_hydra(line)
    if override.is_sweep_override() and not override.is_discrete_sweep():
      raise ConfigError(f"{line} is a range to draw from: add search=optuna, or list values.")
  values = [[_values(line) for line in lines] for lines in sets]
  if (count := sum(math.prod(map(len, each)) for each in values)) > MAX_JOBS:
    raise ConfigError(f"This sweep has {count:,} jobs, more than {MAX_JOBS:,}: list fewer values, or search=optuna.")
  jobs = dict.fromkeys(job for each in values for job in itertools.product(*each))
  if not jobs:
    raise ConfigError("This sweep has no job: one of its keys has no value.")
  return [list(job) for job in jobs]


def varying(*sets: Iterable[str]) -> list[str]:
  """Returns the keys and groups with more than one value, in one set of lines or among several."""
  values_of = [{parse_with_hydra(line).key_or_group: tuple(_values(line)) for line in lines} for lines in sets]
  differs = lambda key: len({values.get(key) for values in values_of}) > 1
  listed = lambda key: any(len(values[key]) != 1 for values in values_of if key in values)
  return [key for key in dict.fromkeys(itertools.chain(*values_of)) if differs(key) or listed(key)]


def sweep_names() -> list[str]:
  """Returns the names of the sweeps we ship, sorted."""
  return sorted(path.stem for path in shipped("sweeps").glob("*.yaml"))


def _values(text: str) -> list[str]:
  """Returns an override for each of its values."""
  override = parse_with_hydra(text)
  if not override.is_sweep_override():
    return [text]
  if not override.is_discrete_sweep():  # an interval: a search draws from it
    return []
  value = override.value()
  if isinstance(value, ChoiceSweep) and any(isinstance(entry, RangeSweep) for entry in value.list):
    raise ConfigError(f"{text}: a range stands alone, so list its values among the others.")
  try:
    return [f"{override.get_key_element()}={value}" for value in override.sweep_string_iterator()]
  except ValueError as error:
    raise ConfigError(f"{text} has no values: {error}.") from None


def _checked(overrides: Iterable[HydraOverride], roots: Sequence[Path]) -> list[str]:
  """Returns the overrides as lines, with globs expanded and every value checked."""
  lines = [_spell_out(override, roots) for override in overrides]
  for line in lines:
    for one in _values(line):
      parse(one, roots)
  return lines


def _spell_out(override: HydraOverride, roots: Sequence[Path]) -> str:
  """Returns the override with its globs expanded: Hydra's own would also match shared files (_name.yaml)."""
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


def _read(name: str) -> tuple[list[str], list[str]]:
  """Reads one of our sweep files, or the one at a path that ends in .yaml: `params` as overrides, and `jobs`."""
  known, path = sweep_names(), Path(name).expanduser()
  if path.suffix == ".yaml":
    if not path.is_file():
      raise UnknownNameError(f"sweep={name} does not exist, or is not a file.")
  elif name in known:
    path = shipped("sweeps") / f"{name}.yaml"
  else:
    choices = f"choose from {', '.join(known)}, or give the path of a .yaml file"
    raise UnknownNameError(f"sweep={name} does not exist: {choices}.{nearest(name, known)}")
  try:
    check_aliases(path)
    content = OmegaConf.to_container(OmegaConf.load(path))
  except (YAMLError, OmegaConfBaseException, ValueError, RecursionError, OSError) as error:
    raise ConfigError(f"sweep={name}: its file cannot be read: {first_line(error)}.") from None
  if not isinstance(content, Mapping) or not content or not set(content) <= {"params", "jobs"}:
    raise ConfigError(f"sweep={name}: its file must hold `params:` or `jobs:` or both, and nothing else.")
  params, jobs = content.get("params"), content.get("jobs")
  if "params" in content and (not isinstance(params, Mapping) or not params):
    raise ConfigError(f"sweep={name}: `params:` must be a mapping from keys to values.")
  if "jobs" in content and not (isinstance(jobs, list) and jobs and all(isinstance(job, str) for job in jobs)):
    raise ConfigError(f"sweep={name}: `jobs:` must be a list of command lines.")
  return [_override(name, str(key), value) for key, value in (params or {}).items()], list(jobs or [])


def _override(name: str, key: str, value: object) -> str:
  values = value if isinstance(value, list) else [value]
  if not values or any(isinstance(entry, Mapping) for entry in values):
    raise ConfigError(f"sweep={name}: params.{key}={format_value(value)} must be a value or a list of values.")
  for entry in values if isinstance(value, list) else []:
    _check_entry(name, key, entry)
  return f"{key}={','.join(map(format_value, values))}"


def _check_entry(name: str, key: str, entry: object) -> None:
  """Raises ConfigError for text in a list that the command line would read as several values, or not at all."""
  if not isinstance(entry, str):
    return
  with contextlib.suppress(ConfigError):
    if not isinstance(parse_with_hydra(f"{key}={entry}").value(), ChoiceSweep):
      return
  raise ConfigError(f'sweep={name}: {entry!r} in params.{key} is not one value: write "{quoted(entry)}".')
