"""Restricts who can connect to the viewer in the browser, and which messages they can send.

viser accepts every connection: from a web page of another site (websockets have no same-origin policy), and from every
machine on the network if the viewer listens there. The gate checks requests and messages before viser handles them, in
the hooks that `websockets` has for this purpose.
"""

import asyncio
import contextlib
import errno
import gzip
import hmac
import html
import http
import io
import ipaddress
import secrets
import socket
from collections.abc import Callable
from typing import Annotated, Any
from urllib.parse import parse_qs, urlsplit

import msgspec
import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from playground.errors import ConfigError

_LARGEST = 2**16  # bytes of a message: cameras, sliders, the state of a gamepad

_Number = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]  # and so not NaN
_Text = Annotated[str, msgspec.Meta(max_length=10_000)]
_Size = Annotated[int, msgspec.Meta(ge=0, le=100_000)]
_Vector = tuple[_Number, _Number, _Number]


class _Message(msgspec.Struct, tag_field="type", tag=lambda name: name.lstrip("_"), forbid_unknown_fields=True):
  pass


class _Value(msgspec.Struct, forbid_unknown_fields=True):
  value: bool | _Number | _Text


class _GuiUpdateMessage(_Message):
  uuid: _Text
  updates: _Value


class _CommandTriggerMessage(_Message):
  uuid: _Text


class _LocalStorageGetItemResponseMessage(_Message):
  value: _Text | None
  error: _Text | None
  request_uuid: _Text


class _ViewerCameraMessage(_Message):
  wxyz: tuple[_Number, _Number, _Number, _Number]
  position: _Vector
  fov: _Number
  near: _Number
  far: _Number
  image_height: _Size
  image_width: _Size
  look_at: _Vector
  up_direction: _Vector


_DECODER = msgspec.msgpack.Decoder(
  _GuiUpdateMessage | _CommandTriggerMessage | _LocalStorageGetItemResponseMessage | _ViewerCameraMessage
)


class Gate:
  """Checks the requests and messages to one viser server.

  Attributes:
    server: viser's server.
    url: the address to open, with the token if connections need one.
  """

  def __init__(self, host: str, port: int, title: str = "playground"):
    """Starts viser's server behind the gate; connections need a token unless only this machine can connect.

    Args:
      host: the address to listen at.
      port: the port to listen at.
      title: title of the page.
    """
    self._title = title
    self._host = host
    self._token = None if _is_loopback(host, port) else secrets.token_urlsafe(24)
    server = self._start(host, port)
    self._cookie = f"playground-{server.get_port()}"  # a browser sends a host's cookies to each of its ports
    self.server = server
    name = f"[{host}]" if ":" in host else socket.gethostname() if host in ("0.0.0.0", "::") else host
    self.url = f"http://{name}:{self.server.get_port()}/" + (f"?token={self._token}" if self._token else "")

  def close(self) -> None:
    """Stops the server."""
    with contextlib.redirect_stdout(io.StringIO()):  # viser cannot switch off its message
      self.server.stop()

  def check(self, request: Request) -> str:
    """Returns why a request is refused, "" if it is accepted."""
    if not hasattr(self, "server"):
      return "the server has not started yet"
    hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
    try:
      (name,) = {urlsplit(f"//{host}").hostname for host in hosts}
    except ValueError:
      return "a request names one host"
    if self._token is None and not (name in ("localhost", self._host) or _is_address_of_loopback(name)):
      # a page of another site whose name resolves to this machine (DNS rebinding)
      return f"this server is for this machine alone, as {self._host}, and not as {name}"
    if origins and [urlsplit(origin).netloc for origin in origins] != hosts:  # set by the browser, not by the page
      return f"a page of {origins[0]} may not connect"
    if self._token is not None and not any(
      hmac.compare_digest(t.encode(), self._token.encode()) for t in self._told(request)
    ):
      return "the address must be the one that the command has printed, with its token"
    return ""

  def admit(self, raw: object) -> bytes | None:
    """Returns a message for viser; None if the page does not send such messages, or if its value is invalid."""
    try:
      message = _DECODER.decode(raw) if isinstance(raw, bytes) else None
    except msgspec.MsgspecError:
      return None
    if message is None or (isinstance(message, _GuiUpdateMessage) and not self._fits(message)):
      return None
    return msgspec.msgpack.encode(message)

  def _fits(self, message: _GuiUpdateMessage) -> bool:
    """Returns whether a control can have the value; callbacks of menus check their values themselves."""
    handle = self.server.gui._gui_input_handle_from_uuid.get(message.uuid)  # viser has no public lookup
    value = message.updates.value
    if isinstance(handle, viser.GuiSliderHandle):
      return isinstance(value, float) and handle.min <= value <= handle.max
    if isinstance(handle, viser.GuiDropdownHandle):
      return isinstance(value, str)
    return isinstance(handle, viser.GuiCheckboxHandle | viser.GuiButtonHandle) and isinstance(value, bool)

  def _told(self, request: Request) -> list[str]:
    """Returns the tokens in a request's address and cookies."""
    cookies = [
      pair.strip().partition("=") for header in request.headers.get_all("Cookie") for pair in header.split(";")
    ]
    tokens = [value for name, _, value in cookies if name == self._cookie]
    return tokens + parse_qs(urlsplit(request.path).query).get("token", [])

  def _start(self, host: str, port: int) -> viser.ViserServer:
    """Starts viser's server, which calls `serve` of `websockets` in its constructor and passes no options to it."""
    serve, began = websockets.asyncio.server.serve, []

    def guarded(*args: Any, process_request: Callable[..., Response | None], **options: Any) -> Any:
      began.append(True)
      options |= {"max_size": _LARGEST, "create_connection": lambda *a, **k: _Connection(self, *a, **k)}
      return serve(*args, process_request=lambda *request: self._answer(process_request, *request), **options)

    websockets.asyncio.server.serve = guarded
    try:
      with contextlib.redirect_stdout(
        io.StringIO()
      ):  # viser cannot switch off its banner, whose address lacks the token
        server = viser.ViserServer(host, port, label=self._title, verbose=False)
    finally:
      websockets.asyncio.server.serve = serve
    if not began:
      server.stop()
      raise RuntimeError("This viser does not start its server through websockets.asyncio.server.serve.")
    return server

  def _answer(
    self, process_request: Callable[..., Response | None], connection: ServerConnection, request: Request
  ) -> Response | None:
    if refusal := self.check(request):
      return connection.respond(http.HTTPStatus.FORBIDDEN, f"Refused: {refusal}.\n")
    response = process_request(connection, request)
    if response is not None and response.headers.get("Content-Type", "").startswith("text/html"):
      _set_title(response, self._title)
    if response is not None and self._token is not None:  # the page's own connection has no token in its address
      response.headers["Set-Cookie"] = f"{self._cookie}={self._token}; Path=/; HttpOnly; SameSite=Strict"
    return response


