"""The tables of the result pages."""

import re
import shutil
from pathlib import Path

import pytest

from playground import catalog
from playground.benchmark.report.suites import AGENTS, GALLERY, TABLES, TASKS_BEGIN, TASKS_END, write_pages
from playground.errors import ConfigError

ROOT = Path(__file__).parents[2]
REFERENCE = ROOT / "results/reference"


PAGES = [f"{kind}-{name}.md" for name in TABLES for kind in ("results", "runs")]


def test_the_pages_have_the_runs_of_the_reference_tables(tmp_path: Path):
  for page in (*PAGES, AGENTS, GALLERY):
    shutil.copyfile(ROOT / "docs" / page, tmp_path / page)
  assert write_pages(tmp_path, REFERENCE) == [tmp_path / page for page in (*PAGES, AGENTS, GALLERY)]
  texts = {page: (tmp_path / page).read_text() for page in (*PAGES, AGENTS, GALLERY)}
  for page, text in texts.items():
    assert text == (ROOT / "docs" / page).read_text(), "write them: playground-bench report pages=docs"
  runs, results = ("".join(texts[page] for page in PAGES if page.startswith(kind)) for kind in ("runs", "results"))
  assert results.count("\n## Findings\n") == len(TABLES)
  results = "".join(re.findall(f"{re.escape(TASKS_BEGIN)}(.+?){re.escape(TASKS_END)}", results, re.S))
  listed = lambda text: re.findall(r"^\| (\w+) \|", text, re.M)
  assert sorted(set(listed(results)) - {"task"}) == sorted(catalog.entries())
  assert len(listed(results)) == len(catalog.entries()) + len(TABLES), "a row a task, and the header"
  measured = {name for name, entry in catalog.entries().items() if entry.status != "not measured"}
  assert set(listed(runs)) - {"task"} == measured


def test_a_page_without_a_place_is_refused(tmp_path: Path):
  with pytest.raises(ConfigError, match="does not exist"):
    write_pages(tmp_path, REFERENCE)
  for page in PAGES:
    (tmp_path / page).write_text("# Results\n")
  with pytest.raises(ConfigError, match=re.escape(TASKS_BEGIN)):
    write_pages(tmp_path, REFERENCE)


def test_rows_of_tasks_that_the_catalogue_lacks_and_rows_without_numbers(tmp_path: Path):
  for page in (*PAGES, AGENTS, GALLERY):
    shutil.copyfile(ROOT / "docs" / page, tmp_path / page)
  reference = Path(shutil.copytree(REFERENCE, tmp_path / "reference", ignore=shutil.ignore_patterns("*.png")))
  table = reference / "vision.csv"
  lines = table.read_text().splitlines()
  table.write_text("\n".join([*lines, re.sub("^[^,]+", "TheirTask", lines[1]), ""]))
  write_pages(tmp_path, reference)
  assert re.search(r"## Without a status\n[^#]*\| TheirTask \|", (tmp_path / "runs-manipulation.md").read_text())
  steps = lines[0].split(",").index("steps")
  cells = lines[1].split(",")
  assert cells[steps].isdigit(), "no cell before it has a comma"
  table.write_text("\n".join([*lines, ",".join([*cells[:steps], "abc", *cells[steps + 1 :]]), ""]))
  with pytest.raises(ConfigError, match=rf"vision\.csv, line {len(lines) + 1} has steps=abc, which must be a number"):
    write_pages(tmp_path, reference)
