"""Records the selected environment as a video, which the browser downloads."""

import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import viser

from playground.deploy.player import Player
from playground.deploy.session import Session
from playground.rendering.video import render_video

_LONGEST = 60.0  # s of a video
_FIELDS = ("qpos", "mocap_pos", "mocap_quat")


class Recorder:
  """Collects the selected environment's states, and renders them when the recording ends."""

  def __init__(
    self, server: viser.ViserServer, session: Session, camera: Callable[[], str | None], say: Callable[..., None]
  ):
    """Prepares for recordings, without starting one.

    Args:
      server: sends the video to its browsers.
      session: the session to record.
      camera: returns the model's camera of the video, None for the default.
      say: shows a sentence in the browsers.
    """
    self._server, self._session, self._camera, self._say = server, session, camera, say
    self._player: Player | None = None
    self._states: list[tuple[np.ndarray, ...]] = []
    session.on_step.append(self._record)

  @property
  def seconds(self) -> float | None:
    """The length of the present recording; None without one."""
    return None if self._player is None else len(self._states) * self._player.period

  def toggle(self) -> None:
    """Starts recording, or stops and renders the video in another thread."""
    player, self._player = self._player, None
    if player is None:
      self._player, self._states = self._session.player, []
    elif self._states:
      threading.Thread(target=self._render, args=(player, self._states), daemon=True).start()

  def _record(self, player: Player) -> None:
    if self._player is None:
      return
    if player is not self._player or len(self._states) * player.period >= _LONGEST:
      self.toggle()  # a video shows one environment and one model
    else:
      self._states.append(tuple(np.asarray(getattr(player.state.data, name)) for name in _FIELDS))

  def _render(self, player: Player, states: list[tuple[np.ndarray, ...]]) -> None:
    name = f"{player.exported.contract['task']}.mp4"
    self._say("Recording", f"Rendering {len(states) * player.period:.1f} s of video.", "blue")
    with tempfile.TemporaryDirectory() as folder:
      fields = dict(zip(_FIELDS, map(np.stack, zip(*states, strict=True)), strict=True))
      notify = lambda sentence: self._say("Recording", sentence)
      path = render_video(
        player.env.mj_model,
        out_path=Path(folder) / name,
        dt=player.period,
        camera=self._camera(),
        notify=notify,
        **fields,
      )
      if path is not None:
        self._server.send_file_download(name, path.read_bytes())
