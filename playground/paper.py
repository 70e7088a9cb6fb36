"""The paper's tables (`benchmarks/paper/`) and the suites of tasks in them."""

from functools import cache

from playground.config.files import shipped
from playground.errors import UnknownNameError, nearest
from playground.files import read_csv

SUITES = ("dm_control", "locomotion", "manipulation")


@cache
def paper_table(name: str) -> list[dict[str, str]]:
  """Rows of one of the paper's tables."""
  return read_csv(shipped("benchmarks") / "paper" / f"{name}.csv")


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
