"""The return of the present episode as it grows, and what each term of the reward has added."""

import numpy as np
import viser
from matplotlib import colormaps
from matplotlib.colors import to_hex

from playground.deploy.player import Player

_EVERY = 0.1  # s of the episode between two points


class Plots:
  """Two charts over the seconds of an episode."""

  def __init__(self, gui: viser.GuiApi, player: Player):
    """Adds the charts; the second only if the task tells the terms of its reward."""
    self._gui = gui
    self._rows: list[list[float]] = []
    self.charts = [self._add("return", ["return"])]
    if player.term_sums:
      self.charts.append(self._add("sums of weighted reward terms", list(player.term_sums)))

  def record(self, player: Player) -> None:
    """Notes where the episode stands."""
    last = self._rows[-1][0] if self._rows else -np.inf
    if player.seconds < last:
      self._rows.clear()
    elif player.seconds < last + _EVERY:
      return
    self._rows.append([player.seconds, player.episode_return, *player.term_sums.values()])

  def draw(self) -> None:
    """Shows what was noted."""
    if self._rows:
      seconds, total, *terms = np.array(self._rows).T
      for chart, lines in zip(self.charts, ([total], terms), strict=False):
        chart.data = (seconds, *lines)

  def _add(self, title: str, names: list[str]) -> viser.GuiUplotHandle:
    colors = colormaps["tab20"].colors  # pyright: ignore[reportAttributeAccessIssue]
    lines = [
      viser.uplot.Series(label=name, stroke=to_hex(colors[i % len(colors)]), width=2) for i, name in enumerate(names)
    ]
    return self._gui.add_uplot(
      tuple(np.zeros(1) for _ in range(1 + len(names))),
      (viser.uplot.Series(label="s"), *lines),
      title=title,
      scales={"x": viser.uplot.Scale(time=False)},
      aspect=1.6,
      padding=(12, 24, 0, 0),  # the topmost number would be cut
    )
