"""Defines the commands: options and measurements of each."""

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from playground.benchmark.jobs import Measurement, probe, run_jobs
from playground.benchmark.options import TRAINING, Measuring, OfRuns, OfTasks
from playground.benchmark.peer import PEERS, check_peer
from playground.benchmark.schema import Table
from playground.config import compose
from playground.errors import ConfigError
from playground.files import need_folder
from playground.limits import count, counts
from playground.paper import tasks_of

RESULTS = Path("results/benchmarks")

# Conditions of the paper's pixel tables (appendix D): episodes of 3 and 4 s, for the Panda with randomisation.
PIXEL_CONDITIONS = {
  "CartpoleBalanceVision": ["env.ctrl_dt=0.04", "env.episode_length=75"],
  "PandaPickCubeCartesianVision": [
    "randomization=panda_vision",
    "env.episode_length=80",
    "env.vision.brightness=[0.25,1.1]",
  ],
}
COMPARED_CONDITIONS = [f"env.ctrl_dt={1 / 60}", f"env.sim_dt={1 / 120}", "env.episode_length=180"]


@dataclasses.dataclass(frozen=True)
class Throughput(OfTasks):
  """Training steps/s of each task at the paper's hyperparameters on one device, compile and start time, memory."""

  agent: str = "ppo_paper"
  seeds: Annotated[int, count(1), "trainings timed, seeds 1 to this"] = 5

  name = "throughput"

  def jobs(self, devices: int) -> list[Measurement]:
    seeds = list(range(1, self.seeds + 1))
    return [self.on_one_device(self.job("training", task, seeds=seeds)) for task in self.chosen()]


@dataclasses.dataclass(frozen=True)
class Together(OfTasks):
  """Training steps/s of several agents in one program (`launcher=together`), added up, on one device; memory."""

  num_agents: Annotated[Sequence[int], counts(1), "numbers of agents; 1 is a run alone"] = (1, 5)

  name = "together"

  def jobs(self, devices: int) -> list[Measurement]:
    jobs = []
    for task in self.chosen():
      for number in self.num_agents:
        job = self.on_one_device(self.job("training", task, seeds=[1], num_agents=number))
        columns = self.columns(task, self.agent, [f"num_agents={number}"])
        jobs.append(dataclasses.replace(job, columns=columns))
    return jobs


@dataclasses.dataclass(frozen=True)
class Startup(OfTasks):
  """Time from the command to the first update, with empty caches and then full ones, evaluation compiled too."""

  name = "startup"
  alone = True
  sets_devices = False

  def jobs(self, devices: int) -> list[Measurement]:
    last = {"quantity": "start_to_first_update_s", "setting": " ".join((*self.overrides, "warm"))}
    last |= {"devices": str(devices)}
    jobs = [self.job("runs:startup", task) for task in self.chosen()]
    return [dataclasses.replace(job, last=last) for job in jobs]


@dataclasses.dataclass(frozen=True)
class Scaling(OfTasks):
  """Environment and training steps/s and memory over the number of environments, on one device."""

  num_envs: Annotated[Sequence[int], counts(1), "numbers of environments"] = (256, 1024, 4096, 16384)

  name = "scaling"

  def jobs(self, devices: int) -> list[Measurement]:
    jobs = []
    for task in self.chosen():
      for envs in self.num_envs:
        setting = self.with_envs(task, envs)
        both = self.job("environment", task, setting), self.job("training", task, setting, seeds=[1])
        jobs += map(self.on_one_device, both)
    return jobs


@dataclasses.dataclass(frozen=True)
class Breakdown(OfTasks):
  """Time of a training step by part: physics, task, episodes, inference, storing, update, added one by one."""

  name = "breakdown"

  def jobs(self, devices: int) -> list[Measurement]:
    last = {"quantity": "seconds_per_step", "setting": " ".join((*self.overrides, "part=update"))}
    jobs = [self.on_one_device(self.job("breakdown", task)) for task in self.chosen()]
    return [dataclasses.replace(job, last=last) for job in jobs]


