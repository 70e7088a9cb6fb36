"""The paper's tables (`benchmarks/paper/`) and the suites of tasks they make."""

import csv
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from playground.config.files import shipped, task_names
from playground.errors import ConfigError, UnknownNameError, nearest

SUITES = ("dm_control", "locomotion", "manipulation")
AGENTS = ("ppo", "ppo_paper", "sac")


def paper_folder() -> Path:
  """Where the paper's tables lie, in a checkout and in an installed wheel."""
  return shipped("benchmarks") / "paper"


@cache
def paper_table(name: str) -> list[dict[str, str]]:
  """Rows of one of the paper's tables."""
  with (paper_folder() / f"{name}.csv").open(encoding="utf-8", newline="") as file:
    return list(csv.DictReader(file))


def tasks_of(suite: str) -> list[str]:
  """Tasks of the paper's throughput table for a suite (App. A.3, B.4, C.3); "all" is the three of them.

  Raises:
    UnknownNameError: no such suite.
  """
  if suite not in (*SUITES, "all"):
    known = ", ".join((*SUITES, "all"))
    raise UnknownNameError(f"suite={suite} does not exist: choose from {known}.{nearest(suite, SUITES)}")
  suites = SUITES if suite == "all" else (suite,)
  return [row["registry_env"] for name in suites for row in paper_table(f"{name}_throughput")]


def choose_tasks(suite: str | None, tasks: Sequence[str]) -> list[str]:
  """The tasks that `suite=` and `tasks=` stand for, each once; what a suite has and we have not is left out.

  Raises:
    ConfigError: neither is given.
    UnknownNameError: no such suite or task.
  """
  if not suite and not tasks:
    raise ConfigError(f"Name what to measure: tasks=CartpoleBalance,CheetahRun or suite={'|'.join(SUITES)}|all.")
  known = task_names()
  for name in tasks:
    if name not in known:
      raise UnknownNameError(f"Task {name!r} does not exist; `playground list` shows all.{nearest(name, known)}")
  in_suite = [name for name in (tasks_of(suite) if suite else []) if name in known]
  return list(dict.fromkeys([*tasks, *in_suite]))


def check_agent(agent: str) -> None:
  """Raises UnknownNameError for an agent that is not measured."""
  if agent not in AGENTS:
    raise UnknownNameError(f"agent={agent} does not exist: choose from {', '.join(AGENTS)}.{nearest(agent, AGENTS)}")
