"""`playground-bench report`: writes a page of all measurements, and the tables of the result pages."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from playground.benchmark.report import sections
from playground.benchmark.report.evidence import Evidence
from playground.benchmark.report.pixels import pixels
from playground.benchmark.report.public import beside_public
from playground.benchmark.report.suites import write_pages
from playground.errors import ConfigError
from playground.files import need_folder, write_text
from playground.reporting.page import Block, Heading, Image, Text, to_html, to_markdown

ROWS = ("results/reference", "results/benchmarks")
IMAGES = "report_images"
TITLE = "Measured"
SECTIONS = (
  *(sections.throughput, sections.compared, sections.together, sections.startup, sections.scaling),
  *(sections.topology, sections.breakdown, pixels, sections.chains, sections.returns, beside_public),
)


@dataclasses.dataclass(frozen=True)
class Options:
  """Writes report.md and report.html: the paper's tables with our column, curves, bars, conditions."""

  out: Annotated[str, "folder of the page"] = "results/benchmarks"
  rows: Annotated[Sequence[str], "folders of the CSVs to read"] = ROWS
  pages: Annotated[str | None, "instead: folder of the result pages (docs) whose tables of runs to rewrite"] = None


def run(options: Options) -> int:
  """Writes the page.

  Raises:
    ConfigError: no rows, a damaged file, or a folder that is not readable or writable.
  """
  if options.pages is not None:
    pages = write_pages(Path(options.pages).expanduser(), Path(ROWS[0]))
    print(f"written: {', '.join(map(str, pages))}")
    return 0
  out = Path(options.out).expanduser()
  need_folder(out, f"out={options.out}")
  for folder in options.rows:
    if folder not in ROWS and not Path(folder).expanduser().is_dir():
      raise ConfigError(f"rows={folder} is not a folder: name folders of CSVs.")
  folders = [path for folder in options.rows if (path := Path(folder).expanduser()).is_dir()]
  evidence = Evidence(folders)
  if not evidence.rows:
    raise ConfigError(f"rows={','.join(options.rows)}: there is no measured row in these folders.")
  blocks = page(evidence)
  try:
    (out / IMAGES).mkdir(parents=True, exist_ok=True)
    for block in blocks:
      if isinstance(block, Image) and isinstance(block.image, str):
        write_text(out / IMAGES / f"{block.name}.svg", block.image)
    write_text(out / "report.md", to_markdown(blocks, IMAGES))
    write_text(out / "report.html", to_html(blocks, TITLE))
  except OSError as error:
    raise ConfigError(f"out={out} cannot be written: {error.strerror}.") from None
  print(f"{len(evidence.rows)} rows and {len(evidence.curves)} curves: {out / 'report.md'}, {out / 'report.html'}")
  return 0


def page(evidence: Evidence) -> list[Block]:
  """Returns the blocks of the page."""
  notes = sections.Notes()
  blocks: list[Block] = [Heading(1, TITLE)]
  blocks.append(Text(f"Made by `playground-bench report` from {', '.join(path.name for path in evidence.files)}."))
  blocks.append(Text("Training is PPO's where no agent is named; overrides of a run stand behind its task."))
  for section in SECTIONS:
    blocks += section(evidence, notes)
  return [*blocks, *notes.blocks()]
