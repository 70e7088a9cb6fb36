"""Defines the options that the commands share, and builds their measurements."""

import abc
import dataclasses
from collections.abc import Sequence
from typing import Annotated

from playground import registry
from playground.benchmark.arguments import check_limits
from playground.benchmark.jobs import Measurement, Plan
from playground.config import RunConfig, compose
from playground.config.files import task_names
from playground.errors import ConfigError, UnknownNameError, nearest
from playground.limits import count, positive
from playground.paper import SUITES, tasks_of

TRAINING = "training_steps_per_s"
QUANTITY = {  # the last row of a measurement
  "training": TRAINING,
  "environment": "env_steps_per_s",
  "breakdown": "seconds_per_step",
  "runs:startup": "start_to_first_update_s",
}


@dataclasses.dataclass(frozen=True)
class Measuring(Plan, abc.ABC):
  """Options of all commands that measure."""

  out: Annotated[str | None, "CSV that rows are added to; null is results/benchmarks/<command>.csv"] = None
  overrides: Annotated[Sequence[str], "of the run's configuration"] = ()

  name = "measuring"
  alone = False  # whether no other measurement may run at the same time

  @abc.abstractmethod
  def jobs(self, devices: int) -> list[Measurement]:
    """Returns the measurements on a machine with this number of devices."""

  def check(self) -> None:
    """Raises PlaygroundError for invalid options, before anything expensive starts."""
    check_limits(self)
    if self.alone and self.workers > 1:
      raise ConfigError(f"workers={self.workers}: {self.name} wants the machine to itself, workers=1.")

  def columns(self, task: str, agent: str, setting: Sequence[str] = (), who: str = "ours") -> dict[str, str]:
    texts = " ".join((*self.overrides, *setting))
    return {"benchmark": self.name, "task": task, "agent": agent, "who": who, "setting": texts}


@dataclasses.dataclass(frozen=True)
class OfTasks(Measuring):
  """Options of commands that measure tasks with one algorithm."""

  suite: Annotated[str | None, "dm_control, locomotion, manipulation or all: the tasks of the paper's tables"] = None
  tasks: Annotated[Sequence[str], "tasks by name, instead of a suite or on top"] = ()
  agent: Annotated[str, "an option of agent, such as ppo, ppo_paper or sac"] = "ppo"
  seconds: Annotated[float, positive(), "how long to time each number, at least one update"] = 4.0

  sets_devices = True  # whether the command sets hardware.devices

  def check(self) -> None:
    super().check()
    if self.sets_devices and any(text.lstrip("+").startswith("hardware.devices=") for text in self.overrides):
      raise ConfigError(
        f"hardware.devices= is no override of {self.name}: only topology, with devices=, measures on several."
      )
    for task in self.chosen() if self.overrides else self.chosen()[:1]:  # without overrides, all tasks are valid
      registry.check(self.configured(task).env)

  def chosen(self) -> list[str]:
    """Returns the tasks of `suite` and `tasks`, each once; tasks of a suite that this package lacks are left out."""
    if not self.suite and not self.tasks:
      raise ConfigError(f"Name what to measure: tasks=CartpoleBalance,CheetahRun or suite={'|'.join(SUITES)}|all.")
    known = task_names()
    for name in self.tasks:
      if name not in known:
        raise UnknownNameError(f"Task {name!r} does not exist; `playground list` shows all.{nearest(name, known)}")
    return list(dict.fromkeys([*self.tasks, *(n for n in tasks_of(self.suite or "all") if self.suite and n in known)]))

  def configured(self, task: str, *more: str) -> RunConfig:
    """Returns the configuration of a task's run; raises ConfigError for invalid overrides."""
    return compose([f"env={task}", f"agent={self.agent}", *self.overrides, *more])

  def with_envs(self, task: str, count: int) -> list[str]:
    """Returns overrides for a number of environments; PPO's batch grows until each fills a whole trajectory."""
    setting = [f"agent.num_envs={count}"]
    if self.agent.startswith("ppo"):  # an environment fills whole trajectories, at least the tuned number
      agent = self.configured(task).agent
      batch = agent.batch_size * max(1, -(-count // (agent.batch_size * agent.num_minibatches)))
      setting += [f"agent.batch_size={batch}"] * (batch != agent.batch_size)
    self.configured(task, *setting)  # raises for a number that does not fit
    return setting

  def job(self, measure: str, task: str, setting: Sequence[str] = (), **arguments: object) -> Measurement:
    """Returns a measurement with the overrides of `setting`."""
    overrides = [*self.overrides, *setting]
    arguments = {"task": task, "agent": self.agent, "overrides": overrides, "seconds": self.seconds, **arguments}
    return Measurement(measure, arguments, self.columns(task, self.agent, setting), {"quantity": QUANTITY[measure]})

  def on_one_device(self, job: Measurement) -> Measurement:
    """Returns the measurement on one device for each process; `setting` omits the device, as most tables have one."""
    arguments = {**job.arguments, "overrides": [*job.arguments["overrides"], "hardware.devices=1"]}
    return dataclasses.replace(job, arguments=arguments)


@dataclasses.dataclass(frozen=True)
class OfRuns(OfTasks):
  """Options of commands that also train whole runs."""

  num_timesteps: Annotated[int | None, count(1, 1e12), "control steps of a whole run"] = None

  def check(self) -> None:
    super().check()
    if any(text.lstrip("+").startswith("agent.num_timesteps=") for text in self.overrides):
      raise ConfigError(f"agent.num_timesteps= is no override of {self.name}: give num_timesteps=, for all whole runs.")

  def budget(self) -> list[str]:
    return [] if self.num_timesteps is None else [f"agent.num_timesteps={self.num_timesteps}"]

  def whole_run(self, task: str, agent: str, seed: int, setting: Sequence[str] = ()) -> Measurement:
    """Returns the measurement of a whole run."""
    setting = [*setting, *self.budget()]
    texts = [*self.overrides, *setting]
    arguments = {"task": task, "agent": agent, "overrides": texts, "setting": texts, "seeds": [seed]}
    return Measurement("runs:whole", arguments, self.columns(task, agent, setting), {"quantity": "final_return"})
