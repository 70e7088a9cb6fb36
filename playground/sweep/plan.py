"""Plans a sweep from a command line: composes and checks its jobs, and writes or finds its folder."""

import json
import os
import re
import sys
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from playground import config as configs
from playground import registry
from playground.config import RunConfig
from playground.config.sweep_options import GridConfig, SweepSettings
from playground.errors import CheckpointError, ConfigError
from playground.sweep.folder import Job, SweepDirectory
from playground.sweep.runner import launcher_class

ROOT = Path("results/sweeps")


def compose_jobs(overrides: Sequence[str]) -> list[RunConfig]:
  """Composes the configurations of all jobs of `-m`; of a search, that of its first job."""
  _, chosen, sets = _lines(overrides)
  if not isinstance(chosen.search, GridConfig):
    from playground.sweep.search import first_values

    return configs.compose_all([first_values(sets[0])])
  return [config for _, config in _composed(sets)]


def _composed(sets: Sequence[Sequence[str]]) -> list[tuple[list[str], RunConfig]]:
  """Composes the jobs of a grid, and leaves out one that is another in other words, such as 1e6 and 1000000 steps."""
  combinations = configs.combinations(*sets)
  different: dict[str, tuple[list[str], RunConfig]] = {}
  for job, config in zip(combinations, configs.compose_all(combinations), strict=True):
    different.setdefault(json.dumps([config.choices, config.resolved]), (job, config))
  return list(different.values())


def plan(overrides: Sequence[str]) -> tuple[SweepDirectory, SweepSettings]:
  """Composes and checks every job, and writes the sweep or finds it on disk.

  A `sweep_dir` that holds the same jobs is continued. Without `sweep_dir`, the newest unfinished sweep of the same name
  and jobs is continued.

  Returns:
    The sweep, and its settings.

  Raises:
    PlaygroundError: a job, a setting or the launcher is invalid; nothing is written then.
  """
  settings, chosen, sets = _lines(overrides)
  lines = sets[0]
  if not isinstance(chosen.search, GridConfig):
    from playground.sweep.search import first_values

    (config, _), jobs = configs.compose_all([first_values(lines), first_values(lines, inside=True)]), []
    name = _name(overrides, [config])
  else:
    composed = _composed(sets)
    name = _name(overrides, [config for _, config in composed])
    varying = configs.varying(*sets)
    jobs = [Job.of_run(number, job, varying, config) for number, (job, config) in enumerate(composed)]
    for job, config in composed:
      _check_task(job, config)
  lines = [line for line in lines if not configs.is_of_command(line)]
  found = _find(chosen.sweep_dir, name, settings, lines, jobs)
  command = ["playground-run", "-m", *overrides]
  settings = [line for line in settings if not line.startswith("sweep_dir=")]
  if found is not None:
    found.command, found.settings = command, settings  # `run_sweep` saves them, for `playground sweep retry`
    return found, chosen
  launcher_class(chosen.launcher).check(chosen.launcher, jobs)
  path = chosen.sweep_dir or ROOT / name / f"{datetime.now():%Y-%m-%d_%H-%M-%S}"
  new = SweepDirectory.create(path, name, command, settings, lines, jobs, numbered=chosen.sweep_dir is None)
  return new, chosen


def _check_task(job: Sequence[str], config: RunConfig) -> None:
  """Raises ConfigError, with the job's overrides, for a key, term or number of its task that is invalid."""
  try:
    for one in config.stages or [config]:
      registry.check(one.env)
  except ConfigError as error:
    raise type(error)(f"Job {' '.join(job)}: {error}") from None


def _lines(overrides: Sequence[str]) -> tuple[list[str], SweepSettings, list[list[str]]]:
  """Splits a command line.

  Returns:
    The overrides of the sweep, the settings they make, and the overrides of its jobs, one list for each listed job.

  Raises:
    ConfigError: the overrides or the sweep file are invalid, or a search has listed jobs.
  """
  settings, lines = configs.split(configs.expand(overrides))
  chosen, listed = configs.compose_settings(settings), configs.listed_jobs(overrides)
  if listed and not isinstance(chosen.search, GridConfig):
    raise ConfigError("A search draws from what one job may be: its sweep file cannot list jobs.")
  return settings, chosen, [configs.with_default_experiment(one) for one in configs.with_listed(lines, listed)]