class _Connection(ServerConnection):
  """A connection that passes only admitted messages to viser."""

  def __init__(self, gate: Gate, *args: Any, **options: Any):
    super().__init__(*args, **options)
    self._gate = gate

  async def recv(self, decode: bool | None = None) -> Any:
    while (message := self._gate.admit(await super().recv(decode))) is None:
      await asyncio.sleep(0)
    return message


def need_port(host: str, port: int) -> None:
  """Raises ConfigError if the server cannot listen at this address."""
  if not host.strip():
    raise ConfigError(f"--host={host!r} is empty: name an address of this machine, or 0.0.0.0 for all.")
  try:
    socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET).close()
  except (OSError, OverflowError, UnicodeError) as error:
    of_port = isinstance(error, OverflowError) or getattr(error, "errno", None) in (errno.EADDRINUSE, errno.EACCES)
    remedy = "try another port" if of_port else "--host must be an address of this machine, or 0.0.0.0 for all"
    reason, *_ = (getattr(error, "strerror", None) or str(error)).split(" (while attempting")  # it repeats the address
    raise ConfigError(f"The page cannot be served on --host={host} --port={port}: {reason}; {remedy}.") from None


def _set_title(response: Response, title: str) -> None:
  """Replaces the title of viser's page, for which viser has no option."""
  packed = response.headers.get("Content-Encoding") == "gzip"
  page = gzip.decompress(response.body) if packed else response.body
  page = page.replace(b"<title>Viser</title>", f"<title>{html.escape(title)}</title>".encode())
  response.body = gzip.compress(page) if packed else page
  if "Content-Length" in response.headers:
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))


def _is_loopback(host: str, port: int) -> bool:
  """Returns whether only this machine can connect to an address."""
  return all(_is_address_of_loopback(found[4][0]) for found in socket.getaddrinfo(host, port))


def _is_address_of_loopback(text: object) -> bool:
  try:
    return ipaddress.ip_address(str(text)).is_loopback
  except ValueError:
    return False
