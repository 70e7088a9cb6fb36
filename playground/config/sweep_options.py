"""Settings of a sweep: where its jobs run (`launcher`), and how their values are chosen (`search`)."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

from playground.limits import SEED, at_least_0, count, positive
from playground.settings import Section


@dataclasses.dataclass(frozen=True, kw_only=True)
class LauncherConfig:
  """Settings that every launcher has."""

  timeout: Annotated[
    float | None, positive(), "seconds one start of a job may take; then it is asked to stop, which saves a checkpoint"
  ] = None
  grace: Annotated[float, at_least_0(), "seconds from the request to stop until the job is killed"] = 60.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class LocalConfig(LauncherConfig):
  """Processes on this machine, packed onto its GPUs."""

  gpus: Annotated[int | None, count(0), "how many of the visible ones; null is all"] = None
  slots_per_gpu: Annotated[int, count(1), "jobs that share a GPU, its memory divided among them"] = 1
  mps: Annotated[
    bool, "whether jobs that share a GPU run side by side on it, not by turns (NVIDIA's Multi-Process Service)"
  ] = False
  cores_per_job: Annotated[int, count(1), "without a GPU: as many jobs at a time as there are cores for"] = 2


@dataclasses.dataclass(frozen=True, kw_only=True)
class TogetherConfig(LocalConfig):
  """One process for jobs that differ only in seeds, initial weights and numbers, else as `local` (docs/sweeps.md)."""

  max_agents: Annotated[int, count(1), "most jobs in one process, which share its compiled program and memory"] = 16
  exploit_every: Annotated[
    int, count(0), "evaluations after which the worst quarter of the jobs copies the best; 0: each trains on its own"
  ] = 0
  explore: Annotated[
    Sequence[str], "numbers of the agent that a job copies too, then multiplies by 0.8 or 1.25, within their limits"
  ] = ("agent.learning_rate",)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RayConfig(LauncherConfig):
  """A Ray cluster; its nodes share the sweep's folder. Without an address one is started on this machine."""

  address: Annotated[str | None, "such as auto or ray://host:10001; null is $RAY_ADDRESS, else this machine alone"] = (
    None
  )
  gpus_per_job: Annotated[
    float | None,
    at_least_0(),
    "null: the job's hardware.devices, 1 if that is null, 0 for hardware=cpu; 0.5 shares one",
  ] = None
  cores_per_job: Annotated[int | None, count(1), "null is 4, or all of the largest node if it has fewer"] = None
  retries: Annotated[int, count(0), "how often a job whose node is lost goes on elsewhere"] = 3


@dataclasses.dataclass(frozen=True, kw_only=True)
class SlurmConfig(LauncherConfig):
  """A Slurm cluster, through submitit; a job that is preempted or out of time is queued again and resumes."""

  minutes: Annotated[
    int, positive(), "Slurm's time limit; a job that reaches it saves, is queued again and goes on"
  ] = 1440
  requeues: Annotated[int, count(0), "how often a job may go on after its time limit; after preemption always"] = 10
  max_parallel: Annotated[int | None, count(1), "jobs at a time; null is as many as Slurm gives"] = None
  gpus_per_job: Annotated[
    int | None, count(0), "null: the job's hardware.devices, 1 if that is null, 0 for hardware=cpu"
  ] = None
  cores_per_job: Annotated[int, count(1), "CPU cores of a job"] = 8
  memory_gb: Annotated[int, positive(), "memory of a job, GB"] = 32
  partition: Annotated[str | None, "Slurm's partition; null is the cluster's default"] = None
  account: Annotated[str | None, "the account that pays"] = None
  qos: Annotated[str | None, "quality of service"] = None
  constraint: Annotated[str | None, "features that a node must have"] = None
  setup: Annotated[Sequence[str], "lines of shell before a job, such as `module load cuda`"] = ()
  parameters: Annotated[Mapping[str, object], "anything else for sbatch, e.g. {exclusive: true}"] = dataclasses.field(
    default_factory=dict
  )
  wait: Annotated[bool, "false: submit and return; `playground sweep status|collect` look later"] = True


@dataclasses.dataclass(frozen=True)
class GridConfig:
  """Every combination of the values that are listed."""


@dataclasses.dataclass(frozen=True)
class OptunaConfig:
  """Values drawn by Optuna from interval(a, b), range(a, b) or a list on the command line.

  One trial is one job.
  """

  trials: Annotated[int, count(1), "trials in all, those of earlier starts of the same sweep included"] = 20
  parallel: Annotated[int, count(1), "trials at a time, if the launcher has room"] = 4
  metric: Annotated[
    Literal["final_return", "final_mode_return", "best_return", "steps_per_second", "wall_clock_s"],
    "of a job's summary.json",
  ] = "final_return"
  direction: Annotated[Literal["maximize", "minimize"], "whether the metric should be high or low"] = "maximize"
  sampler: Annotated[Literal["tpe", "random", "cmaes"], "Optuna's sampler"] = "tpe"
  seed: Annotated[int, SEED, "of the sampler"] = 0


LAUNCHERS: dict[str, type[LauncherConfig]] = {
  "local": LocalConfig,
  "ray": RayConfig,
  "slurm": SlurmConfig,
  "together": TogetherConfig,
}
SEARCHES: dict[str, type] = {"grid": GridConfig, "optuna": OptunaConfig}


@dataclasses.dataclass(frozen=True)
class SweepConfig:
  """Settings of the sweep itself."""

  sweep_dir: Annotated[str | None, "the sweep's folder; null is results/sweeps/<name>/<date_time>"] = None
  on_error: Annotated[Literal["continue", "stop"], "stop: the first job that fails stops the others"] = "continue"


@dataclasses.dataclass(frozen=True, kw_only=True)
class SweepSettings(SweepConfig):
  """All settings of a sweep; `resolved` holds them as plain dicts, lists and scalars."""

  launcher: LauncherConfig
  search: GridConfig | OptunaConfig
  resolved: Section
