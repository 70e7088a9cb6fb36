"""Finds an OpenGL backend that needs no display. Never imports mujoco: a broken GL library kills the process."""

import functools
import os
import subprocess
import sys

from playground.interpreter import PYTHON

NO_GL_REMEDY = (
  "No working OpenGL was found: install one (on Debian or Ubuntu `apt install libegl1` for EGL or "
  "`apt install libosmesa6` for software rendering), or name one that works in MUJOCO_GL."
)

_PROBE = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 16, 16) as renderer:
  renderer.update_scene(data)
  assert renderer.render().any()
"""
_ASKED = "PLAYGROUND_MUJOCO_GL"  # where `withhold_gl` stores the user's MUJOCO_GL
_OFF = ("disable", "disabled", "off", "false", "0")  # values that mean "no GL" to MuJoCo


def withhold_gl() -> None:
  """Stores the user's MUJOCO_GL for the child processes that render.

  A process that trains renders nothing, yet its `import mujoco` fails if MUJOCO_GL names a backend that is not
  installed.
  """
  if "MUJOCO_GL" in os.environ:
    os.environ[_ASKED] = os.environ.pop("MUJOCO_GL")


@functools.cache
def find_gl() -> str | None:
  """Returns a value of MUJOCO_GL with which MuJoCo renders here, or None; probed once per process, in subprocesses.

  The user's own MUJOCO_GL comes first (and `MUJOCO_GL=disable` means none). Then come EGL, OSMesa and, if there is a
  display, GLFW on Linux, and CGL (macOS) and GLFW elsewhere.
  """
  asked = os.environ.get("MUJOCO_GL", os.environ.get(_ASKED, "")).lower().strip()
  if asked in _OFF:
    return None
  linux = [asked, "egl", "osmesa", "glfw" if os.environ.get("DISPLAY") else ""]
  candidates = linux if sys.platform == "linux" else [asked, "cgl", "glfw"]
  return next((backend for backend in dict.fromkeys(candidates) if backend and works(backend)), None)


def works(backend: str, timeout_s: float = 60.0) -> bool:
  """Tests in a subprocess whether MuJoCo renders an image with this backend."""
  command = [*PYTHON, "-c", _PROBE]
  try:
    done = subprocess.run(command, env=gl_environment(backend), capture_output=True, timeout=timeout_s)
  except subprocess.TimeoutExpired:
    return False
  return done.returncode == 0


def gl_environment(backend: str) -> dict[str, str]:
  """Returns this process's environment for a child that renders with `backend`."""
  # MuJoCo sets PYOPENGL_PLATFORM itself and refuses one that contradicts MUJOCO_GL.
  return {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"} | {"MUJOCO_GL": backend}
