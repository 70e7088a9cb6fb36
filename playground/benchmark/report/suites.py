"""Writes the tables of the result pages and the grids of the gallery from results/reference/ and the catalogue.

A page is written by hand except for the text between two comments, which `playground-bench report pages=docs` replaces.
Each suite has a page with a row for each task, and a page with every run, open tasks first.
One page compares the agents.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from playground.benchmark.report import tasks
from playground.benchmark.report.evidence import number, read_lines
from playground.catalog import Entry, entries
from playground.errors import ConfigError
from playground.files import write_text
from playground.reporting.page import Block, Heading, Table, to_markdown
from playground.text import millions

TABLES = {  # name of the pages results-<name>.md and runs-<name>.md -> their tables
  "dm-control": ("dm_control",),
  "locomotion": ("locomotion",),
  "manipulation": ("manipulation", "vision"),
}
GENERATED = "<!-- {}: written by `playground-bench report pages=docs` -->"
TASKS_BEGIN, TASKS_END = GENERATED.format("tasks"), "<!-- end of tasks -->"
RUNS_BEGIN, RUNS_END = GENERATED.format("runs"), "<!-- end of runs -->"
AGENTS = "results-agents.md"
AGENTS_BEGIN, AGENTS_END = GENERATED.format("agents"), "<!-- end of agents -->"
GALLERY = "gallery.md"
GRID_BEGIN, GRID_END = GENERATED.format("grid {}"), "<!-- end of grid -->"
_GRID_WIDTH = 4  # animations in a row
_TITLES = {"open": "Open", "learning": "Learning", "solved": "Solved", "": "Without a status"}
_TEXTS = ("task", "agent", "who", "setting", "seed", "backend")  # columns that every table of runs has
_NUMBERS = {  # columns of a table of runs -> whether each row has one
  **dict.fromkeys(("steps", "final_return"), True),
  **dict.fromkeys(("final_mode_return", "success", "turns", "falls_per_episode"), False),
}
# Settings that have columns of their own.
_BUDGET = re.compile(r"(agent\.num_timesteps|agent\.num_evals)=\S+|env(\.impl)?=\w+| \(learning\)")
_SHORT = {"agent.": "", "curriculum.": ""}
_COLUMNS, _FIGURE = ("task", "run", "physics", "M steps", "return"), "success or falls"
_LONG = 60  # characters of a setting
Row = dict[str, str]


def write_pages(pages: Path, reference: Path) -> list[Path]:
  """Writes the tables into the pages of a folder, and the grids into its gallery.

  Args:
    pages: the folder, such as docs.
    reference: the folder of the tables.

  Returns:
    The paths of the pages.

  Raises:
    ConfigError: a page or a table is missing, a page lacks the comments around its table, or a row lacks a number.
  """
  try:
    rows = {
      name: [row for table in tables for row in _read(reference / f"{table}.csv")] for name, tables in TABLES.items()
    }
    written = []
    for name in TABLES:
      found = tasks.table(_entries(name, rows), rows[name])
      written.append(_rewrite(pages / f"results-{name}.md", TASKS_BEGIN, TASKS_END, [found]))
      written.append(_rewrite(pages / f"runs-{name}.md", RUNS_BEGIN, RUNS_END, list(_blocks(rows[name]))))
    by_agent = tasks.agents_table([*entries().values()], [row for found in rows.values() for row in found])
    written.append(_rewrite(pages / AGENTS, AGENTS_BEGIN, AGENTS_END, [by_agent]))
    for suite in dict.fromkeys(entry.suite for entry in entries().values()):
      _rewrite(pages / GALLERY, GRID_BEGIN.format(suite), GRID_END, _grid(suite))
  except FileNotFoundError as error:
    raise ConfigError(f"pages={pages}: {error.filename} does not exist.") from None
  except UnicodeDecodeError as error:
    raise ConfigError(f"pages={pages} has a page that is no text: {error.reason}.") from None
  return [*written, pages / GALLERY]


def _read(path: Path) -> list[Row]:
  """Reads a table of runs and checks its columns and numbers."""
  lines = read_lines(path)
  for where, row in lines.items():
    if missing := [column for column in _TEXTS if column not in row]:
      raise ConfigError(f"{path} has no column {missing[0]}: add it.")
    for column, needed in _NUMBERS.items():
      if (text := row.get(column, "")) or needed:
        number(where, column, text)
  return list(lines.values())


def _entries(name: str, rows: Mapping[str, Sequence[Row]]) -> list[Entry]:
  """Returns the tasks of a page: those of its tables, and those of its suite that no table has."""
  pages = {row["task"]: page for page, found in rows.items() for row in found}
  return [entry for entry in entries().values() if pages.get(entry.task, entry.suite.replace("_", "-")) == name]


def _rewrite(path: Path, begin: str, end: str, content: Sequence[Block] | str) -> Path:
  """Replaces the content of a page between two comments; returns the page's path."""
  before, found, rest = path.read_text(encoding="utf-8").partition(begin)
  _, closed, after = rest.partition(end)
  if not found or not closed:
    raise ConfigError(f"pages={path.parent}: {path} lacks the line {begin if not found else end}.")
  text = content if isinstance(content, str) else to_markdown(content, "")
  write_text(path, f"{before}{begin}\n\n{text}\n{end}{after}")
  return path


