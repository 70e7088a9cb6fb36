"""The viewer in the browser: its controls without one, then the page in a real Chromium."""

import contextlib
import gzip
import importlib.util
import io
import shutil
import socket
import threading
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from playground.cli.main import main
from playground.cli.play import open_policy
from playground.deploy.menu import Menu
from playground.deploy.player import Player
from playground.deploy.session import Session
from playground.deploy.web.server import Watch
from playground.errors import ConfigError
from tests.command import caller
from tests.deploy.untrained import UntrainedRun, free_port

_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_SOFTWARE_GL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
_WAIT = 60_000  # ms for the page to show something


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> UntrainedRun:
  """A Go1 that hardly moves its joints."""
  run = UntrainedRun(tmp_path_factory.mktemp("web") / "run", "Go1JoystickFlatTerrain", scale=1e-3)
  run.save(1000, 2000)
  return run


@pytest.fixture(scope="module")
def watch(run: UntrainedRun) -> Iterator[Watch]:
  opened = open_policy(str(run.directory.path))
  assert opened.trained is not None
  menu = Menu(run.directory.path, opened.trained, print)
  watch = Watch(Session(opened.env, opened.exported, 0, menu), "127.0.0.1", free_port())
  yield watch
  watch.close()


@pytest.fixture
def session(watch: Watch) -> Iterator[Session]:
  """The session, standing still at the start of an episode."""
  session = watch.session
  watch.panel.paused.value = True
  session.reset()
  yield session
  watch.panel.paused.value = False


def test_sliders_are_the_command(watch: Watch, session: Session) -> None:
  forward, left, turn = watch.panel.command
  assert [(s.min, s.max) for s in (forward, left, turn)] == [(-1.5, 1.5), (-0.8, 0.8), (-1.2, 1.2)]
  forward.value, turn.value = 0.5, -0.2
  np.testing.assert_array_equal(session.player.command, [0.5, 0, -0.2])
  watch.panel.paused.value = False
  session.advance(session.player.period)
  np.testing.assert_allclose(session.player.state.info["command"], [0.5, 0, -0.2])
  watch.panel.leave.value = True
  watch.frame()
  assert session.player.command is None and forward.value == 0


def test_time(watch: Watch, session: Session) -> None:
  player = session.player
  session.advance(1.0)
  assert player.seconds == 0
  watch.panel.paused.value = False
  session.advance(0.11)
  assert player.seconds == pytest.approx(0.1)
  watch.panel.speed.value = 0.25
  session.advance(0.08)  # with the rest from before, one decision and a half
  watch.panel.speed.value = 1.0
  assert player.seconds == pytest.approx(0.12)
  before, now = (np.asarray(qpos) for qpos in (player.previous_qpos, player.state.data.qpos))
  np.testing.assert_allclose(session.qpos(session.player)[:3], (before + now)[:3] / 2, atol=1e-6)
  watch.panel.reset.value = True
  watch.frame()
  assert player.seconds <= 0.12  # a frame passes at most 0.1 s


def test_a_single_step_pauses(watch: Watch, session: Session) -> None:
  watch.panel.paused.value = False
  watch.panel.step.value = True
  session.carry_out()
  assert session.paused and session.player.seconds == pytest.approx(session.player.period)
  np.testing.assert_allclose(session.qpos(session.player), session.player.state.data.qpos, atol=1e-6)


def test_the_floor_is_squares_above_the_plane(watch: Watch, session: Session) -> None:
  view = watch.panel.view
  watch.frame()
  (light, dark), (plane,) = view.squares, view.planes
  assert not np.array_equal(light.color, dark.color)
  np.testing.assert_array_equal(light.position, dark.position)
  assert plane.position[2] < light.position[2] - 0.05  # a nearer one hides them where depth is coarse
  first_corners = [{tuple(corner) for corner in handle.vertices[::4].tolist()} for handle in view.squares]
  assert len(first_corners[0]) == len(first_corners[1]) and not first_corners[0] & first_corners[1]


