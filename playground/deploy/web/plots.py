"""Plots the last seconds of reward terms, an observation group or the actions, one small chart for each."""

from collections import deque
from collections.abc import Callable, Mapping

import mujoco
import numpy as np
import viser
from matplotlib import colormaps
from matplotlib.colors import to_hex

from playground.deploy.player import Player
from playground.deploy.session import Session
from playground.envs.base import observation_groups

_SECONDS = 10.0  # that a chart shows
_POINTS = 250  # on a line, at most
_LINES = 20  # in a chart, at most
_DECIMALS = 6  # uPlot's ticks overflow on ranges near the smallest numbers
_HEIGHT = 120  # pixels of a chart
# Pixels of an axis and between its numbers: with uPlot's defaults the vertical axis of such a low chart has one number.
_AXES: tuple[viser.uplot.Axis, ...] = ({"size": 26, "space": 60}, {"size": 52, "space": 16})
_REWARDS, _OBSERVATIONS, _ACTIONS, _NOTHING = "Reward terms", "Observations", "Actions", "Nothing"
Values = Callable[[Player], np.ndarray]


class Plots:
  """Draws the charts of the quantity that a menu chooses.

  Attributes:
    choice: the menu.
    charts: the charts, by title.
  """

  def __init__(self, gui: viser.GuiApi, session: Session, tab: viser.GuiTabHandle):
    """Adds the menu, and the charts of the reward, to `tab`."""
    self._gui, self._session, self._tab = gui, session, tab
    groups = [f"{_OBSERVATIONS}: {group}" for group in _groups(session.player)]
    with tab:
      self.choice = gui.add_dropdown("Plot", (_REWARDS, *groups, _ACTIONS, _NOTHING))
    self.choice.on_update(lambda _: session.ask(self._choose))
    self.charts: dict[str, viser.GuiUplotHandle] = {}
    self._choose()
    session.on_step.append(self._record)

  def draw(self) -> None:
    """Updates the charts."""
    if not self._rows or not self.charts:
      return
    stride = -(-len(self._rows) // _POINTS)
    lines = list(np.array(self._rows)[::-1][::stride][::-1].T.round(_DECIMALS))
    seconds = -stride * self._session.player.period * np.arange(len(lines[0]))[::-1]
    for title, size in self._sizes.items():
      self.charts[title].data = (seconds, *lines[: min(size, _LINES)])
      lines = lines[size:]

  def _choose(self) -> None:
    """Replaces the charts by those of the menu's choice."""
    for chart in self.charts.values():
      chart.remove()
    self._sizes, self._values = _quantities(self.choice.value, self._session.player)
    self._rows: deque[np.ndarray] = deque(maxlen=round(_SECONDS / self._session.player.period))
    with self._tab:
      self.charts = {title: self._add_chart(title, size) for title, size in self._sizes.items()}

  def _record(self, player: Player) -> None:
    """Records the values after a policy step."""
    row = self._values(player)
    # The time axis has a constant length: viser's charts lose an axis that gets shorter.
    self._rows.extend([row] * (1 if self._rows else self._rows.maxlen or 1))

  def _add_chart(self, title: str, size: int) -> viser.GuiUplotHandle:
    colors = colormaps["tab20" if size > 10 else "tab10"].colors  # pyright: ignore[reportAttributeAccessIssue]
    lines = [viser.uplot.Series(stroke=to_hex(color), width=2) for color in colors[: min(size, _LINES)]]
    return self._gui.add_uplot(
      tuple(np.zeros(1) for _ in range(1 + len(lines))),
      (viser.uplot.Series(label="s"), *lines),
      title=title,
      scales={"x": viser.uplot.Scale(time=False)},
      axes=_AXES,
      legend=viser.uplot.Legend(show=False),
      height=_HEIGHT,
      padding=(8, 24, 0, 0),  # else the topmost number is cut off
    )


def _groups(player: Player) -> Mapping[str, np.ndarray]:
  """Returns the observation groups that are vectors, by name."""
  groups = observation_groups(player.state.obs)
  return {name: np.asarray(value) for name, value in groups.items() if np.ndim(value) == 1}


def _quantities(choice: str, player: Player) -> tuple[dict[str, int], Values]:
  """Returns the number of values in each chart, by title, and the function that reads them all."""
  if choice == _REWARDS:
    sizes = {"return of the episode": 1} | dict.fromkeys(player.terms, 1)
    return sizes, lambda now: np.array([now.episode_return, *now.terms.values()])
  if choice == _ACTIONS:
    return dict.fromkeys(action_names(player), 1), lambda now: np.asarray(now.action)
  group = choice.removeprefix(f"{_OBSERVATIONS}: ")
  if group not in (groups := _groups(player)):  # nothing, or a value that is not in the menu
    return {}, lambda now: np.zeros(0)
  sizes, size = player.env.observation_parts.get(group, {}), len(groups[group])
  if sum(sizes.values()) != size:  # frames, one after another
    sizes = {group: size}
  return dict(sizes), lambda now: _groups(now)[group]


def action_names(player: Player) -> list[str]:
  """Returns the names of the actions: those of their actuators, if each action has one."""
  model, size = player.env.mj_model, player.env.action_size
  names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, i) for i in range(model.nu)]
  return [names[i] or f"actuator {i}" if model.nu == size else f"action {i}" for i in range(size)]
