"""Adds the viewer's controls: sliders, buttons, menus, and keys for most of them.

Keys and gamepads move the sliders, and only the sliders set the command.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import viser

from playground.deploy.player import STEP
from playground.deploy.session import Session
from playground.deploy.web.gamepad import Gamepads
from playground.deploy.web.joints import Joints
from playground.deploy.web.plots import Plots
from playground.deploy.web.recording import Recorder
from playground.deploy.web.view import View
from playground.errors import PlaygroundError
from playground.robots.terrain import TERRAINS

Key = Any  # a literal type of viser that is not public
# Component of the command, key that increases it, key that decreases it; viser uses WASD, QE and arrows for its camera.
AXES: tuple[tuple[str, Key, Key], ...] = (
  ("forward, m/s", "I", "K"),
  ("left, m/s", "U", "O"),
  ("turn, rad/s", "J", "L"),
)
_KEYS = """
| Key | Action |
|---|---|
| I K | command: forward, back |
| U O | command: left, right |
| J L | command: turn left, right |
| T | automatic commands |
| space | pause |
| N | one step |
| R | reset |
| P | push |
| V | record |
| C | next camera |
| W A S D, Q E, arrows, mouse | move the camera |
| ctrl K | all commands |

| Gamepad | Action |
|---|---|
| left stick | command: forward, left |
| right stick | command: turn |
| first button | push |
| second button | reset |
| start | pause |
"""
_DEFAULT_RANGE = 1.0  # m/s and rad/s, of the sliders if the task has no range


class Panel:
  """Shows the controls of a session, in tabs.

  Attributes:
    view: draws the scene.
    plots: charts of rewards, observations and actions.
    joints: sliders of joints and actions.
    recorder: records videos.
  """

  def __init__(self, server: viser.ViserServer, session: Session):
    """Adds the controls to the page."""
    self._server, self._gui, self._session = server, server.gui, session
    self._status = self._gui.add_markdown("")
    tabs = self._gui.add_tab_group()
    with tabs.add_tab("Control"):
      self.command = self._add_command() if session.player.takes_commands else []
      self._add_time()
      self._add_choices()
    self.view = View(server, session, tabs.add_tab("Scene"))
    self._add_key("Next camera", "C", lambda: self.view.next_camera())
    self.plots = Plots(self._gui, session, tabs.add_tab("Plots"))
    with tabs.add_tab("Joints"):
      self.joints = Joints(self._gui, session)
    with tabs.add_tab("Keys"):
      self._gui.add_markdown(_KEYS)
    self.recorder = Recorder(server, session, lambda: self.view.model_camera, self.say)
    self._gamepads = Gamepads(
      server, session.ask, self._steer, {0: self._push, 1: session.reset, 9: self._toggle_pause}
    )

  def close(self) -> None:
    """Stops listening to gamepads."""
    self._gamepads.close()

  def draw(self) -> None:
    """Shows the session's present state."""
    session, player = self._session, self._session.player
    lines = [
      f"{session.acting} steps trained" if session.acting != "0" else "no policy",
      f"{player.seconds:.1f} s, return {player.episode_return:.2f}",
    ]
    if player.takes_commands:
      who = "automatic" if player.command is None else "yours"
      lines.append(f"command {' / '.join(f'{value:.2f}' for value in player.task_command)} ({who})")
    if (seconds := self.recorder.seconds) is not None:
      lines.append(f"**recording {seconds:.1f} s**")
    self._status.content = "  \n".join(lines)
    self.plots.draw()
    self.joints.draw()
    if choices := session.choices():
      self._offer(choices)

  def say(self, title: str, body: str, color: Literal["red", "blue"] = "red") -> None:
    """Shows a sentence in all browsers."""
    for client in self._server.get_clients().values():
      client.add_notification(title, body, color=color, auto_close_seconds=10.0)

  def _add_command(self) -> list[viser.GuiSliderHandle[float]]:
    player = self._session.player
    command = player.exported.contract.get("command") or {}
    high = np.array(command.get("max") or [_DEFAULT_RANGE] * len(AXES))
    low = -high if command.get("min") is None else np.array(command["min"])
    sliders: list[viser.GuiSliderHandle[float]] = []

    def take(_: object) -> None:
      self._session.set_command(np.array([slider.value for slider in sliders]))

    def leave() -> None:
      for slider in sliders:
        _set(slider, 0.0)
      self._session.set_command(None)

    with self._gui.add_folder("Command"):
      for (label, more, less), least, most in zip(AXES, low.tolist(), high.tolist(), strict=True):
        start = min(max(0.0, least), most)
        slider = self._gui.add_slider(label, least, most, 0.01, start, hint=f"keys {more} and {less}")
        slider.on_update(take)
        sliders.append(slider)
        for key, change in ((more, STEP), (less, -STEP)):
          self._add_key(f"{label}: {change:+g}", key, lambda by=change, it=slider: _set(it, it.value + by))
      self.leave = self._add_button("Automatic commands", "T", leave)
    return sliders

  def _add_time(self) -> None:
    session = self._session
    with self._gui.add_folder("Episode"):
      self.paused = self._gui.add_checkbox("Paused", False, hint="key space")
      self.paused.on_update(lambda _: setattr(session, "paused", self.paused.value))
      self._add_key("Pause", "space", self._toggle_pause)
      self.step = self._add_button("Step", "N", self._step)
      self.speed = self._gui.add_slider("Speed", 0.05, 2.0, 0.05, 1.0, hint="simulated seconds per second")
      self.speed.on_update(lambda _: setattr(session, "speed", self.speed.value))
      most = max(0.5, session.push_speed)
      self.push_speed = self._gui.add_slider(
        "Push, m/s", 0.1, most, 0.1, 0.5, hint="added to the robot's velocity at once"
      )
      self.push = self._add_button("Push", "P", self._push)
      self.reset = self._add_button("Reset", "R", session.reset)
      self.record = self._add_button("Record", "V", lambda: self.recorder.toggle())

  def _add_choices(self) -> None:
    session = self._session
    if session.terrain is not None:
      self.terrain = self._gui.add_dropdown("Terrain", tuple(TERRAINS), initial_value=session.terrain)
      self.terrain.on_update(lambda _: self._choose_terrain(self.terrain.value))
    if choices := session.choices():
      self._choices = choices
      self.checkpoint = self._gui.add_dropdown("Checkpoint", tuple(choices), initial_value=self._chosen(choices))
      self.checkpoint.on_update(lambda _: self._choose_checkpoint(self.checkpoint.value))

  def _choose_terrain(self, name: str) -> None:
    if name in TERRAINS:
      self._ask(lambda: self._load_terrain(name))
    elif self._session.terrain is not None:  # not in the menu: sent by a client that is no browser
      self.terrain.value = self._session.terrain

  def _load_terrain(self, name: str) -> None:
    """Loads a terrain unless it is the present one; if that fails, the menu shows the present one again."""
    present = self._session.terrain
    if name == present:
      return
    try:
      self._session.choose_terrain(name)
    except PlaygroundError:
      if self.terrain.value == name and present is not None:  # not if the user has chosen another one since
        self.terrain.value = present
      raise

  def _choose_checkpoint(self, label: str) -> None:
    if label in self._choices:
      choice = self._choices[label]
      self._ask(lambda: self._session.choose_checkpoint(choice))
    else:
      self.checkpoint.value = self._chosen(self._choices)

  def _steer(self, sticks: Sequence[float]) -> None:
    """Sets the command from sticks in [-1, 1], scaled to the ranges of the sliders."""
    for slider, stick in zip(self.command, sticks, strict=False):
      _set(slider, stick * slider.max if stick > 0 else -stick * slider.min)

  def _push(self) -> None:
    self._session.push(self.push_speed.value)

  def _step(self) -> None:
    self.paused.value = True
    self._session.step()

  def _toggle_pause(self) -> None:
    self.paused.value = not self.paused.value

  def _offer(self, choices: Mapping[str, str | Path]) -> None:
    """Updates the menu of checkpoints."""
    self._choices |= choices  # the user may have clicked a label that was just removed
    if tuple(choices) == self.checkpoint.options:
      return
    if self.checkpoint.value not in choices:  # the best checkpoint has changed
      self.checkpoint.value = self._chosen(choices)
    self.checkpoint.options = tuple(choices)

  def _chosen(self, choices: Mapping[str, str | Path]) -> str:
    session = self._session
    return next((label for label, choice in choices.items() if choice == session.following), session.acting)

  def _add_button(self, label: str, key: Key, act: Callable[[], None]) -> viser.GuiButtonHandle:
    button = self._gui.add_button(f"{label} ({key})")
    button.on_click(lambda _: self._session.ask(act))
    self._add_key(label, key, act)
    return button

  def _add_key(self, label: str, key: Key, act: Callable[[], None]) -> None:
    """Adds a key, and an entry in viser's palette of commands (ctrl K)."""
    self._gui.add_command(label, hotkey=key).on_trigger(lambda _: self._session.ask(act))

  def _ask(self, act: Callable[[], None]) -> None:
    self._status.content = "one moment ..."
    self._session.ask(act)


def _set(slider: viser.GuiSliderHandle[float], value: float) -> None:
  """Moves a slider, at most to the end of its range."""
  slider.value = round(min(max(value, slider.min), slider.max), 2)