def test_what_is_shown(watch: Watch, session: Session) -> None:
  view = watch.panel.view
  watch.panel.command[0].value = 0.5
  watch.frame()
  arrow = view.arrows["commanded"]
  tail, tip = arrow.points[0]
  assert arrow.visible and np.linalg.norm(tip - tail) == pytest.approx(0.5, rel=1e-5) and tail[2] > 0
  assert view.scene.camera_tracking_enabled and not view.scene.show_contact_forces
  view.boxes["contacts"].value, view.boxes["velocity"].value, view.boxes["follow"].value = True, False, False
  watch.frame()
  assert view.scene.show_contact_forces and not arrow.visible and not view.scene.camera_tracking_enabled
  view.boxes["contacts"].value, view.boxes["velocity"].value, view.boxes["follow"].value = False, True, True
  watch.panel.leave.value = True
  watch.frame()


@pytest.mark.parametrize("encoding", ["gzip", "identity"])
def test_the_page_has_the_tasks_name(watch: Watch, encoding: str) -> None:
  request = urllib.request.Request(watch.url, headers={"Accept-Encoding": encoding})
  page = urllib.request.urlopen(request).read()
  page = gzip.decompress(page) if encoding == "gzip" else page
  assert b"<title>Go1JoystickFlatTerrain</title>" in page


def test_push(watch: Watch, session: Session) -> None:
  before = np.array(session.player.state.data.qvel)
  watch.panel.push_speed.value = 1.5
  watch.panel.push.value = True
  watch.frame()
  change = session.player.state.data.qvel - before
  assert np.linalg.norm(change[:2]) == pytest.approx(1.5, rel=1e-5) and not change[2:].any()


def test_plots(watch: Watch, session: Session) -> None:
  plots, player = watch.panel.plots, session.player
  watch.panel.paused.value = False
  session.advance(1.01)
  plots.draw()
  total, term = plots.charts["return of the episode"], plots.charts["track_linear_velocity_exp"]
  assert total.data[0][0] == pytest.approx(-10, abs=0.1) and total.data[0][-1] == 0
  assert total.data[1][-1] == pytest.approx(player.episode_return, abs=1e-6)
  assert term.data[1][-1] == pytest.approx(player.terms["track_linear_velocity_exp"], abs=1e-6) and len(term.data) == 2

  assert plots.choice.options == (
    "Reward terms",
    *(f"Observations: {n}" for n in player.state.obs),
    "Actions",
    "Nothing",
  )
  for choice, titles in (("Observations: state", "gyro"), ("Actions", "FR_hip"), ("Nothing", None), ("no such", None)):
    plots.choice.value = choice
    session.carry_out()
    assert plots.charts == {} if titles is None else titles in plots.charts
    assert {chart._impl.parent_container_id for chart in plots.charts.values()} <= {plots._tab._id}
    session.advance(0.1)
    plots.draw()
    if choice == "Observations: state":
      shown = np.concatenate([chart.data[1:] for chart in plots.charts.values()])
      np.testing.assert_allclose(shown[:, -1], player.state.obs["state"], atol=1e-6)
    if choice == "Actions":
      np.testing.assert_allclose([chart.data[1][-1] for chart in plots.charts.values()], player.action, atol=1e-6)
  plots.choice.value = "Reward terms"
  session.carry_out()


def test_joints_are_posed_while_paused(watch: Watch, session: Session) -> None:
  joints, player = watch.panel.joints, session.player
  joints.draw()
  address, slider = next(iter(joints.joints.items()))
  assert not slider.disabled and slider.value == pytest.approx(float(player.state.data.qpos[address]), abs=1e-3)
  session.carry_out()
  unchanged = player.state
  assert session.player.state is unchanged, "to show positions sets none"
  slider.value = slider.max
  session.carry_out()
  assert player.state.data.qpos[address] == pytest.approx(slider.max)
  np.testing.assert_allclose(session.qpos(player)[address], slider.max, rtol=1e-6)
  watch.panel.paused.value = False
  slider.value = slider.min
  session.carry_out()
  joints.draw()
  assert slider.disabled and player.state.data.qpos[address] == pytest.approx(slider.max)


def test_actions_by_hand(watch: Watch, session: Session) -> None:
  joints, player = watch.panel.joints, session.player
  joints.actions[0].value = 0.5  # shows what the policy does, until they are the hand's
  session.step()
  assert player.action[0] != 0.5
  joints.draw()
  np.testing.assert_allclose([slider.value for slider in joints.actions], player.action, atol=1e-3)
  joints.by_hand.value = True
  joints.actions[0].value = -0.5
  session.carry_out()
  session.step()
  assert player.action[0] == -0.5
  joints.by_hand.value = False
  session.carry_out()
  session.step()
  assert player.action[0] != -0.5