@dataclasses.dataclass(frozen=True)
class Pixels(OfTasks):
  """Time of a step from pixels, as in the paper: state alone, with images, with inference, with training."""

  sizes: Annotated[Sequence[int], counts(1), "sides of the images"] = (32, 64, 128, 256)
  num_envs: Annotated[Sequence[int], counts(1), "numbers of environments"] = (1024,)
  compared: Annotated[bool, "Cartpole up to images, in steps of 1/60 s, as the paper compares simulators"] = False

  name = "pixels"

  def chosen(self) -> list[str]:
    if self.suite or self.tasks:
      return super().chosen()
    return ["CartpoleBalanceVision"] if self.compared else list(PIXEL_CONDITIONS)

  def check(self) -> None:
    super().check()
    if not self.agent.startswith("ppo"):
      raise ConfigError(f"agent={self.agent} reads no images: pixels is of agent=ppo.")
    if self.compared and self.chosen() != ["CartpoleBalanceVision"]:
      raise ConfigError("compared=true is of CartpoleBalanceVision alone: leave tasks= and suite= away.")
    for task in self.chosen():
      if not self.configured(task).env.vision.enable:
        raise ConfigError(f"{task} has no images: add env.vision.enable=true env.vision.camera=<name>.")

  def jobs(self, devices: int) -> list[Measurement]:
    jobs = []
    until = "pixels" if self.compared else "update"  # simulators are compared without policies
    for task in self.chosen():
      conditions = COMPARED_CONDITIONS if self.compared else PIXEL_CONDITIONS.get(task, [])
      for size in self.sizes:
        for envs in self.num_envs:
          seen = [f"env.vision.width={size}", f"env.vision.height={size}"]
          setting = [*conditions, *seen, *self.with_envs(task, envs)]
          last = {"quantity": "seconds_per_step", "setting": " ".join((*self.overrides, *setting, f"part={until}"))}
          job = self.job("breakdown", task, setting, watch_memory=self.workers == 1, until=until)
          jobs.append(dataclasses.replace(self.on_one_device(job), last=last))
    return jobs


@dataclasses.dataclass(frozen=True)
class Topology(OfRuns):
  """Training steps/s, and whole runs, on 1, 2, 4, ... devices, with hyperparameters unchanged and scaled."""

  devices: Annotated[Sequence[int], counts(1), "numbers of devices; none is 1, 2, 4, ... up to all"] = ()
  hyperparameters: Annotated[Sequence[str], "scaled: environments and batch times the devices"] = ("fixed", "scaled")
  seeds: Annotated[int, count(1), "trainings timed, and whole runs of each, seeds 1 to this"] = 3
  num_timesteps: Annotated[
    int | None, count(1, 1e12), "control steps of a whole run on each, after the rates; null measures only rates"
  ] = None

  name = "topology"

  def check(self) -> None:
    super().check()
    if self.gpus:
      raise ConfigError(f"gpus={list(self.gpus)}: topology uses the devices itself, say how many with devices=.")
    for kind in self.hyperparameters:
      if kind not in ("fixed", "scaled"):
        raise ConfigError(f"hyperparameters={kind} must be fixed, scaled or both.")

  def jobs(self, devices: int) -> list[Measurement]:
    numbers = self.devices or [2**i for i in range(devices.bit_length())]
    if max(numbers) > devices:
      raise ConfigError(f"devices={list(numbers)}: this machine has {devices}.")
    seeds = list(range(1, self.seeds + 1))
    rates, runs = [], []
    for task in self.chosen():
      for number in numbers:
        for kind in self.hyperparameters if number > 1 else ("fixed",):
          setting = [f"hardware.devices={number}"]
          setting += ["hardware.scale_envs=true"] * (kind == "scaled")
          rates.append(self.job("training", task, setting, seeds=seeds))
          runs += [self.whole_run(task, self.agent, seed, setting) for seed in seeds]
    return rates if self.num_timesteps is None else rates + runs


@dataclasses.dataclass(frozen=True)
class Chain(Measuring):
  """Runs a fine-tuning curriculum and reports each stage's return and time."""

  experiment: Annotated[str, "an experiment that is a chain"] = "go1_joystick_chain"
  runs: Annotated[str, "folder of the run directories; an unfinished one is resumed"] = str(RESULTS / "chains")
  seeds: Annotated[int, count(1), "runs, seeds 1 to this"] = 1

  name = "chain"
  alone = True

  def check(self) -> None:
    super().check()
    need_folder(Path(self.runs).expanduser(), f"runs={self.runs}")
    if not compose([f"experiment={self.experiment}", *self.overrides]).stages:
      raise ConfigError(f"experiment={self.experiment} is no chain: choose one that ends in _chain.")

  def jobs(self, devices: int) -> list[Measurement]:
    agent = compose([f"experiment={self.experiment}", *self.overrides]).agent_name
    arguments = {"experiment": self.experiment, "overrides": list(self.overrides)}
    arguments |= {"runs": self.runs, "again": self.rerun, "devices": devices}
    columns = self.columns(self.experiment, agent)
    last = {"quantity": "wall_clock_s", "setting": " ".join((*self.overrides, "stage=all")), "devices": str(devices)}
    return [
      Measurement("runs:chain", {**arguments, "seeds": [seed]}, columns, last) for seed in range(1, self.seeds + 1)
    ]