def _name(overrides: Sequence[str], composed: Sequence[RunConfig]) -> str:
  """Returns the sweep file's name, or the names of the jobs' runs."""
  for text in overrides:
    override = configs.parse_with_hydra(text)
    if override.key_or_group == "sweep":
      return Path(str(override.value())).stem
  names = list(dict.fromkeys(config.name for config in composed))
  return "_".join(names[:2]) + (f"_and_{len(names) - 2}_more" if len(names) > 2 else "")


def _find(
  path: str | None, name: str, settings: Sequence[str], lines: Sequence[str], jobs: Sequence[Job]
) -> SweepDirectory | None:
  """Returns an earlier sweep of the same jobs; None without one.

  Raises:
    ConfigError: `path` holds a sweep of other jobs.
  """
  if path is not None:
    if not (Path(os.path.expanduser(path)) / "sweep.yaml").exists():
      return None
    sweep = SweepDirectory.open(path)
    if not _same(sweep, settings, lines, jobs):
      raise ConfigError(
        f"sweep_dir={path} holds a sweep of other jobs ({' '.join(sweep.command)}): name another folder, or give the "
        "same command to continue it."
      )
    return sweep
  for folder in sorted((ROOT / name).glob("*/sweep.yaml"), reverse=True):
    try:
      sweep = SweepDirectory.open(folder.parent)
    except CheckpointError as error:
      print(f"{error} It is passed over.", file=sys.stderr)
      continue
    if _same(sweep, settings, lines, jobs):
      done = all(state.status == "finished" for state in sweep.states().values())
      return None if done and jobs else sweep
  return None


def _same(sweep: SweepDirectory, settings: Sequence[str], lines: Sequence[str], jobs: Sequence[Job]) -> bool:
  """Returns whether a sweep has the same search, lines and jobs, the jobs in any order (`shuffle`)."""
  search = lambda texts: [text for text in texts if text.startswith("search=") and text != "search=grid"]
  ours, theirs = (sorted(job.overrides for job in side) for side in (jobs, sweep.jobs))
  return search(sweep.settings) == search(settings) and sweep.lines == list(lines) and (not jobs or theirs == ours)


def settings_of(sweep: SweepDirectory, extra: Sequence[str] = ()) -> SweepSettings:
  """Returns the settings of a sweep, changed by `extra`.

  Raises:
    ConfigError: a key that sweeps do not have, or an invalid value.
  """
  for text in extra:
    if not configs.is_of_sweep(text.lstrip("+~").partition("=")[0]):
      raise ConfigError(f"{text} cannot be changed in a sweep that has begun: only launcher, search and on_error can.")
  keys = {text.partition("=")[0] for text in extra}
  kept = [text for text in sweep.settings if text.partition("=")[0] not in keys]
  if "launcher" in keys:  # another launcher has other keys
    kept = [text for text in kept if not text.startswith("launcher.")]
  for text in kept:
    if not _is_plain(text):
      what = "may name a program or a machine, or lets Optuna read pickles"
      raise ConfigError(
        f"{sweep.path / 'sweep.yaml'} says {text}, which {what}: give it again on this command line if you trust it."
      )
  return configs.compose_settings([*kept, *extra])


def _is_plain(setting: str) -> bool:
  """Returns whether a setting of a sweep.yaml, which another user may have written, is harmless.

  Text that a scheduler gets must be one word. A list may hold lines of shell, except `launcher.explore`, which holds
  keys. CMA-ES stores pickles in the sweep's study.
  """
  override = configs.parse_with_hydra(setting)
  value = override.value()
  values = value if isinstance(value, list) and override.key_or_group == "launcher.explore" else [value]
  harmless = lambda text: bool(re.fullmatch(r"[A-Za-z0-9_.-]+", text)) and text != "cmaes"
  return all(harmless(one) if isinstance(one, str) else one is None or isinstance(one, int | float) for one in values)
