"""Renders a recorded trajectory to MP4 in a child process, so that no GL crash or hang reaches the run.

`render_video` starts the child, `python -m playground.rendering.video <out.mp4> <scratch> <pipe>`, with the trajectory
as standard input; $MUJOCO_GL chooses the child's renderer. The child owns the scratch folder. The child removes the
folder and ends when its parent dies for any reason, which closes the other end of the pipe.
"""

import contextlib
import io
import math
import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from playground.errors import ConfigError, PlaygroundError, UnknownNameError, nearest
from playground.files import need_file, replacing
from playground.interpreter import PYTHON
from playground.rendering.gl import NO_GL_REMEDY, find_gl, gl_environment
from playground.text import first_line

if TYPE_CHECKING:
  import mujoco

MAX_FPS = 50.0
_TRIES = 100
_REMEDY = "; `playground doctor` shows what rendering needs."
# Agents of one program ask for videos at once; a renderer takes a core and 0.7 GB (measured with EGL on a CPU).
_RENDERERS = threading.BoundedSemaphore(min(4, os.cpu_count() or 1))
# Names of cameras with the best view of a task; the swimmer's is tracking1.
_CAMERAS = ("track", "tracking", "tracking1", "fixed", "side", "front", "back", "cam0")


def render_video(
  mj_model: "mujoco.MjModel",
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
    out_path: the .mp4 to write; it is complete or absent.
    dt: seconds between two rows of `qpos`.
    camera: a camera of the model; by default one made for videos, else one that follows a floating base.
    width: pixels, even.
    height: pixels, even.
    mocap_pos: [T, nmocap, 3].
    mocap_quat: [T, nmocap, 4].
    seen: [T, H, W, 1 or 3] uint8, the policy's images: shown on the right, as high as the video, without smoothing.
    timeout_s: time limit; by default a minute and a half second a frame.
    notify: takes one sentence if there is no video.

  Returns:
    `out_path`, or None if rendering failed.
  """
  out_path = Path(out_path).absolute()
  view = {"camera": camera, "width": width, "height": height, "seen": seen}
  with _RENDERERS:
    try:
      if (backend := find_gl()) is None:
        failure = f". {NO_GL_REMEDY}"
      else:
        trajectory = _pack(mj_model, qpos, mocap_pos=mocap_pos, mocap_quat=mocap_quat, dt=dt, **view)
        failure = _render_in_child(backend, trajectory, out_path, timeout_s or 60.0 + 0.5 * len(qpos))
    except OSError as error:  # no memory or no process left for the renderer, or no folder for its files
      failure = f": the renderer could not be started ({error.strerror or error}){_REMEDY}"
  if failure is None:
    return out_path
  notify(f"No video at {out_path.name}{failure}")
  return None


def _render_in_child(backend: str, trajectory: bytes, out_path: Path, timeout_s: float) -> str | None:
  """Renders a packed trajectory; returns the end of a sentence about a failure, else None."""
  environment = gl_environment(backend) | {
    # The child imports this package, from any working directory.
    "PYTHONPATH": os.pathsep.join(filter(None, (str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH")))),
    "JAX_PLATFORMS": "cpu",  # the child must not use the GPU memory of training
  }
  scratch = Path(tempfile.gettempdir()).absolute() / f"playground_video_{secrets.token_hex(8)}"
  theirs, ours = os.pipe()
  command = [*PYTHON, "-m", "playground.rendering.video", str(out_path), str(scratch), str(theirs)]
  try:
    with subprocess.Popen(
      command,
      env=environment,
      stdin=subprocess.PIPE,
      stderr=subprocess.PIPE,
      pass_fds=(theirs,),
      start_new_session=True,
    ) as child:
      try:
        stderr = child.communicate(trajectory, timeout_s)[1].decode(errors="replace")
        lines = stderr.strip().splitlines()
        reason = lines[-1].rstrip(".") if lines else f"the renderer ended with code {child.returncode}"
      except subprocess.TimeoutExpired:
        reason = f"rendering with MUJOCO_GL={backend} took longer than {timeout_s:g} s"
      finally:
        with contextlib.suppress(OSError):
          os.killpg(child.pid, signal.SIGKILL)  # the whole group, else the encoder continues and writes its file
  finally:
    os.close(theirs)
    os.close(ours)
    shutil.rmtree(scratch, ignore_errors=True)
  return None if child.returncode == 0 else f": {reason}{_REMEDY}"


def need_place(video: str | None, camera: str | None = None) -> Path | None:
  """Returns the path of `--video`, None without one.

  Raises:
    ConfigError: the path is not writable, or `--camera` was passed without `--video`.
  """
  if video is None:
    if camera is not None:
      raise ConfigError(f"--camera={camera} needs --video=<file>.")
    return None
  path = Path(video).expanduser()
  need_file(path, ".mp4", f"--video={video}")
  return path


def need_camera(model: "mujoco.MjModel", name: str | None, option: str) -> None:
  """Raises UnknownNameError, which names the option, if the model lacks the camera; None is valid."""
  if name is not None and name not in (names := camera_names(model)):
    have = ", ".join(names) or "none"
    raise UnknownNameError(f"{option}={name} is no camera of the model; it has {have}.{nearest(name, names)}")


def camera_names(model: "mujoco.MjModel") -> list[str]:
  """Returns the names of the model's cameras."""
  return [name for i in range(model.ncam) if (name := model.camera(i).name)]


def frame_stride(dt: float) -> int:
  """Returns the rows of `qpos` per frame, so that playback is real time at no more than `MAX_FPS`."""
  return max(1, math.ceil(1 / (MAX_FPS * dt) - 1e-6))


def _pack(mj_model: "mujoco.MjModel", qpos: np.ndarray, **arrays: Any) -> bytes:
  """Packs a trajectory `qpos` [T, nq], its model and other arrays that are not None as the bytes of an .npz file."""
  import mujoco

  qpos = np.asarray(qpos)
  if qpos.ndim != 2 or qpos.shape[1] != mj_model.nq:
    raise ValueError(f"qpos must have shape [T, {mj_model.nq}], not {list(qpos.shape)}")
  model = np.empty(mujoco.mj_sizeModel(mj_model), np.uint8)
  mujoco.mj_saveModel(mj_model, None, model)
  file = io.BytesIO()
  np.savez_compressed(file, qpos=qpos, model=model, **{k: v for k, v in arrays.items() if v is not None})
  return file.getvalue()


def _work(out_path: Path, scratch: Path, pipe: int) -> None:
  """Renders the video in the child's scratch folder, then copies it to its path."""
  scratch.mkdir(mode=0o700)
  threading.Thread(target=_end_with_parent, args=(scratch, pipe), daemon=True).start()
  try:
    os.chdir(scratch)  # logs of MuJoCo, and files of a killed encoder, are removed with the folder
    rendered = scratch / "video.mp4"
    _render(io.BytesIO(sys.stdin.buffer.read()), rendered)
    out_path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(out_path) as temporary:
      shutil.copyfile(rendered, temporary)
  finally:
    shutil.rmtree(scratch, ignore_errors=True)


def _end_with_parent(scratch: Path, pipe: int) -> None:
  """Waits until the parent has died, then removes the scratch folder and ends with the encoder."""
  os.read(pipe, 1)  # returns when the other end is closed
  for _ in range(_TRIES):
    if not scratch.exists():
      break
    shutil.rmtree(scratch, ignore_errors=True)  # fails where the encoder makes a file meanwhile
  os.killpg(0, signal.SIGKILL)


def _render(trajectory: io.BytesIO, out_path: Path) -> None:
  """Renders a trajectory and encodes it as MP4."""
  import imageio_ffmpeg
  import mujoco

  saved = np.load(trajectory)
  model = mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": saved["model"].tobytes()})
  data = mujoco.MjData(model)
  width, height, dt = int(saved["width"]), int(saved["height"]), float(saved["dt"])
  camera = choose_camera(model, str(saved["camera"]) if "camera" in saved else None)
  finite = np.isfinite(saved["qpos"]).all(axis=1)
  length = len(finite) if finite.all() else int(finite.argmin())
  if length == 0:
    raise PlaygroundError("the trajectory has no finite state to draw.")
  model.vis.global_.offwidth = max(width, model.vis.global_.offwidth)
  model.vis.global_.offheight = max(height, model.vis.global_.offheight)
  # Measured without a GPU, 640x480: 18 ms a frame instead of 30 at MuJoCo's 4096, and no visible difference.
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


def enlarged(image: np.ndarray, height: int) -> np.ndarray:
  """Enlarges an image [H, W, 1 or 3] to `height` rows and an even width, [height, width, 3], without smoothing."""
  rows, columns = image.shape[:2]
  width = 2 * max(1, round(height * columns / rows / 2))
  image = image[np.arange(height)[:, None] * rows // height, np.arange(width) * columns // width]
  return np.broadcast_to(image, (height, width, 3))


def choose_camera(model: "mujoco.MjModel", name: str | None = None) -> "str | mujoco.MjvCamera":
  """Returns the named camera, or the model's best one for videos."""
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


def follow(view: "mujoco.MjvCamera", model: "mujoco.MjModel") -> None:
  """Makes a free camera (an MjvCamera) follow a robot that walks; others stay fixed."""
  import mujoco

  if walks(model):
    view.type, view.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, model.jnt_bodyid[0]
    view.distance = min(view.distance, 3.0)  # terrain makes the model's extent, and so the default, huge


def walks(model: "mujoco.MjModel") -> bool:
  """Returns whether the first body is a walking robot, which may leave the image, and not a free object on a table."""
  import mujoco

  roots = [model.body_rootid[b] for b in model.jnt_bodyid]
  return bool(roots) and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE and roots.count(roots[0]) > 1


if __name__ == "__main__":
  try:
    _work(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))
  except Exception as error:  # the parent shows the last line
    sys.exit(first_line(error))