def _grid(suite: str) -> str:
  """Returns a table of animations with each task's name, status, best return and robot, by which gallery.js filters."""
  cells = []
  for task, entry in entries().items():
    if entry.suite == suite:
      score = "" if entry.best_return is None else f", {entry.best_return:.4g}"
      robot = f"<br>{entry.robot}" if entry.robot else ""
      cells.append(f"![{task}](gallery/{task}.webp)<br>{task}<br>{entry.status}{score}{robot}")
  rows = [cells[i : i + _GRID_WIDTH] for i in range(0, len(cells), _GRID_WIDTH)]
  full = [[*row, *[""] * (_GRID_WIDTH - len(row))] for row in rows]
  return "\n".join(f"| {' | '.join(row)} |" for row in [[""] * _GRID_WIDTH, ["---"] * _GRID_WIDTH, *full]) + "\n"


def _blocks(rows: Sequence[Row]) -> Iterator[Block]:
  """Yields a table for each status and for tasks without one; runs that differ only in seed or repetition are a row."""
  known = {task: entry.status for task, entry in entries().items() if entry.status in _TITLES}
  for status, title in _TITLES.items():
    groups: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
      if known.get(row["task"], "") == status:
        groups.setdefault((row["task"], *_run(row)), []).append(row)
    if groups:
      cells = [_cells(key, runs) for key, runs in sorted(groups.items(), key=lambda group: group[0][0])]
      columns = [*_COLUMNS, *([_FIGURE] if any(row[-1] for row in cells) else [])]
      yield Heading(2, title)
      yield Table(columns, [row[: len(columns)] for row in cells])


def _run(row: Row) -> tuple[str, str, str]:
  """Returns a run's agent and setting (or the other package), the backend, and millions of steps."""
  if (who := row["who"]) != "ours":
    return who, row["backend"], millions(float(row["steps"]))
  setting = " ".join(_BUDGET.sub("", f"{row['agent']} {row.get('setting', '')}").split())
  for long, short in _SHORT.items():
    setting = setting.replace(long, short)
  if row.get("experiment", "").endswith("_chain"):
    setting = f"{row['experiment']} {setting.removeprefix('ppo ')}"
  setting = setting if len(setting) <= _LONG else f"{setting[: setting.rindex(' ', 0, _LONG)]} …"
  return setting.replace("ppo agent=", ""), row["backend"], millions(float(row["steps"]))


def _cells(key: tuple[str, ...], runs: Sequence[Row]) -> list[str]:
  returns = ", ".join(f"{float(row['final_return']):.4g}" for row in runs)
  return [*key, returns, next(filter(None, (tasks.ended([row]) for row in reversed(runs))), "")]
