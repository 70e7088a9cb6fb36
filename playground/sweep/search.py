"""Searches hyperparameters: Optuna draws each job's values and learns from the job's result.

The study is a file in the sweep's folder (`study.log`), a trial is one of the sweep's jobs; both can be resumed.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

from hydra.core.override_parser.types import ChoiceSweep, IntervalSweep, RangeSweep
from hydra.core.override_parser.types import Override as HydraOverride

from playground import config as configs
from playground.config.overrides import parse_with_hydra
from playground.config.sweep_options import OptunaConfig
from playground.errors import CheckpointError, ConfigError, PlaygroundError
from playground.extras import install_command
from playground.sweep.folder import Job, JobFolder, SweepDirectory

try:
  import optuna
  from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
  from optuna.storages import JournalStorage
  from optuna.storages.journal import JournalFileBackend
  from optuna.trial import TrialState
except ImportError:
  raise ConfigError(f"search=optuna needs Optuna: {install_command('optuna')}.") from None

_SAMPLERS = {
  "tpe": lambda seed: optuna.samplers.TPESampler(seed=seed),
  "random": lambda seed: optuna.samplers.RandomSampler(seed=seed),
  "cmaes": lambda seed: optuna.samplers.CmaEsSampler(seed=seed),
}


_GOLDEN = 1.618  # divides an interval between whole numbers where no whole number is


def _drop_torn_line(log: Path) -> None:
  """Drops the last line if a kill or a full disk has cut it: Optuna would append to it."""
  if log.is_file():
    with log.open("rb+") as file:
      file.truncate(file.read().rfind(b"\n") + 1)


class Search:
  """Gets jobs from Optuna and reports their results."""

  def __init__(self, sweep: SweepDirectory, config: OptunaConfig, notify: Callable[[str], None] = print):
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    self._sweep = sweep
    self._config = config
    self._notify = notify
    self._refused = 0
    parsed = [parse_with_hydra(line) for line in sweep.lines]
    self._fixed = [line for line, o in zip(sweep.lines, parsed, strict=True) if not o.is_sweep_override()]
    self._drawn: dict[str, BaseDistribution] = {
      str(o.get_key_element()): distribution(o) for o in parsed if o.is_sweep_override()
    }
    log = sweep.path / "study.log"
    _drop_torn_line(log)
    try:
      self._study = optuna.create_study(
        storage=JournalStorage(JournalFileBackend(str(log))),
        sampler=_SAMPLERS[config.sampler](config.seed + len(sweep.jobs)),
        direction=config.direction,
        study_name=sweep.name,
        load_if_exists=True,
      )
    except OSError:
      raise
    except Exception as error:  # of any type: the file may hold anything
      raise CheckpointError(f"{log} is damaged: remove it, and the search goes on without what it knows.") from error
    if self._study.direction.name.lower() != config.direction:
      raise ConfigError(f"search.direction={config.direction}: this search began with the other one.")
    jobs = {job.name: job for job in sweep.jobs}
    for trial in self._study.get_trials(states=(TrialState.RUNNING,)):  # of an earlier start
      job = jobs.get(trial.user_attrs.get("job", ""))
      if job is None:
        self._study.tell(trial.number, state=TrialState.FAIL)
      elif sweep.folder(job).state().status == "finished":
        self.tell(job, sweep.folder(job))

  @property
  def trials(self) -> int:
    """Returns the total number of trials."""
    return self._config.trials

  @property
  def done(self) -> bool:
    """Whether all trials have been drawn."""
    return len(self._sweep.jobs) + self._refused >= self.trials

  def ask(self, at_work: int) -> Job | None:
    """Adds the next job to the sweep and returns it; None if enough jobs run, or if the drawn values are invalid."""
    if self.done or at_work >= self._config.parallel:
      return None
    trial = self._study.ask(self._drawn)
    overrides = [*self._fixed, *(f"{key}={value}" for key, value in trial.params.items())]
    try:
      with self._sweep.in_cwd():
        (config,) = configs.compose_all([overrides])
    except PlaygroundError as error:
      self._refused += 1
      self._study.tell(trial, state=TrialState.FAIL)
      self._notify(f"A trial is left out: {error}")
      return None
    job = Job.of_run(len(self._sweep.jobs), overrides, list(trial.params), config)
    trial.set_user_attr("job", job.name)
    self._sweep.add(job)
    return job

  def tell(self, job: Job, folder: JobFolder) -> None:
    """Records a job's result; the trial of an interrupted job stays open."""
    state = folder.state().status
    if state == "preempted":
      return
    value = folder.run.summary.get(self._config.metric) if state == "finished" else None
    trials = [t for t in self._study.get_trials(deepcopy=False) if t.user_attrs.get("job") == job.name]
    if not trials:
      self._notify(f"{job.name} is left out of the search: study.log was removed since it began.")
      return
    trial = trials[-1]
    if trial.state == TrialState.RUNNING:
      self._study.tell(trial.number, value, state=TrialState.FAIL if value is None else None)
    elif value is not None:  # the job failed at first, and finished after a second start
      again = optuna.create_trial(
        params=trial.params, distributions=trial.distributions, value=value, user_attrs=trial.user_attrs
      )
      self._study.add_trial(again)

  def best(self) -> str:
    """Returns a sentence about the best trial."""
    finished = self._study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if not finished:
      return "No trial has finished."
    trial = self._study.best_trial
    values = " ".join(f"{key}={configs.format_value(value)}" for key, value in trial.params.items())
    return f"Best of {len(finished)} trials: {self._config.metric} {trial.value:g} with {values}"