@dataclasses.dataclass(frozen=True)
class BesidePeer(OfTasks):
  """Options of commands that also measure another package, with its hyperparameters on both sides."""

  peer: Annotated[str, "the package to compare with"] = "playground020"
  peer_python: Annotated[str, "interpreter of the environment that it is installed in"] = "python3"
  peer_path: Annotated[str, "PYTHONPATH of that interpreter"] = ""
  peer_menagerie: Annotated[str, "folder of its robot models, if it should not download them"] = ""
  backends: Annotated[Sequence[str], "the peer's backends; ours is the task's own choice"] = ("jax", "warp")

  agents = ("ppo",)  # that can be compared

  @property
  def ours(self) -> str:
    """Returns `agent` of our side."""
    return f"{self.agent}_v020"

  def check(self) -> None:
    super().check()
    if others := set(self.backends) - {"jax", "warp"}:
      raise ConfigError(f"backends={','.join(sorted(others))} does not exist: choose from jax, warp.")
    if self.agent not in self.agents:
      raise ConfigError(f"agent={self.agent}: {self.name} is of {' or '.join(self.agents)}.")
    check_peer(self.peer, self.peer_python, self.peer_path, self.peer_menagerie)

  def peer_job(
    self, measure: str, quantity: str, task: str, setting: Sequence[str], /, **arguments: object
  ) -> Measurement:
    """Returns a measurement of the peer, which ignores the overrides of our run."""
    peer = {"name": self.peer, "python": self.peer_python, "path": self.peer_path, "menagerie": self.peer_menagerie}
    columns = self.columns(task, self.agent, setting, PEERS[self.peer].label)
    return Measurement(measure, {"task": task, "peer": peer, **arguments}, columns, {"quantity": quantity})


@dataclasses.dataclass(frozen=True)
class Compare(BesidePeer):
  """Our PPO and the public package's, in turn, on one machine in one call; the best of the repeats counts."""

  repeats: Annotated[int, count(1), "turns"] = 3

  name = "compare"
  alone = True

  def jobs(self, devices: int) -> list[Measurement]:
    jobs = []
    for task in self.chosen():
      for turn in range(1, self.repeats + 1):
        ours = self.job("training", task, seeds=[turn], agent=self.ours, watch_memory=True)
        jobs.append(self.on_one_device(dataclasses.replace(ours, columns=self.columns(task, self.ours))))
        for backend in self.backends:
          of_it = {"seconds": self.seconds, "backend": backend, "seeds": [turn]}
          jobs.append(self.peer_job("peer:rates", TRAINING, task, [f"env.impl={backend}"], **of_it))
    return jobs


@dataclasses.dataclass(frozen=True)
class Learning(BesidePeer, OfRuns):
  """Returns and wall-clock of our package and the public one, trained for the same steps, each with its evaluation."""

  backends: Sequence[str] = ("warp",)
  num_timesteps: Annotated[
    int | None, count(1, 1e12), "control steps of each training; null is the task's budget in 0.2.0's set"
  ] = None
  seeds: Annotated[int, count(1), "trainings of each side, seeds 1 to this"] = 1

  name = "learning"
  agents = ("ppo", "sac")

  def check(self) -> None:
    super().check()
    if self.agent == "sac" and (others := set(self.chosen()) - set(tasks_of("dm_control"))):
      raise ConfigError(f"agent=sac: the package trains SAC on DM Control alone, not {', '.join(sorted(others))}.")

  def jobs(self, devices: int) -> list[Measurement]:
    jobs = []
    for task in self.chosen():
      for seed in range(1, self.seeds + 1):
        jobs.append(self.on_one_device(self.whole_run(task, self.ours, seed)))
        for backend in self.backends:
          setting = [f"env.impl={backend}", *self.budget()]
          of_it = {"agent": self.agent, "num_timesteps": self.num_timesteps, "backend": backend, "seeds": [seed]}
          of_it["setting"] = [*self.overrides, *setting]
          jobs.append(self.peer_job("peer:whole", "final_return", task, setting, **of_it))
    return jobs


COMMANDS: dict[str, type[Measuring]] = {
  command.name: command
  for command in (Throughput, Together, Startup, Scaling, Breakdown, Pixels, Topology, Chain, Compare, Learning)
}


def run(command: Measuring) -> int:
  """Runs a command's measurements and returns the exit code of `run_jobs`."""
  command.check()
  table = Table(Path(command.out).expanduser() if command.out else RESULTS / f"{command.name}.csv")
  hardware = [text for text in command.overrides if re.match(r"\+*hardware[.=]", text)]
  devices, machine = probe(["env=CartpoleBalance", *hardware], command.gpus)
  jobs = command.jobs(devices)  # raises for invalid options, before any output
  print(f"{devices} x {machine['device']}; {machine['versions']}")
  return run_jobs(jobs, table, machine, command)
