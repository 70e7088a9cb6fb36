import contextlib
import errno
import os
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import mujoco
import numpy as np
import pytest

from playground import registry
from playground.rendering import gl, video
from playground.rendering.gl import NO_GL_REMEDY, find_gl
from playground.rendering.video import choose_camera, frame_stride, render_video
from tests.processes import WITHOUT_WARP

XML = """
<mujoco>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="fixed" pos="0 -3 1" xyaxes="1 0 0 0 .3 1"/>
    <geom type="plane" size="5 5 .1"/>
    <body name="ball" pos="0 0 .5"><freejoint/><geom size=".1"/></body>
    <body name="goal" mocap="true"><geom size=".05" contype="0" conaffinity="0"/></body>
  </worldbody>
</mujoco>"""


# A run that renders for minutes.
ENDLESS = """
import sys
import numpy as np
from playground import registry
from playground.rendering.video import render_video
model = registry.load("PendulumSwingup").mj_model
render_video(model, np.zeros((20_000, model.nq)), sys.argv[1], dt=0.02)
"""


@pytest.fixture(autouse=True)
def fresh_probe():
  find_gl.cache_clear()
  yield
  find_gl.cache_clear()


@pytest.fixture(scope="module")
def model() -> Any:
  return mujoco.MjModel.from_xml_string(XML)


@pytest.fixture
def needs_gl() -> str:
  backend = find_gl()
  if backend is None:
    pytest.skip(NO_GL_REMEDY)
  return backend


def path_of_ball(model: Any, rows: int) -> np.ndarray:
  qpos = np.tile(model.qpos0, (rows, 1))
  qpos[:, 0] = np.linspace(0, 1, rows)
  return qpos


def test_a_bogus_backend_is_passed_over(monkeypatch: pytest.MonkeyPatch):
  monkeypatch.delenv("DISPLAY", raising=False)
  assert not gl.works("bogus")
  monkeypatch.setenv("MUJOCO_GL", "bogus")
  assert find_gl() in ("egl", "osmesa", None)


def test_a_process_that_only_trains_is_spared_the_users_backend(monkeypatch: pytest.MonkeyPatch):
  monkeypatch.setenv("MUJOCO_GL", "disable")
  monkeypatch.setenv("PLAYGROUND_MUJOCO_GL", "")
  gl.withhold_gl()
  assert "MUJOCO_GL" not in os.environ
  assert find_gl() is None, "children still follow the user's wish"


def test_a_stale_platform_variable_does_not_break_the_probe(monkeypatch: pytest.MonkeyPatch, needs_gl: str):
  monkeypatch.setenv("PYOPENGL_PLATFORM", "glx")
  assert gl.works(needs_gl)


def test_probes_go_in_order_and_happen_once(monkeypatch: pytest.MonkeyPatch):
  tried: list[str] = []
  monkeypatch.setattr(gl, "works", lambda backend: bool(tried.append(backend)))
  monkeypatch.setenv("MUJOCO_GL", "osmesa")
  monkeypatch.setenv("DISPLAY", ":0")
  assert find_gl() is None and find_gl() is None
  assert tried == ["osmesa", "egl", "glfw"]


def test_without_gl_there_is_one_sentence_and_no_video(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, model: Any):
  monkeypatch.setenv("MUJOCO_GL", "disable")
  said: list[str] = []
  assert render_video(model, path_of_ball(model, 3), tmp_path / "a.mp4", dt=0.02, notify=said.append) is None
  assert said == [f"No video at a.mp4. {NO_GL_REMEDY}"]
  assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
  ("dt", "stride"), [(0.02, 1), (0.01, 2), (0.004, 5), (0.0025, 8), (0.05, 1), (0.03, 1), (0.015, 2)]
)
def test_frame_stride_keeps_real_time_at_50_fps_or_less(dt: float, stride: int):
  assert frame_stride(dt) == stride


def test_video_is_real_time_and_shows_motion(tmp_path: Path, model: Any, needs_gl: str):
  mocap_pos, mocap_quat = np.zeros((60, 1, 3)), np.tile([1.0, 0, 0, 0], (60, 1, 1))
  out = render_video(
    model,
    path_of_ball(model, 60),
    tmp_path / "videos" / "a.mp4",
    dt=0.01,
    width=160,
    height=120,
    mocap_pos=mocap_pos,
    mocap_quat=mocap_quat,
    notify=pytest.fail,
  )
  assert out == tmp_path / "videos" / "a.mp4" and list((tmp_path / "videos").iterdir()) == [out]
  reader = imageio_ffmpeg.read_frames(str(out))
  meta: Any = next(reader)
  frames = [np.frombuffer(frame, np.uint8) for frame in reader if isinstance(frame, bytes)]
  assert meta["fps"] == 50 and meta["size"] == (160, 120) and len(frames) == 30
  assert np.abs(frames[0].astype(int) - frames[-1].astype(int)).max() > 30


