"""Drawings, as SVG or PNG."""

import io
import math
import textwrap
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
  from matplotlib.figure import Figure

COLOURS = ("#2f6db5", "#d1762f", "#5a9e57", "#b5479a", "#8a6d3b", "#777777")
Points = Sequence[tuple[float, float]]
_LEGEND = 30  # lines of names in a panel


class Curve(NamedTuple):
  """A line and, where there is one, half the width of the band around it."""

  x: Sequence[float]
  y: Sequence[float]
  half_width: Sequence[float] | None = None


def _figure(size: tuple[float, float], draw: "Callable[[Figure], None]", kind: str = "svg") -> bytes:
  import matplotlib
  from matplotlib.figure import Figure  # not pyplot: no global state, no display

  with matplotlib.rc_context({"svg.hashsalt": "playground", "font.size": 9}):  # the same page from the same rows
    figure = Figure(figsize=size, layout="constrained")
    draw(figure)
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=130, metadata={"Date": None} if kind == "svg" else {})
  return buffer.getvalue()


def _svg(size: tuple[float, float], draw: "Callable[[Figure], None]") -> str:
  return _figure(size, draw).decode()


def _wrapped(name: str) -> str:
  """A name on lines that leave room for the drawing: a setting may be long, and hold a $, which begins a formula."""
  return textwrap.fill(name, 44).replace("$", r"\$")


def _height(names: Collection[str], least: float) -> float:
  """Inches that names below each other take, all as much as the longest."""
  return len(names) * max(least, *(0.2 * len(_wrapped(name).splitlines()) for name in names))


def lines(title: str, series: Mapping[str, Points], x: str, y: str) -> str:
  """Lines over one pair of logarithmic axes."""

  def draw(figure: "Figure") -> None:
    axes = figure.subplots()
    for colour, (name, points) in zip(COLOURS * len(series), series.items(), strict=False):
      axes.plot(
        *zip(*sorted(points), strict=True), marker="o" if len(points) < 12 else "", label=_wrapped(name), color=colour
      )
    axes.set_xscale("log", base=2)
    axes.set_yscale("log")
    axes.set(title=title, xlabel=x, ylabel=y)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(0, -0.2))

  return _svg((7, 3.2 + _height(series, 0.2)), draw)


def curves(panels: Mapping[str, Mapping[str, Curve]], x: str, y: str, kind: str = "svg") -> bytes:
  """Curves in small panels, as SVG or PNG; panels of more than 30 lines of names have no legend."""
  columns = min(4, len(panels))
  rows = math.ceil(len(panels) / columns)
  counts = {title: sum(len(_wrapped(name).splitlines()) for name in group) for title, group in panels.items()}
  row = max([2.2, *(0.5 + 0.13 * count for count in counts.values() if count <= _LEGEND)])

  def draw(figure: "Figure") -> None:
    cells = figure.subplots(rows, columns, squeeze=False).flat
    for (title, group), axes in zip(panels.items(), cells, strict=False):
      for colour, (name, curve) in zip(COLOURS * len(group), group.items(), strict=False):
        axes.plot(curve.x, curve.y, label=_wrapped(name), color=colour, marker="o" if len(curve.x) == 1 else "")
        if curve.half_width is not None:
          low, high = zip(*((m - h, m + h) for m, h in zip(curve.y, curve.half_width, strict=True)), strict=True)
          axes.fill_between(curve.x, low, high, color=colour, alpha=0.2, linewidth=0)
      axes.set_title(_wrapped(title), fontsize=9)
      axes.grid(alpha=0.3)
      if counts[title] <= _LEGEND:
        axes.legend(frameon=False, fontsize=7).set_in_layout(False)  # else a long name leaves no room for the axes
    for axes in list(cells):
      axes.set_axis_off()
    figure.supxlabel(x)
    figure.supylabel(y)

  return _figure((2.9 * columns, row * rows + 0.4), draw, kind)


def bars(title: str, groups: Mapping[str, Mapping[str, float]], x: str) -> str:
  """Bars side by side, a group of them a line of text."""

  def draw(figure: "Figure") -> None:
    axes = figure.subplots()
    names = list(dict.fromkeys(name for group in groups.values() for name in group))
    height = 0.8 / len(names)
    for i, name in enumerate(names):
      at = [row + i * height for row, group in enumerate(groups.values()) if name in group]
      axes.barh(at, [g[name] for g in groups.values() if name in g], height, label=_wrapped(name), color=COLOURS[i % 6])
    axes.set_yticks([row + 0.4 - height / 2 for row in range(len(groups))], list(map(_wrapped, groups)))
    axes.invert_yaxis()
    axes.set(title=title, xlabel=x)
    axes.legend(frameon=False).set_in_layout(False)

  return _svg((7, 0.9 + _height(groups, 0.55)), draw)


def stacked(title: str, bars: Mapping[str, Mapping[str, float]], x: str) -> str:
  """Bars made of parts."""

  def draw(figure: "Figure") -> None:
    axes = figure.subplots()
    names = list(dict.fromkeys(name for parts in bars.values() for name in parts))
    left = dict.fromkeys(bars, 0.0)
    for i, name in enumerate(names):
      widths = [parts.get(name, 0.0) for parts in bars.values()]
      axes.barh(list(map(_wrapped, bars)), widths, left=list(left.values()), label=_wrapped(name), color=COLOURS[i % 6])
      left = {bar: left[bar] + width for bar, width in zip(left, widths, strict=True)}
    axes.invert_yaxis()
    axes.set(title=title, xlabel=x)
    axes.legend(frameon=False, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.25))

  return _svg((7, 1.4 + _height(bars, 0.5)), draw)
