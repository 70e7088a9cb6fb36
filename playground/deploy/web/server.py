"""Serves the viewer to browsers, and runs the loop that advances time."""

import time

from playground.deploy.session import Session
from playground.deploy.web.gate import Gate, need_port
from playground.deploy.web.panel import Panel
from playground.errors import PlaygroundError
from playground.runs.interrupts import noted_signals

_FRAME = 1 / 30  # s between two frames; a browser without a GPU draws fewer
_DRAW = 0.25  # s between two updates of text, plots and checkpoints
_LONGEST = 0.1  # s of simulation per frame, at most; a slow machine falls behind


class Watch:
  """Serves a session to browsers, and advances it."""

  def __init__(self, session: Session, host: str, port: int):
    """Starts serving.

    Raises:
      ConfigError: the port is taken, or the address is not one of this machine.
    """
    need_port(host, port)
    self.session = session
    self._gate = Gate(host, port, session.player.exported.contract["task"])
    self.server, self.url = self._gate.server, self._gate.url
    self.panel = Panel(self.server, session)
    self._now = time.perf_counter()
    self._drawn = 0.0

  def frame(self) -> None:
    """Handles requests, advances by the time since the last frame, and draws."""
    session, last = self.session, self._now
    time.sleep(max(0.0, last + _FRAME - time.perf_counter()))
    self._now = time.perf_counter()
    try:
      session.carry_out()
      if self._now - self._drawn > _DRAW:
        session.follow()
    except PlaygroundError as error:
      self.panel.say("This did not work", str(error))
    session.advance(min(self._now - last, _LONGEST))
    self.panel.view.show()
    if self._now - self._drawn > _DRAW:
      self.panel.draw()
      self._drawn = self._now

  def close(self) -> None:
    """Stops serving."""
    self.panel.close()
    self._gate.close()


def watch(session: Session, host: str, port: int) -> None:
  """Serves a session until it is interrupted."""
  with noted_signals() as ended:
    watching = Watch(session, host, port)
    try:
      print(f"Watch it at {watching.url} (ctrl+c here ends it).", flush=True)
      while not ended.is_set():
        watching.frame()
    finally:
      watching.close()