def test_what_a_policy_sees_is_beside_it(tmp_path: Path, model: Any, needs_gl: str):
  seen = np.zeros((4, 2, 3, 1), np.uint8)
  seen[:, 1, 2] = 255
  qpos = path_of_ball(model, 4)
  out = render_video(model, qpos, tmp_path / "out.mp4", dt=0.04, width=64, height=48, seen=seen)
  reader = imageio_ffmpeg.read_frames(str(out))
  assert next(reader)["size"] == (64 + 72, 48)
  frame = np.frombuffer(next(reader), np.uint8).reshape(48, 64 + 72, 3)
  panel = frame[:, 64:]
  assert panel[28:, 52:].min() > 200 and panel[:20].max() < 50 and panel[:, :44].max() < 50
  assert frame[:, :64].std() > 10


def test_the_swimmer_is_filmed_by_a_camera_that_follows_it():
  assert choose_camera(registry.load("SwimmerSwimmer6").mj_model) == "tracking1"


def test_rows_after_a_nan_are_left_out(tmp_path: Path, model: Any, needs_gl: str):
  qpos = path_of_ball(model, 20)
  qpos[10:] = np.nan
  out = render_video(model, qpos, tmp_path / "a.mp4", dt=0.02, width=64, height=64, notify=pytest.fail)
  assert out and imageio_ffmpeg.count_frames_and_secs(str(out))[0] == 10


@pytest.mark.parametrize(
  ("options", "sentence"),
  [
    ({"camera": "fixd"}, "camera=fixd is no camera of the model; it has fixed. Did you mean 'fixed'?"),
    ({"timeout_s": 0.3}, "took longer than 0.3 s"),
  ],
)
def test_failure_is_one_sentence_and_leaves_nothing(
  tmp_path: Path, model: Any, needs_gl: str, options: dict[str, Any], sentence: str
):
  said: list[str] = []
  qpos = path_of_ball(model, 500)
  assert render_video(model, qpos, tmp_path / "new" / "a.mp4", dt=0.02, notify=said.append, **options) is None
  assert len(said) == 1 and sentence in said[0] and "\n" not in said[0]
  assert list(tmp_path.iterdir()) == []


def test_a_crash_of_the_renderer_does_not_reach_the_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, model: Any):
  monkeypatch.setattr(video, "find_gl", lambda: "bogus")  # the child dies importing mujoco
  said: list[str] = []
  assert render_video(model, path_of_ball(model, 3), tmp_path / "a.mp4", dt=0.02, notify=said.append) is None
  assert len(said) == 1 and "bogus" in said[0]


def test_a_renderer_that_cannot_be_started_is_one_sentence(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, model: Any):
  def refuse(*_: Any, **__: Any) -> None:
    raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")

  monkeypatch.setattr(video, "find_gl", lambda: "egl")
  monkeypatch.setattr(video.subprocess, "Popen", refuse)
  said: list[str] = []
  assert render_video(model, path_of_ball(model, 3), tmp_path / "a.mp4", dt=0.02, notify=said.append) is None
  sentence = "No video at a.mp4: the renderer could not be started (Resource temporarily unavailable)"
  assert len(said) == 1 and said[0].startswith(sentence)


def test_few_renderers_work_at_a_time(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, model: Any):
  """Each takes 0.7 GB, and all agents of a program may ask for a video at once."""
  working, most = [0], [0]

  def render(*_: Any) -> None:
    working[0] += 1
    most[0] = max(most[0], working[0])
    time.sleep(0.1)
    working[0] -= 1

  monkeypatch.setattr(video, "find_gl", lambda: "egl")
  monkeypatch.setattr(video, "_render_in_child", render)
  with ThreadPoolExecutor(8) as agents:
    made = agents.map(lambda i: render_video(model, path_of_ball(model, 3), tmp_path / f"{i}.mp4", dt=0.02), range(8))
  assert list(made) == [tmp_path / f"{i}.mp4" for i in range(8)]
  assert most[0] <= 4


def test_the_renderer_dies_with_a_run_that_is_killed(tmp_path: Path, needs_gl: str):
  scratch = tmp_path / "tmp"
  scratch.mkdir()
  run = subprocess.Popen(
    [sys.executable, "-c", ENDLESS, str(tmp_path / "videos/a.mp4")],
    env={**os.environ, **WITHOUT_WARP, "TMPDIR": str(scratch), "JAX_PLATFORMS": "cpu"},
  )
  try:
    until(lambda: any("ffmpeg" in command for command in commands(scratch).values()))  # it draws and encodes
    assert list(scratch.iterdir())
  finally:
    run.kill()
    run.wait()
  until(lambda: not commands(scratch) and not list(scratch.iterdir()))
  assert not (tmp_path / "videos").exists()


def commands(folder: Path) -> dict[int, str]:
  """The processes whose command names a folder, by id."""
  found = {}
  for process in Path("/proc").glob("[0-9]*/cmdline"):
    with contextlib.suppress(OSError):
      found[int(process.parent.name)] = process.read_text().replace("\0", " ")
  return {pid: command for pid, command in found.items() if str(folder) in command}


def until(true: Callable[[], bool], timeout_s: float = 60.0) -> None:
  end = time.monotonic() + timeout_s
  while not true():
    assert time.monotonic() < end
    time.sleep(0.05)


def test_qpos_of_another_model_is_refused(tmp_path: Path, model: Any, monkeypatch: pytest.MonkeyPatch):
  monkeypatch.setattr(video, "find_gl", lambda: "egl")
  with pytest.raises(ValueError, match=r"\[T, 7\]"):
    render_video(model, np.zeros((5, 3)), tmp_path / "a.mp4", dt=0.02)
