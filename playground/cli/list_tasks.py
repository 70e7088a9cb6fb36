"""`playground list`: prints a filtered table of tasks, or JSON. Imports no JAX."""

import dataclasses
import json
from collections.abc import Iterable, Mapping

from rich.table import Table
from rich.text import Text

from playground.catalog import STATUSES, entries
from playground.config import compose
from playground.console import wide_console
from playground.errors import ConfigError, UnknownNameError, nearest
from playground.settings import Section
from playground.text import millions

FILTERS = ("suite", "robot", "status", "backend")


def list_tasks(names: Iterable[str], filters: Mapping[str, str | None], as_json: bool) -> int:
  """Prints the tasks that match the filters.

  Args:
    names: tasks to list; of another package's, what composing tells: robot, backend, agent and budget.
    filters: the value that a task must have, by name of `FILTERS`; None takes any.
    as_json: whether to print JSON instead of a table.

  Returns:
    The exit code, 0.

  Raises:
    UnknownNameError: a value that no task has.
  """
  known = entries()
  wanted = {name: value for name, value in filters.items() if value is not None}
  for name, value in wanted.items():
    values = sorted(STATUSES if name == "status" else {getattr(entry, name) for entry in known.values()} - {""})
    if value not in values:
      raise UnknownNameError(f"--{name}={value}: choose from {', '.join(values)}.{nearest(value, values)}")
  rows: list[Section] = [dataclasses.asdict(known[name]) if name in known else _composed(name) for name in names]
  rows = [row for row in rows if all(row.get(name) == value for name, value in wanted.items())]
  if as_json:
    print(json.dumps(rows, indent=1))
    return 0
  wide_console().print(_table(rows))
  for row in rows:
    if "error" in row:
      print(f"{row['task']}: {row['error']}")
  count = f"{len(rows)} task{'s' * (len(rows) != 1)}"
  print(f"{count}. Train one with playground train env=<task>.")
  return 0


def _composed(name: str) -> Section:
  """Returns what the configuration tells of a task that the catalogue lacks, or why it does not compose."""
  try:
    config = compose([f"env={name}"])
  except ConfigError as error:
    return {"task": name, "error": str(error)}
  settings = {"agent": config.agent_name, "budget": config.agent.num_timesteps}
  return {"task": name, "robot": config.choices.get("robot") or "", "backend": config.env.cuda_impl, **settings}


def _table(rows: Iterable[Section]) -> Table:
  table = Table(box=None, padding=(0, 2, 0, 0))
  table.add_column("task", style="cyan", no_wrap=True)
  for name in ("suite", "robot", "observation"):
    table.add_column(name, overflow="fold")
  for name in ("action", "backend", "agent", "budget", "status", "best run of ours"):
    table.add_column(name, overflow="fold", justify="right" if name in ("action", "budget") else "left")
  for row in rows:
    cells = {
      "budget": f"{row['budget'] / 1e6:g} M" if "budget" in row else "",
      "best run of ours": _best(row),
    }
    shown = {**row, **cells}
    table.add_row(*(Text(str(shown.get(str(column.header), ""))) for column in table.columns))
  return table


def _best(row: Section) -> str:
  """Formats a task's best return with the run that reached it."""
  if row.get("best_return") is None:
    return ""
  return f"{row['best_return']:.4g} ({row['best_run']}, {millions(row['best_steps'])} M)"