def distribution(override: HydraOverride) -> CategoricalDistribution | FloatDistribution | IntDistribution:
  """Returns the distribution of an override; `tag(log, interval(a, b))` is drawn on a log scale.

  Raises:
    ConfigError: the override has no distribution.
  """
  value = override.value()
  if isinstance(value, IntervalSweep):
    log, start, end = "log" in value.tags, value.start, value.end
    if start is None or end is None or start > end or (log and start <= 0):
      raise ConfigError(f"{override.input_line}: an interval needs ends in their order, above 0 on a log scale.")
    if isinstance(start, int) and isinstance(end, int):
      return IntDistribution(start, end, log=log)
    return FloatDistribution(start, end, log=log)
  if isinstance(value, ChoiceSweep | RangeSweep) and not value.shuffle:  # a study needs one order in every process
    numbers = list(value.range()) if isinstance(value, RangeSweep) else []
    if numbers and all(isinstance(number, int) for number in numbers):
      return IntDistribution(min(numbers), max(numbers), step=abs(int(value.step)))
    if choices := list(override.sweep_string_iterator()):
      return CategoricalDistribution(choices)
    raise ConfigError(f"{override.input_line} has no values to draw from.")
  raise ConfigError(f"{override.input_line}: a search draws from interval(a, b), range(a, b) or a list.")


def first_values(lines: Sequence[str], inside: bool = False) -> list[str]:
  """Returns the overrides of an example job: the first value of each list, the low end of each interval.

  With `inside` a value within an interval of floats, which is not whole: a search would draw such ones.

  Raises:
    ConfigError: no override has several values.
  """
  overrides, drawn = [], False
  for line in lines:
    override = parse_with_hydra(line)
    if override.is_sweep_override():
      drawn = True
      draws = distribution(override)
      value = draws.choices[0] if isinstance(draws, CategoricalDistribution) else draws.low
      if inside and isinstance(draws, FloatDistribution):
        value = draws.low + (draws.high - draws.low) / _GOLDEN
      overrides.append(f"{override.get_key_element()}={value}")
    else:
      overrides.append(line)
  if not drawn:
    example = "agent.learning_rate='tag(log,interval(1e-4,1e-2))'"
    raise ConfigError(f"search=optuna needs something to draw, such as {example}.")
  return overrides
