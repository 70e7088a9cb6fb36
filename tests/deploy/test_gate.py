"""Who may connect to the viewer in the browser and what that may say: a real server, and websocket clients."""

import http.client
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from playground.cli.main import main
from playground.cli.play import open_policy
from playground.deploy.menu import Menu
from playground.deploy.session import Session
from playground.deploy.web.gamepad import Pad
from playground.deploy.web.gate import Gate
from playground.deploy.web.server import Watch
from tests.command import caller
from tests.deploy.test_web import browser, eventually, running
from tests.deploy.untrained import UntrainedRun, free_port
from tests.processes import WITHOUT_WARP

CAMERA = {
  "type": "ViewerCameraMessage", "wxyz": [1.0, 0, 0, 0], "position": [1, 1, 1], "fov": 1.0, "near": 0.1, "far": 10.0,
  "image_height": 10, "image_width": 10, "look_at": [0, 0, 0], "up_direction": [0, 0, 1],
}  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
  path = tmp_path_factory.mktemp("gate") / "run"
  UntrainedRun(path, "CartpoleBalance", "debug=fast").save(1000, 2000)
  return path


@pytest.fixture(scope="module")
def watch(run: Path) -> Iterator[Watch]:
  opened = open_policy(str(run))
  assert opened.trained is not None
  session = Session(opened.env, opened.exported, 0, Menu(run, opened.trained, print))
  watch = Watch(session, "127.0.0.1", free_port())
  yield watch
  watch.close()


@pytest.fixture(scope="module")
def open_gate() -> Iterator[Gate]:
  """Of a server that other machines can reach."""
  gate = Gate("0.0.0.0", 0)
  yield gate
  gate.close()


def test_viser_prints_nothing(capsys: pytest.CaptureFixture[str]) -> None:
  """Its banner has an address without the token."""
  Gate("127.0.0.1", free_port()).close()
  assert capsys.readouterr().out == ""


def client(port: int, path: str = "/", **headers: str) -> ClientConnection:
  """Connects as the page does, but for what `headers` say."""
  address = f"ws://127.0.0.1:{port}{path}"
  protocols: Any = [f"viser-v{viser.__version__}"]
  named = {name.title(): value for name, value in headers.items() if name != "host"}
  if "host" in headers:  # the client library writes one itself
    return connect(
      f"ws://{headers['host']}{path}",
      sock=socket.create_connection(("127.0.0.1", port)),
      subprotocols=protocols,
      additional_headers=named,
    )
  return connect(address, subprotocols=protocols, additional_headers=named)


def get(port: int, path: str = "/", **headers: str) -> tuple[int, http.client.HTTPResponse]:
  connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
  connection.request("GET", path, headers={name.title(): value for name, value in headers.items()})
  answer = connection.getresponse()
  return answer.status, answer


@pytest.mark.parametrize("origin", ["", "http://127.0.0.1:{}", "https://127.0.0.1:{}"])
def test_the_own_page_may_connect(watch: Watch, origin: str) -> None:
  port = watch.server.get_port()
  with client(port, **({"origin": origin.format(port)} if origin else {})) as connection:
    assert connection.recv(timeout=10)
  assert get(port)[0] == get(port, host=f"localhost:{port}")[0] == get(port, host="[::1]:9")[0] == 200


@pytest.mark.parametrize(
  "headers",
  [
    *({"origin": o} for o in ("http://evil.com", "http://127.0.0.1:1", "null", "http://localhost:{}", "file://")),
    {"host": "evil.com:{}", "origin": "http://evil.com:{}"},
    *({"host": h} for h in ("evil.com", "127.0.0.1.evil.com:{}", "10.0.0.1:{}", "localhost.evil.com")),
  ],
  ids=str,
)
def test_another_page_may_not(watch: Watch, headers: dict[str, str]) -> None:
  port = watch.server.get_port()
  headers = {name: value.format(port) for name, value in headers.items()}
  with pytest.raises(InvalidStatus, match="HTTP 403"):
    client(port, **headers)
  assert get(port, **headers)[0] == 403


