"""Many runs at once, `playground-run -m`: sweep files and globs, and the jobs that they stand for.

A file of sweeps/ says what varies, in the syntax of the command line; a list stands for its values one by one:

```yaml
params:
  env: [CheetahRun, glob(Walker*)]
  agent: sac
  seed: range(5)
```

It may list jobs that have more of their own, each a command line, which together with `params` is combined as well:

```yaml
params:
  seed: range(2)
jobs:
  - experiment=go1_joystick_chain curriculum.scale=0.5
  - env=CheetahRun agent=sac
```
"""

import itertools
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from hydra.core.override_parser.types import ChoiceSweep, Glob
from hydra.core.override_parser.types import Override as HydraOverride
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from playground.config.files import config_roots, groups, listed_options, shipped
from playground.config.overrides import is_hydras, is_of_command, is_of_sweep, parse, parse_with_hydra
from playground.errors import ConfigError, UnknownNameError, nearest
from playground.text import first_line, format_value

_HYDRAS_OWN = ("hydra.sweep", "hydra.launcher", "hydra/launcher", "hydra/sweeper")


def expand(overrides: Sequence[str]) -> list[str]:
  """Spells out what `-m` is given: `sweep=<name>` becomes what its file says, a glob the options it stands for.

  What the command line says of a key replaces what the file says of it.

  Raises:
    ConfigError: a sweep file that is none, a value that cannot be.
    UnknownNameError: no such sweep or option, or a glob that stands for none.
  """
  roots = config_roots()
  given = [parse_with_hydra(text) for text in overrides if not is_hydras(text)]
  named = [override for override in given if override.key_or_group == "sweep"]
  if len(named) > 1 or any(override.is_sweep_override() for override in named):
    raise ConfigError(f"{' '.join(str(o.input_line) for o in named)}: one sweep at a time.")
  keys = {override.key_or_group for override in given}
  listed = [parse_with_hydra(text) for override in named for text in _read(str(override.value()))[0]]
  chosen = [*(o for o in listed if o.key_or_group not in keys), *(o for o in given if o not in named)]
  return [*_checked(chosen, roots), *filter(is_hydras, overrides)]


def listed_jobs(overrides: Sequence[str]) -> list[list[str]]:
  """The `jobs` of the sweep file that `-m` is given, spelt out, without what the command line says otherwise.

  Raises:
    ConfigError: a job that cannot be, or one that says something of the whole sweep.
    UnknownNameError: as `expand`.
  """
  given = [parse_with_hydra(text) for text in overrides if not is_hydras(text)]
  keys = {override.key_or_group for override in given}
  found = []
  for override in (override for override in given if override.key_or_group == "sweep"):
    for text in _read(str(override.value()))[1]:
      parsed = [parse_with_hydra(part) for part in shlex.split(text)]
      lines = _checked([o for o in parsed if o.key_or_group not in keys], config_roots())
      if whole := [*split(lines)[0], *filter(is_of_command, lines)]:
        raise ConfigError(f"{override.input_line}: {whole[0]} in its job {text!r} is of the whole sweep.")
      found.append(lines)
  return found


def with_listed(lines: Sequence[str], jobs: Sequence[Sequence[str]]) -> list[list[str]]:
  """The lines of each listed job: what it says replaces what `lines` say of the same key. Without jobs, `lines`."""
  key = lambda line: parse_with_hydra(line).key_or_group
  together = []
  for job in jobs or [[]]:
    own = set(map(key, job))
    together.append([*(line for line in lines if key(line) not in own), *job])
  return together


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


def command_lines(overrides: Sequence[str]) -> list[str]:
  """What `-m` is given that each job's command gets and the sweep's folder does not keep (`is_of_command`).

  Raises:
    ConfigError: as `expand`, and for several values.
  """
  lines = [line for line in expand(overrides) if is_of_command(line)]
  for line in lines:
    if parse_with_hydra(line).is_sweep_override():
      raise ConfigError(f"{line}: all jobs of a sweep have the same one.")
  return lines


def check_saved_job(name: str, overrides: Iterable[str]) -> None:
  """Checks a job that was read from a sweep's folder, which may be somebody else's, before it is run.

  Raises:
    ConfigError: an override that says where the job writes, or that only a command line can say.
  """
  for text in overrides:
    if is_of_command(text) or split([text])[0]:
      raise ConfigError(f"Job {name} in sweep.yaml says {text}, which only a command line can: start the sweep anew.")


def combinations(*sets: Sequence[str]) -> list[list[str]]:
  """The overrides of each job that a sweep's lines stand for: every combination of their values, of each set of lines.

  Raises:
    ConfigError: an interval, which has no values to combine.
  """
  for line in itertools.chain(*sets):
    override = parse_with_hydra(line)
    if override.is_sweep_override() and not override.is_discrete_sweep():
      raise ConfigError(f"{line} is a range to draw from: add search=optuna, or list values.")
  jobs = (job for lines in sets for job in itertools.product(*map(_values, lines)))
  return [list(job) for job in dict.fromkeys(jobs)]


def varying(*sets: Iterable[str]) -> list[str]:
  """The keys and groups that have more than one value, in one set of lines or among several."""
  said = [{parse_with_hydra(line).key_or_group: tuple(_values(line)) for line in lines} for lines in sets]
  differs = lambda key: len({values.get(key) for values in said}) > 1
  listed = lambda key: any(len(values[key]) != 1 for values in said if key in values)
  return [key for key in dict.fromkeys(itertools.chain(*said)) if differs(key) or listed(key)]


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


def _checked(overrides: Iterable[HydraOverride], roots: Sequence[Path]) -> list[str]:
  """The overrides as lines, their globs spelt out, every value of them one that can be."""
  lines = [_spell_out(override, roots) for override in overrides]
  for line in lines:
    for one in _values(line):
      parse(one, roots)
  return lines


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


def _read(name: str) -> tuple[list[str], list[str]]:
  """What a sweep file says: `params` as overrides, and `jobs`."""
  known = sweep_names()
  if name not in known:
    raise UnknownNameError(f"sweep={name} does not exist: choose from {', '.join(known)}.{nearest(name, known)}")
  try:
    content = OmegaConf.to_container(OmegaConf.load(shipped("sweeps") / f"{name}.yaml"))
  except (YAMLError, OmegaConfBaseException) as error:
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
  return f"{key}={','.join(map(format_value, values))}"
