"""A page as a list of blocks, written as Markdown with figures beside it or as one HTML file; formatting of numbers."""

import base64
import dataclasses
import html
import re
from collections.abc import Iterable, Sequence


@dataclasses.dataclass(frozen=True)
class Heading:
  """A heading of level 1, 2, ..."""

  level: int
  text: str


@dataclasses.dataclass(frozen=True)
class Text:
  """A paragraph."""

  text: str


class Link(str):
  """A cell with a link to a file beside the page."""

  target: str

  def __new__(cls, text: str, target: str) -> "Link":
    link = super().__new__(cls, text)
    link.target = target
    return link


@dataclasses.dataclass(frozen=True)
class Table:
  """Rows of cells; columns of numbers are aligned to the right."""

  header: Sequence[str]
  rows: Sequence[Sequence[str]]


@dataclasses.dataclass(frozen=True)
class Image:
  """A drawing.

  Attributes:
    name: of its file, without suffix.
    image: the drawing, as SVG or as the bytes of a PNG, which a Markdown page cannot show.
    caption: its text.
  """

  name: str
  image: str | bytes
  caption: str


NOT_MEASURED = "not measured"
Block = Heading | Text | Table | Image

_CODE = re.compile("`([^`]+)`")
_STYLE = """
body{font:16px/1.5 system-ui,sans-serif;max-width:70rem;margin:2rem auto;padding:0 1rem;color:#1a1a1a}
table{border-collapse:collapse;margin:1rem 0;font-size:.9rem}
th,td{border-bottom:1px solid #ddd;padding:.25rem .7rem;text-align:left;vertical-align:top}
td.n,th.n{text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}
svg,img{max-width:100%;height:auto} figcaption{font-size:.9rem;color:#555}
"""


def to_markdown(blocks: Iterable[Block], images: str) -> str:
  """Returns Markdown; figures are files `<images>/<name>.svg`."""
  return "\n\n".join(_markdown(block, images) for block in blocks) + "\n"


def to_html(blocks: Sequence[Block], title: str) -> str:
  """Returns one HTML file without external files."""
  body = "\n".join(_html(block) for block in blocks)
  head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{html.escape(title)}</title>'
  return f"<!doctype html>\n<html lang=en><head>{head}<style>{_STYLE}</style></head>\n<body>\n{body}\n</body></html>\n"


def _markdown(block: Block, images: str) -> str:
  match block:
    case Heading(level, text):
      return f"{'#' * level} {text}"
    case Text(text):
      return text
    case Image(name, _, caption):
      return f"![{caption}]({images}/{name}.svg)"
    case Table(header, rows):
      rules = ["---:" if right else "---" for right in _numeric(block)]
      lines = [header, rules, *([cell.replace("|", "\\|") for cell in row] for row in rows)]
      return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _html(block: Block) -> str:
  match block:
    case Heading(level, text):
      return f"<h{level}>{html.escape(text)}</h{level}>"
    case Text(text):
      marked = _CODE.sub(r"<code>\1</code>", html.escape(text))
      return f"<p>{marked}</p>"
    case Image(_, image, caption):
      if isinstance(image, bytes):
        drawing = f'<img alt="" src="data:image/png;base64,{base64.b64encode(image).decode()}">'
      else:
        drawing = image[image.index("<svg") :]
      return f"<figure>{drawing}<figcaption>{html.escape(caption)}</figcaption></figure>"
    case Table(header, rows):
      kinds = [' class="n"' if right else "" for right in _numeric(block)]

      def line(cells: Sequence[str], tag: str) -> str:
        parts = (f"<{tag}{kind}>{_cell(cell)}</{tag}>" for cell, kind in zip(cells, kinds, strict=True))
        return f"<tr>{''.join(parts)}</tr>"

      return "\n".join(["<table>", line(header, "th"), *(line(row, "td") for row in rows), "</table>"])


def _cell(cell: str) -> str:
  text = html.escape(cell)
  return f'<a href="{html.escape(cell.target)}">{text}</a>' if isinstance(cell, Link) else text


def _numeric(table: Table) -> list[bool]:
  """Returns for each column whether it holds numbers."""
  is_number = lambda cell: not isinstance(cell, Link) and (cell[:1].isdigit() or cell in ("", NOT_MEASURED))
  columns = [[row[i] for row in table.rows] for i in range(len(table.header))]
  return [all(map(is_number, column)) and any(cell[:1].isdigit() for cell in column) for column in columns]


def short(value: float) -> str:
  """Formats a number with four digits, or all before the point."""
  return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def mean_and_ci95(values: Iterable[float]) -> tuple[float, float | None]:
  """Returns the mean, and half the width of its 95 % confidence interval (Student's t; None for one value)."""
  import numpy as np

  sample = np.asarray(list(values), float)
  if len(sample) < 2:
    return float(sample.mean()), None
  return float(sample.mean()), float(t_factor(len(sample)) * sample.std(ddof=1))


def t_factor(count: int) -> float:
  """Returns the half-width of a mean's 95 % confidence interval in units of the std of `count` values."""
  from scipy.special import stdtrit

  return float(stdtrit(count - 1, 0.975)) / count**0.5 if count > 1 else 0.0
