"""Adds sliders of joints, which pose the robot, and of actions, which act in place of the policy."""

import mujoco
import numpy as np
import viser

from playground.deploy.session import Session
from playground.deploy.web.plots import action_names

_UNLIMITED = {int(mujoco.mjtJoint.mjJNT_HINGE): np.pi, int(mujoco.mjtJoint.mjJNT_SLIDE): 1.0}  # rad, m
_PRECISION = 1e-3  # of a slider's value


class Joints:
  """Shows joint positions, which the user can set while time is paused, and actions, which the user can set by hand.

  Attributes:
    joints: a slider for each hinge and slide joint, by its address in `qpos`.
    by_hand: whether the sliders of actions act in place of the policy.
    actions: a slider for each action.
  """

  def __init__(self, gui: viser.GuiApi, session: Session):
    """Adds the sliders."""
    self._gui, self._session = gui, session
    model = session.player.env.mj_model
    with gui.add_folder("Actions"):
      self.by_hand = gui.add_checkbox("By hand", False, hint="the sliders act in place of the policy")
      self.by_hand.on_update(lambda _: session.ask(self._act))
      self.actions = [self._add_slider(name, -1.0, 1.0) for name in action_names(session.player)]
    for slider in self.actions:
      slider.on_update(lambda _: session.ask(self._act) if self.by_hand.value else None)
    self.joints: dict[int, viser.GuiSliderHandle[float]] = {}
    with gui.add_folder("Joints (while paused)"):
      for joint in np.flatnonzero(np.isin(model.jnt_type, list(_UNLIMITED))):
        limit = _UNLIMITED[int(model.jnt_type[joint])]
        low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-limit, limit)
        name, address = model.joint(joint).name or f"joint {joint}", int(model.jnt_qposadr[joint])
        slider = self.joints[address] = self._add_slider(name, float(low), float(high))
        slider.on_update(lambda _, address=address: self._pose(address))

    self._shown: object = None

  def draw(self) -> None:
    """Shows the present positions and actions, except those that the user sets."""
    player, paused = self._session.player, self._session.paused
    for slider in self.actions:
      slider.disabled = not self.by_hand.value
    for slider in self.joints.values():
      slider.disabled = not paused
    if not self.by_hand.value:
      for slider, value in zip(self.actions, player.action.tolist(), strict=True):
        _show(slider, value)
    if self._shown is not player.state:
      self._shown = player.state
      for address, slider in self.joints.items():
        _show(slider, float(player.state.data.qpos[address]))

  def _act(self) -> None:
    """Selects the source of actions: the sliders or the policy."""
    values = np.array([slider.value for slider in self.actions], np.float32) if self.by_hand.value else None
    for player in self._session.players:
      player.manual_action = values

  def _pose(self, address: int) -> None:
    """Moves a joint to its slider's position, unless the slider shows the joint's present position."""
    session, slider = self._session, self.joints[address]

    def pose() -> None:
      session.player.set_joint(address, slider.value)
      self._shown = session.player.state

    if session.paused and abs(slider.value - float(session.player.state.data.qpos[address])) > _PRECISION:
      session.ask(pose)

  def _add_slider(self, name: str, low: float, high: float) -> viser.GuiSliderHandle[float]:
    low, high = round(low, 3), round(high, 3)
    return self._gui.add_slider(
      name, low, high, max(round((high - low) / 200, 3), _PRECISION), max(low, min(0.0, high))
    )


def _show(slider: viser.GuiSliderHandle[float], value: float) -> None:
  slider.value = round(max(slider.min, min(value, slider.max)), 3)
