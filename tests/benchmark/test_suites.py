"""The tables of the result pages."""

import re
import shutil
from pathlib import Path

import pytest

from playground import catalog
from playground.benchmark.report.suites import BEGIN, GALLERY, PAGES, write_pages
from playground.errors import ConfigError

ROOT = Path(__file__).parents[2]
REFERENCE = ROOT / "results/reference"


def test_the_pages_have_the_runs_of_the_reference_tables(tmp_path: Path):
  for page in (*PAGES, GALLERY):
    shutil.copyfile(ROOT / "docs" / page, tmp_path / page)
  assert write_pages(tmp_path, REFERENCE) == [tmp_path / page for page in (*PAGES, GALLERY)]
  assert (tmp_path / GALLERY).read_text() == (ROOT / "docs" / GALLERY).read_text()
  texts = {page: (tmp_path / page).read_text() for page in PAGES}
  for page, text in texts.items():
    assert text == (ROOT / "docs" / page).read_text(), "write them: playground-bench report pages=docs"
    assert text.index("## Learning") < text.index("## Solved") and "\n## Findings\n" in text
  rows = set(re.findall(r"^\| (\w+) \|", "".join(texts.values()), re.M)) - {"task"}
  assert rows == {name for name, entry in catalog.entries().items() if entry.status != "not measured"}


def test_a_page_without_a_place_is_refused(tmp_path: Path):
  with pytest.raises(ConfigError, match="does not exist"):
    write_pages(tmp_path, REFERENCE)
  for page in PAGES:
    (tmp_path / page).write_text("# Results\n")
  with pytest.raises(ConfigError, match=re.escape(BEGIN)):
    write_pages(tmp_path, REFERENCE)