def test_environments_side_by_side(watch: Watch, session: Session) -> None:
  view, panel = watch.panel.view, watch.panel
  panel.command[0].value = 0.5
  view.num_envs.value = 4
  watch.frame()
  first, *others = session.players
  assert len(others) == 3 and view.scene.num_envs == 4 and all(p.command is first.command for p in others)
  assert not np.array_equal(first.state.data.qpos, others[0].state.data.qpos)
  session.step()
  assert all(p.seconds == pytest.approx(p.period) for p in session.players)
  view.selected.value = 3
  watch.frame()
  assert session.player is others[1] and view.scene.env_idx == 2
  view.num_envs.value = 1
  watch.frame()
  assert session.players == [first] and session.player is first and view.selected.value == 1
  panel.leave.value = True
  watch.frame()


def test_cameras(watch: Watch, session: Session) -> None:
  view = watch.panel.view
  assert view.camera.options[:2] == ("free", "track") and view.model_camera is None
  view.next_camera()
  watch.frame()
  assert view.model_camera == "track"
  view.camera.value = "no such"
  watch.frame()
  assert view.model_camera is None
  view.next_camera()
  assert view.camera.value == "free"


def test_a_recording_is_a_video(watch: Watch, session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
  recorder, sent = watch.panel.recorder, []
  monkeypatch.setattr(watch.server, "send_file_download", lambda name, content: sent.append((name, content)))
  watch.panel.record.value = True
  session.carry_out()
  assert recorder.seconds == 0
  for _ in range(3):
    session.step()
  watch.panel.draw()
  assert "recording 0.1 s" in watch.panel._status.content
  rendered: dict[str, Any] = {}

  def render(model: Any, out_path: Path, **options: Any) -> Path:
    rendered.update(options)
    out_path.write_bytes(b"video")
    return out_path

  monkeypatch.setattr("playground.deploy.web.recording.render_video", render)
  monkeypatch.setattr(threading.Thread, "start", threading.Thread.run)
  watch.panel.record.value = True
  session.carry_out()
  assert sent == [("Go1JoystickFlatTerrain.mp4", b"video")] and recorder.seconds is None
  assert rendered["dt"] == session.player.period and rendered["camera"] is None
  np.testing.assert_array_equal(rendered["qpos"][-1], session.player.state.data.qpos)
  assert len(rendered["qpos"]) == 3


def test_checkpoints_follow_the_training(watch: Watch, session: Session, run: UntrainedRun) -> None:
  menu = watch.panel.checkpoint
  acting = lambda: session.player.exported.contract["origin"]["steps"]
  refresh = lambda: (session.carry_out(), session.follow(), watch.panel.draw())
  assert (menu.value, menu.options, acting()) == ("latest", ("latest", "1,000", "2,000"), 2000)
  run.save(3000)
  refresh()
  assert menu.options == ("latest", "1,000", "2,000", "3,000") and acting() == 3000
  menu.value = "1,000"
  refresh()
  run.save(4000)  # three are kept: the one that acts is no more
  refresh()
  assert menu.options == ("latest", "1,000", "2,000", "3,000", "4,000") and acting() == 1000
  menu.value = "latest"
  refresh()
  assert acting() == 4000 and menu.value == "latest"

  run.save(5000, episode_return=2.0)
  run.save(6000, episode_return=1.0)
  refresh()
  assert menu.options == ("latest", "best (5,000)", "4,000", "5,000", "6,000") and acting() == 6000
  menu.value = "best (5,000)"
  refresh()
  assert acting() == 5000
  run.save(7000, episode_return=3.0)
  refresh()
  assert (menu.value, acting()) == ("best (7,000)", 7000), "training goes on, and so does the best"
  run.save(8000)
  refresh()
  assert menu.options == ("latest", "best (7,000)", "6,000", "7,000", "8,000") and acting() == 7000
  menu.value = "latest"
  refresh()
  assert acting() == 8000


def test_a_checkpoint_that_is_gone(
  watch: Watch, session: Session, run: UntrainedRun, monkeypatch: pytest.MonkeyPatch
) -> None:
  said: list[str] = []
  monkeypatch.setattr(watch.panel, "say", lambda title, body: said.append(body))
  session.ask(lambda: session.choose_checkpoint(run.directory.checkpoints / f"{77:012d}"))
  acting = session.player.exported
  watch.frame()
  assert len(said) == 1 and "000000000077" in said[0] and session.player.exported is acting
  session.choose_checkpoint("latest")


def test_terrain(watch: Watch, session: Session) -> None:
  watch.panel.command[0].value = 0.3
  watch.panel.joints.by_hand.value = True
  watch.frame()
  flat = session.player
  watch.panel.terrain.value = "stairs"
  watch.frame()
  assert session.terrain == "stairs" and session.player.env.mj_model.nhfield == 1 and flat.env.mj_model.nhfield == 0
  assert session.player.command is flat.command
  assert session.player.manual_action is not None and session.player.manual_action is flat.manual_action
  watch.panel.joints.by_hand.value = False
  watch.panel.leave.value = True
  watch.frame()


def test_a_terrain_that_fails_to_load(watch: Watch, session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
  said: list[str] = []
  monkeypatch.setattr(watch.panel, "say", lambda title, body: said.append(body))
  player, terrain = session.player, session.terrain
  with monkeypatch.context() as patched:
    patched.setattr("playground.deploy.session.load_on_c_physics", refuse)
    watch.panel.terrain.value = "slope"
    watch.frame()
  assert said == ["no such terrain"] and watch.panel.terrain.value == terrain
  watch.frame()
  assert session.player is player and session.terrain == terrain, "the menu's change loads nothing"


def refuse(*_: Any, **__: Any) -> None:
  raise ConfigError("no such terrain")


def test_a_randomized_model_stays_randomized_on_another_terrain(session: Session) -> None:
  env, exported = session.player.env, session.player.exported
  first, second = (Session(env, exported, 0, model_seed=seed) for seed in (None, 3))
  for changed in (first, second):
    changed.choose_terrain("flat")
  friction = [changed.player.env.mj_model.geom_friction for changed in (first, second)]
  assert not np.array_equal(*friction)


def test_one_sentence_each(
  run: UntrainedRun, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  command = caller(monkeypatch, "playground", main)
  path = str(run.directory.path)
  with socket.create_server(("127.0.0.1", 0)) as taken:
    port = str(taken.getsockname()[1])
    assert command("play", path, "--web", "--port", port) == 2
  assert f"--host=127.0.0.1 --port={port}: Address already in use" in capsys.readouterr().err
  assert command("play", path, "--web", "--port", "70000") == 2
  assert "--port=70000" in capsys.readouterr().err
  truly = importlib.util.find_spec
  monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == "viser" else truly(name, *rest))
  assert command("play", path, "--web") == 2
  assert "This needs viser: pip install -e '.[web]' in the checkout." in capsys.readouterr().err


@pytest.mark.slow  # without a GPU the browser draws so slowly that beside other tests keys get lost
def test_page(watch: Watch, monkeypatch: pytest.MonkeyPatch) -> None:
  with browser() as chromium, running(watch):
    page = chromium.new_page(viewport={"width": 640, "height": 480})
    complaints: list[str] = []
    page.on("console", lambda said: complaints.append(said.text) if said.type == "error" else None)
    page.on("pageerror", lambda error: complaints.append(f"{error} {error.stack}"))
    page.add_init_script("window.pad = null; navigator.getGamepads = () => [window.pad]")
    page.goto(f"http://127.0.0.1:{watch.server.get_port()}")
    page.get_by_text("Go1JoystickFlatTerrain").wait_for(timeout=_WAIT)
    session = watch.session
    begun = session.player.seconds
    eventually(page, lambda: session.player.seconds != begun)
    eventually(page, lambda: floor_contrast(page) > 0.05)  # light and dark squares; a plane of one colour has 0.02
    page.get_by_text("(automatic)").wait_for(timeout=_WAIT)

    slider = page.get_by_role("slider").first
    slider.focus()
    for _ in range(5):
      slider.press("ArrowRight")
    eventually(page, lambda: session.player.command is not None and session.player.command[0] > 0)
    page.get_by_text("(yours)").wait_for(timeout=_WAIT)

    page.locator("body").press("t")
    eventually(page, lambda: asked(session) is None)
    page.locator("body").press("j")
    eventually(page, lambda: asked(session) == [0, 0, 0.1])

    buttons = "buttons: [{pressed: true}]"
    page.evaluate(f"window.pad = {{connected: true, axes: [0, -0.5, 0, 0], {buttons}}}")
    eventually(page, lambda: asked(session) == [0.75, 0, 0])
    page.evaluate("window.pad = null")

    page.get_by_text("Paused").wait_for(timeout=_WAIT)
    page.locator("body").press("Space")
    eventually(page, lambda: session.paused)
    page.locator("body").press("Space")
    eventually(page, lambda: not session.paused)

    speed = page.get_by_role("slider").nth(3)
    speed.press("Home")
    eventually(page, lambda: session.speed == 0.05)
    speed.press("End")
    pushes: list[float] = []
    monkeypatch.setattr(Player, "push", lambda player, by: pushes.append(by))
    page.get_by_role("button", name="Push (P)").click(timeout=_WAIT)
    eventually(page, lambda: pushes == [0.5])

    view, recorder = watch.panel.view, watch.panel.recorder
    for tab, shown in (("Scene", "Environments"), ("Plots", "track_linear_velocity_exp"), ("Joints", "FR_hip_joint")):
      page.get_by_role("tab", name=tab).click(timeout=_WAIT)
      page.get_by_text(shown, exact=True).first.wait_for(timeout=_WAIT)
    page.get_by_role("tab", name="Keys").click(timeout=_WAIT)
    page.get_by_text("next camera").wait_for(timeout=_WAIT)
    page.locator("body").press("c")
    eventually(page, lambda: view.model_camera == "track")
    page.get_by_role("tab", name="Scene").click(timeout=_WAIT)
    page.get_by_role("slider").first.press("ArrowRight")
    eventually(page, lambda: len(session.players) == 2)

    page.locator("body").press("v")
    eventually(page, lambda: (recorder.seconds or 0.0) > 0.2)
    page.locator("body").press("v")
    with page.expect_download(timeout=2 * _WAIT) as download:
      page.get_by_role("link", name="Go1JoystickFlatTerrain.mp4").click(timeout=2 * _WAIT)
    assert b"ftyp" in Path(download.value.path()).read_bytes()[:16]
    assert complaints == []


def floor_contrast(page: Any) -> float:
  """Difference of the brightest and darkest parts of the floor at the page's lower left, in [0, 1]."""
  pixels = imread(io.BytesIO(page.screenshot(timeout=_WAIT)))[300:, :200, :3].mean(-1)
  return float(np.diff(np.percentile(pixels, [5, 95]))[0])


def asked(session: Session) -> list[float] | None:
  """The watcher's command."""
  return None if session.player.command is None else session.player.command.tolist()


def eventually(page: Any, condition: Callable[[], bool]) -> None:
  """Waits until the page's message has come through."""
  for _ in range(_WAIT // 50):
    if condition():
      return
    page.wait_for_timeout(50)
  raise AssertionError("it never came to be")


@contextlib.contextmanager
def running(watch: Watch) -> Iterator[None]:
  """Lets time pass on a thread of its own, as the command does on its only one."""
  stop, failed = threading.Event(), []

  def run() -> None:
    try:
      while not stop.is_set():
        watch.frame()
    except Exception as error:
      failed.append(error)

  thread = threading.Thread(target=run)
  thread.start()
  try:
    yield
  finally:
    stop.set()
    thread.join()
  assert failed == []


@contextlib.contextmanager
def browser() -> Iterator[Any]:
  """A headless Chromium that draws without a GPU."""
  playwright = pytest.importorskip("playwright.sync_api")
  with playwright.sync_playwright() as started:
    found = [path for name in _BROWSERS if (path := shutil.which(name))]
    own = Path(started.chromium.executable_path)
    if not found and not own.is_file():
      pytest.skip("there is no Chromium here: install one, or run `playwright install chromium`")
    launched = started.chromium.launch(executable_path=found[0] if found else own, args=_SOFTWARE_GL)
    try:
      yield launched
    finally:
      launched.close()