def test_a_server_that_others_can_reach_asks_for_its_token(open_gate: Gate) -> None:
  port = open_gate.server.get_port()
  token = re.fullmatch(rf"http://\S+:{port}/\?token=([\w-]{{32}})", open_gate.url)
  assert token
  for path in ("/", "/?token=", f"/?token={token[1]}x", "/?token=é", f"/{token[1]}"):
    with pytest.raises(InvalidStatus, match="HTTP 403"):
      client(port, path.replace("é", "%C3%A9"))
    status, answer = get(port, path.replace("é", "%C3%A9"))
    assert status == 403 and b"with its token" in answer.read() and "Set-Cookie" not in answer.headers
  status, answer = get(port, f"/?token={token[1]}", host="my-machine:80")
  assert status == 200
  cookie = str(answer.headers["Set-Cookie"])
  assert cookie.startswith(f"playground-{port}="), "a browser sends a host's cookies to each of its ports"
  assert "HttpOnly" in cookie and "SameSite=Strict" in cookie
  assert get(port, "/", cookie=cookie.partition(";")[0])[0] == 200
  with client(port, cookie=f"other=1; {cookie.partition(';')[0]}") as connection:
    assert connection.recv(timeout=10)
  with pytest.raises(InvalidStatus, match="HTTP 403"):
    client(port, f"/?token={token[1]}", origin="http://evil.com")


@pytest.mark.slow
def test_the_page_brings_its_token(open_gate: Gate) -> None:
  port, token = open_gate.server.get_port(), open_gate.url.partition("?")[2]
  with browser() as chromium:
    chromium.new_page().goto(f"http://127.0.0.1:{port}/")
    page = chromium.new_context().new_page()
    page.goto(f"http://127.0.0.1:{port}/?{token}")
    eventually(page, lambda: len(open_gate.server.get_clients()) == 1)
    other = chromium.new_page()
    other.goto(f"data:text/html,<script>s = new WebSocket('ws://127.0.0.1:{port}/?{token}')</script>")
    eventually(other, lambda: other.evaluate("s.readyState") == 3)  # closed
    assert len(open_gate.server.get_clients()) == 1


