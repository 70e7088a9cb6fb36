"""Reads gamepads of the machine that the browser runs on.

viser does not support gamepads. A script in a separate frame of the page writes the gamepad's state to the browser's
local storage, which viser can read.
"""

import dataclasses
import html
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated

import msgspec
import viser

_ENTRY = "playground-gamepad"
_SCRIPT = """<script>
  const entry = Object.keys(localStorage).find(key => key.endsWith("ENTRY"));
  setInterval(() => {
    const pad = [...parent.navigator.getGamepads()].find(pad => pad && pad.connected && pad.axes.length > 2);
    const note = pad ? JSON.stringify({axes: pad.axes, pressed: pad.buttons.map(button => button.pressed)}) : "";
    localStorage.setItem(entry, note);
  }, 20);
</script>"""
_DEADBAND = 0.1  # of a stick's range
_OFTEN, _SELDOM = 0.03, 0.5  # s between two readings, with a gamepad and without
_TIMEOUT = 5.0  # s for a browser's answer


class _Note(msgspec.Struct):
  """The state that the script writes."""

  axes: Annotated[list[Annotated[float, msgspec.Meta(ge=-2.0, le=2.0)]], msgspec.Meta(min_length=3)]
  pressed: list[bool]


@dataclasses.dataclass(frozen=True)
class Pad:
  """The state of a gamepad with the standard layout.

  Attributes:
    sticks: left one forward, left one left, right one left, in [-1, 1].
    pressed: numbers of the pressed buttons.
  """

  sticks: tuple[float, float, float] = (0.0, 0.0, 0.0)
  pressed: frozenset[int] = frozenset()

  @classmethod
  def read(cls, note: str) -> "Pad":
    """Parses the script's state; an invalid state gives a gamepad at rest."""
    try:
      message = msgspec.json.decode(note, type=_Note)
    except msgspec.MsgspecError:
      return cls()
    left_x, left_y, right_x = [-x if abs(x) > _DEADBAND else 0.0 for x in message.axes[:3]]
    return cls((left_y, left_x, right_x), frozenset(i for i, down in enumerate(message.pressed) if down))


class Gamepads:
  """Listens to the gamepad of each browser."""

  def __init__(
    self,
    server: viser.ViserServer,
    ask: Callable[[Callable[[], None]], None],
    steer: Callable[[Sequence[float]], None],
    buttons: Mapping[int, Callable[[], None]],
  ):
    """Starts listening.

    Args:
      server: viser's server.
      ask: queues a function, to call between two policy steps.
      steer: called with `Pad.sticks` when they have moved.
      buttons: called when a button is pressed, by its number.
    """
    self._server = server
    self._ask, self._steer, self._buttons = ask, steer, buttons
    self._closed = threading.Event()
    server.on_client_connect(lambda client: threading.Thread(target=self._listen, args=(client,), daemon=True).start())

  def close(self) -> None:
    """Stops listening."""
    self._closed.set()

  def _listen(self, client: viser.ClientHandle) -> None:
    client.local_storage.set_item(_ENTRY, "")
    frame = f'<iframe hidden srcdoc="{html.escape(_SCRIPT.replace("ENTRY", _ENTRY))}"></iframe>'
    client.gui.add_html(frame)
    last, pause = Pad(), _SELDOM
    while not self._closed.wait(pause) and client.client_id in self._server.get_clients():
      try:
        note = client.local_storage.get_item(_ENTRY, timeout=_TIMEOUT)
      except TimeoutError:  # the page sleeps in the background
        continue
      except RuntimeError:  # the page is closed, or has no local storage
        return
      now = Pad.read(note) if note else Pad()
      self._tell(last, now)
      last, pause = now, _OFTEN if note else _SELDOM

  def _tell(self, last: Pad, now: Pad) -> None:
    if now.sticks != last.sticks:
      self._ask(lambda: self._steer(now.sticks))
    for number in now.pressed - last.pressed:
      if number in self._buttons:
        self._ask(self._buttons[number])
