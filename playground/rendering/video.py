"""Renders a recorded trajectory to MP4 in a child process, so that no GL crash or hang reaches the run.

`python -m playground.rendering.video <trajectory.npz> <out.mp4>` is the child; $MUJOCO_GL chooses how it draws.
"""

import contextlib
import math
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from playground.errors import ConfigError, PlaygroundError, UnknownNameError, nearest
from playground.rendering.gl import NO_GL_REMEDY, find_gl, gl_environment
from playground.runs.files import need_file, replacing

MAX_FPS = 50.0
# Names of cameras that look on from where a task is seen best; the swimmer's is tracking1.
_CAMERAS = ("track", "tracking", "tracking1", "fixed", "side", "front", "back", "cam0")


def save_trajectory(
  path: str | Path,
  mj_model: Any,
  qpos: np.ndarray,
  mocap_pos: np.ndarray | None = None,
  mocap_quat: np.ndarray | None = None,
  dt: float = 0.02,
  **view: Any,
) -> Path:
  """Writes a trajectory to `path` (.npz) and its model next to it (.mjb).

  Args:
    path: ends in .npz.
    mj_model: the MjModel that `qpos` belongs to.
    qpos: [T, nq].
    mocap_pos: [T, nmocap, 3], if bodies are moved by mocap.
    mocap_quat: [T, nmocap, 4].
    dt: seconds between two rows of `qpos`.
    **view: camera, width, height, seen of the video (`render_video`).
  """
  import mujoco

  path, qpos = Path(path), np.asarray(qpos)
  if qpos.ndim != 2 or qpos.shape[1] != mj_model.nq:
    raise ValueError(f"qpos must have shape [T, {mj_model.nq}], not {list(qpos.shape)}")
  arrays: dict[str, Any] = {"qpos": qpos, "dt": dt, "mocap_pos": mocap_pos, "mocap_quat": mocap_quat, **view}
  np.savez_compressed(path, **{k: v for k, v in arrays.items() if v is not None})
  mujoco.mj_saveModel(mj_model, str(path.with_suffix(".mjb")))
  return path