@pytest.mark.parametrize("host", ["", " "])
def test_a_host_that_is_empty(
  run: Path, host: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  assert caller(monkeypatch, "playground", main)("play", str(run), "--web", "--host", host) == 2
  assert "is empty: name an address of this machine" in capsys.readouterr().err


@pytest.mark.parametrize("host", ["192.0.2.1", "nope.invalid"])
def test_a_host_that_is_of_another_machine(
  run: Path, host: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  assert caller(monkeypatch, "playground", main)("play", str(run), "--web", "--host", host) == 2
  error = capsys.readouterr().err
  assert error.count(host) == 1 and error.endswith("--host must be an address of this machine, or 0.0.0.0 for all.\n")


def bad_messages(watch: Watch) -> list[Any]:
  panel, view = watch.panel, watch.panel.view
  controls: dict[str, Any] = {n: getattr(panel, n) for n in ("speed", "checkpoint", "paused", "push", "push_speed")}
  controls |= {"num_envs": view.num_envs, "selected": view.selected, "camera": view.camera, "plot": panel.plots.choice}
  controls |= {"by_hand": panel.joints.by_hand, "action": panel.joints.actions[0]}
  controls["joint"] = next(iter(panel.joints.joints.values()))
  ids = {name: control._impl.uuid for name, control in controls.items()}
  update = lambda name, value: {"type": "GuiUpdateMessage", "uuid": ids[name], "updates": {"value": value}}
  values = (1e9, -1, float("nan"), float("inf"), "fast", None, [], {}, True, b"x", 10**18)
  sliders = ("speed", "push_speed", "num_envs", "selected", "action", "joint")
  speeds = [update(name, value) for name in sliders for value in values]
  texts = ("no such", "9,999", "", 3, None, ["latest"], "x" * 20_000)
  labels = [update(name, value) for name in ("checkpoint", "camera", "plot") for value in texts]
  switches = ("paused", "push", "by_hand")
  others = [update(name, value) for name in switches for value in ("yes", 2, None, [], float("nan"))]
  properties = ({"min": -1e9}, {"max": 1e9, "value": 1e9}, {"update_cb": 1}, {"sync_cb": None}, {"removed": True}, {})
  changes = [{"type": "GuiUpdateMessage", "uuid": ids["speed"], "updates": change} for change in properties]
  kinds = [
    *({"type": name} for name in ("ShareUrlRequest", "ShareUrlDisconnect", "Nothing", "Message", "", None, 3)),
    {"type": "GuiUpdateMessage", "uuid": "nobody", "updates": {"value": 1}},
    {"type": "GuiUpdateMessage", "uuid": [], "updates": 3},
    {"type": "CommandTriggerMessage", "uuid": "nobody"},
    {"type": "FileTransferStartUpload", "source_component_uuid": ids["speed"], "size_bytes": 10**12},
    *(CAMERA | {"wxyz": [float("nan")] * 4}, CAMERA | {"wxyz": []}, CAMERA | {"fov": "wide"}, CAMERA | {"extra": 1}),
    *(CAMERA | {"image_height": -1}, {"type": "LocalStorageGetItemResponseMessage", "value": 3, "error": 4}),
    *(None, [], 3, "text", {}, {1: 2}),
  ]
  raw = [b"", b"\xff", b"\xc1", b"\x91" * 60_000, "text", "{}"]
  return [*(msgspec.msgpack.encode(m) for m in (*speeds, *labels, *others, *changes, *kinds)), *raw]


def test_bad_messages_change_nothing(watch: Watch, capfd: pytest.CaptureFixture[str]) -> None:
  panel, session = watch.panel, watch.session

  def values() -> tuple[object, ...]:
    limits = panel.speed.min, panel.speed.max
    players = len(session.players), session.selected, session.player.manual_action
    return (*limits, *players, session.speed, panel.push_speed.value, panel.view.model_camera, panel.checkpoint.value)

  watch.frame()
  before = values()
  port = watch.server.get_port()
  with running(watch), client(port, origin=f"http://127.0.0.1:{port}") as connection:
    connection.send(msgspec.msgpack.encode(CAMERA))
    for message in bad_messages(watch):
      connection.send(message)
    update = {"type": "GuiUpdateMessage", "uuid": panel.speed._impl.uuid, "updates": {"value": 2}}
    connection.send(msgspec.msgpack.encode(update))
    wait_for(lambda: session.speed == 2.0)  # all before it have been heard
    begun = session.player.seconds
    wait_for(lambda: session.player.seconds != begun)
    panel.speed.value = 1.0
    wait_for(lambda: panel.checkpoint.value == before[-1])
    assert not session.paused
  assert values() == before
  assert "Traceback" not in capfd.readouterr().err


NOTES = [
  *("", "x", "[]", "3", "{}", '{"axes": [NaN, 0, 0], "pressed": []}', '{"axes": [0], "pressed": []}'),
  *('{"axes": [1e99, 0, 0], "pressed": []}', '{"axes": [0, 0, 0], "pressed": 3}'),
]


@pytest.mark.parametrize("note", NOTES)
def test_a_gamepad_that_says_nonsense(note: str) -> None:
  assert Pad.read(note) == Pad()


def test_requests_without_end_do_not_stop_time(watch: Watch) -> None:
  session = watch.session

  def again() -> None:
    session.ask(again)

  again()
  for _ in range(1000):
    session.ask(lambda: None)
  assert session._requests.qsize() == 100
  begun = time.monotonic()
  session.carry_out()
  assert time.monotonic() - begun < 5 and session._requests.qsize() == 1
  session._requests.get()


@pytest.mark.parametrize("signum", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_a_signal_ends_it_whatever_its_clients_say(run: Path, signum: signal.Signals) -> None:
  port = free_port()
  command = [sys.executable, "-m", "playground.cli.main", "play", str(run), "--web", "--port", str(port)]
  env = os.environ | WITHOUT_WARP
  with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=env) as process:
    try:
      assert process.stdout is not None
      assert any(f"http://127.0.0.1:{port}/" in line and "ctrl+c" in line for line in process.stdout)
      with client(port) as connection:
        connection.send(msgspec.msgpack.encode(CAMERA))
        share = msgspec.msgpack.encode({"type": "ShareUrlRequest"})
        for _ in range(100):
          connection.send(share)
        process.send_signal(signum)
        assert process.wait(120) == 0
    finally:
      process.kill()


def wait_for(condition: Any, seconds: float = 60.0) -> None:
  until = time.monotonic() + seconds
  while not condition():
    assert time.monotonic() < until, "it never came to be"
    time.sleep(0.02)