def render_video(
  mj_model: Any,
  qpos: np.ndarray,
  out_path: str | Path,
  *,
  dt: float,
  camera: str | None = None,
  width: int = 640,
  height: int = 480,
  mocap_pos: np.ndarray | None = None,
  mocap_quat: np.ndarray | None = None,
  seen: np.ndarray | None = None,
  timeout_s: float | None = None,
  notify: Callable[[str], None] = print,
) -> Path | None:
  """Renders `qpos` [T, nq] in real time to `out_path`.

  Args:
    mj_model: the MjModel that `qpos` belongs to.
    qpos: [T, nq]; rows from the first NaN on are left out.
    out_path: the .mp4 to write; complete or absent, whatever happens.
    dt: seconds between two rows of `qpos`.
    camera: a camera of the model; by default one meant for looking on, else one that follows a floating base.
    width: pixels, even.
    height: pixels, even.
    mocap_pos: [T, nmocap, 3].
    mocap_quat: [T, nmocap, 4].
    seen: [T, H, W, 1 or 3] uint8, what a policy sees of it: shown on the right, as high as the video, its pixels apart.
    timeout_s: when to give up; by default a minute and a half second a frame.
    notify: takes one sentence if there is no video.

  Returns:
    `out_path`, or None if it could not be rendered.
  """
  out_path = Path(out_path).absolute()
  backend = find_gl()
  if backend is None:
    notify(f"No video at {out_path.name}. {NO_GL_REMEDY}")
    return None
  timeout_s = timeout_s or 60.0 + 0.5 * len(qpos)
  scratch = tempfile.TemporaryDirectory(prefix="playground_video_", ignore_cleanup_errors=True)
  with scratch as folder, open(f"{folder}/stderr", "w+") as stderr:
    view = {"camera": camera, "width": width, "height": height, "seen": seen}
    trajectory = save_trajectory(Path(folder) / "trajectory.npz", mj_model, qpos, mocap_pos, mocap_quat, dt, **view)
    environment = gl_environment(backend) | {
      # The child runs this very package, whatever its folder.
      "PYTHONPATH": os.pathsep.join(filter(None, (str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH")))),
      "JAX_PLATFORMS": "cpu",  # and must never reach for the GPU memory that training holds
    }
    rendered = Path(folder) / "video.mp4"  # what a killed encoder leaves goes with the folder
    command = [sys.executable, "-m", "playground.rendering.video", str(trajectory), str(rendered)]
    child = subprocess.Popen(command, cwd=folder, env=environment, stderr=stderr, start_new_session=True)
    try:
      code = child.wait(timeout_s)
      stderr.seek(0)
      lines = stderr.read().strip().splitlines()
      reason = lines[-1].rstrip(".") if lines else f"the renderer ended with code {code}"
    except subprocess.TimeoutExpired:
      code, reason = 1, f"rendering with MUJOCO_GL={backend} took longer than {timeout_s:g} s"
    finally:
      with contextlib.suppress(OSError):
        os.killpg(child.pid, signal.SIGKILL)  # the whole group: the encoder would live on and write its file
      child.wait()
    if code == 0 and rendered.is_file():
      out_path.parent.mkdir(parents=True, exist_ok=True)
      with replacing(out_path) as temporary:
        shutil.copyfile(rendered, temporary)
      return out_path
  notify(f"No video at {out_path.name}: {reason}; `playground doctor` shows what rendering needs.")
  return None


def need_place(video: str | None, camera: str | None = None) -> Path | None:
  """Where `--video` says, None if it was not given.

  Raises:
    ConfigError: it cannot be written there, or only `--camera` was given.
  """
  if video is None:
    if camera is not None:
      raise ConfigError(f"--camera={camera} is of the video that --video=<file> asks for.")
    return None
  path = Path(video).expanduser()
  need_file(path, ".mp4", f"--video={video}")
  return path


def need_camera(model: Any, name: str | None, option: str) -> None:
  """Raises UnknownNameError, which names the option that it is of, for a camera that the model has not; None is any."""
  if name is not None and name not in (names := camera_names(model)):
    have = ", ".join(names) or "none"
    raise UnknownNameError(f"{option}={name} is no camera of the model; it has {have}.{nearest(name, names)}")


def camera_names(model: Any) -> list[str]:
  """Names of the model's cameras."""
  return [name for i in range(model.ncam) if (name := model.camera(i).name)]


def frame_stride(dt: float) -> int:
  """Returns every how many rows a frame is taken, so that playback is real time at no more than `MAX_FPS`."""
  return max(1, math.ceil(1 / (MAX_FPS * dt) - 1e-6))


def _render(trajectory: Path, out_path: Path) -> None:
  """The child's work: draws and encodes."""
  import imageio_ffmpeg
  import mujoco

  saved = np.load(trajectory)
  model = mujoco.MjModel.from_binary_path(str(trajectory.with_suffix(".mjb")))
  data = mujoco.MjData(model)
  width, height, dt = int(saved["width"]), int(saved["height"]), float(saved["dt"])
  camera = choose_camera(model, str(saved["camera"]) if "camera" in saved else None)
  finite = np.isfinite(saved["qpos"]).all(axis=1)
  length = len(finite) if finite.all() else int(finite.argmin())
  if length == 0:
    raise PlaygroundError("the trajectory has no finite state to draw.")
  model.vis.global_.offwidth = max(width, model.vis.global_.offwidth)
  model.vis.global_.offheight = max(height, model.vis.global_.offheight)
  # Measured without a GPU, 640x480: 18 ms a frame instead of 30 at MuJoCo's 4096, and no difference to the eye.
  model.vis.quality.shadowsize = min(2048, model.vis.quality.shadowsize)
  stride = frame_stride(dt)
  seen = saved.get("seen")
  fps: Any = 1 / (dt * stride)  # declared int by imageio_ffmpeg, which prints it with two decimals
  writer = imageio_ffmpeg.write_frames(
    str(out_path),
    (width if seen is None else width + enlarged(seen[0], height).shape[1], height),
    fps=fps,
    codec="libx264",
    quality=7,
    macro_block_size=2,
    output_params=["-movflags", "+faststart"],
  )
  writer.send(None)
  with mujoco.Renderer(model, height, width) as renderer:
    for t in range(0, length, stride):
      data.qpos[:] = saved["qpos"][t]
      for name in ("mocap_pos", "mocap_quat"):
        if name in saved:
          getattr(data, name)[:] = saved[name][t]
      mujoco.mj_forward(model, data)
      renderer.update_scene(data, camera)
      frame = renderer.render()
      writer.send(frame if seen is None else np.hstack([frame, enlarged(seen[t], height)]))
  writer.close()


def enlarged(picture: np.ndarray, height: int) -> np.ndarray:
  """A picture [H, W, 1 or 3] of `height` rows and an even number of columns, [height, width, 3]; pixels stay sharp."""
  rows, columns = picture.shape[:2]
  width = 2 * max(1, round(height * columns / rows / 2))
  picture = picture[np.arange(height)[:, None] * rows // height, np.arange(width) * columns // width]
  return np.broadcast_to(picture, (height, width, 3))


def choose_camera(model: Any, name: str | None = None) -> Any:
  """Returns the named camera, or the best one the model offers for looking at it from outside."""
  import mujoco

  need_camera(model, name, "camera")
  names = camera_names(model)
  chosen = name or next((known for known in _CAMERAS if known in names), None)
  if chosen:
    return chosen
  view = mujoco.MjvCamera()
  mujoco.mjv_defaultFreeCamera(model, view)
  follow(view, model)
  return view


def follow(view: Any, model: Any) -> None:
  """Has a free camera (an MjvCamera) follow a robot that walks; on others it stays as it is."""
  import mujoco

  if walks(model):
    view.type, view.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, model.jnt_bodyid[0]
    view.distance = min(view.distance, 3.0)  # terrain makes the model's extent, and so the default, huge


def walks(model: Any) -> bool:
  """Whether to follow what moves first: a robot that walks out of the picture, but no free object on a table."""
  import mujoco

  roots = [model.body_rootid[b] for b in model.jnt_bodyid]
  return bool(roots) and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE and roots.count(roots[0]) > 1


if __name__ == "__main__":
  try:
    _render(Path(sys.argv[1]), Path(sys.argv[2]))
  except Exception as error:  # the parent shows the last line
    sys.exit(str(error).splitlines()[0] if str(error) else type(error).__name__)
