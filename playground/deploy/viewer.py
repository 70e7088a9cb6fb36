"""Shows a policy in MuJoCo's native viewer, with pushes by mouse and commands by arrow keys."""

import os
import queue
import sys
import threading
import time
import warnings

import numpy as np

from playground.deploy.player import STEP, Player
from playground.deploy.policy import ActingPolicy
from playground.envs.base import Env
from playground.errors import HardwareError
from playground.rendering.video import follow
from playground.runs.interrupts import noted_signals

# GLFW's codes of the keys -> component of the command, direction.
_STEERING = {265: (0, 1), 264: (0, -1), 263: (2, 1), 262: (2, -1), ord(","): (1, 1), ord("."): (1, -1)}
_AUTOMATIC, _RESET = 259, 257  # backspace, enter
_CLOSING = 5.0  # s for a window to close
_HELP = (
  "Keys: up and down go, left and right turn, comma and period go sideways, backspace: automatic commands, "
  "enter resets. Double-click a body, then hold ctrl and drag with the right button to push it."
)


def need_display() -> None:
  """Raises HardwareError if no window can be opened here."""
  if not sys.platform.startswith("linux"):
    return
  remedy = "use --video FILE, or the page in the browser"
  display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
  if not display:
    raise HardwareError(f"--viewer needs a display, and there is none here: {remedy}.")
  if not _opens_a_window():  # MuJoCo's viewer would wait forever
    raise HardwareError(f"--viewer cannot open a window on the display {display}: {remedy}.")


def _opens_a_window() -> bool:
  import glfw

  with warnings.catch_warnings(action="ignore"):
    try:
      if not glfw.init():
        return False
      glfw.window_hint(glfw.VISIBLE, glfw.FALSE)
      return bool(glfw.create_window(16, 16, "", None, None))
    finally:
      glfw.terminate()


def view(env: Env, exported: ActingPolicy, seed: int) -> None:
  """Shows a policy in real time until its window is closed, or until ctrl+c."""
  import mujoco.viewer

  player = Player(env, exported, seed)
  data = mujoco.MjData(env.mj_model)

  keys: queue.SimpleQueue[int] = queue.SimpleQueue()  # the window's thread adds to it, this one empties it

  def obey(key: int) -> None:
    if key == _RESET:
      player.reset()
    elif key == _AUTOMATIC:
      player.command = None
    elif key in _STEERING and player.takes_commands:
      component, sign = _STEERING[key]
      player.command = np.zeros(3) if player.command is None else player.command.copy()
      player.command[component] += sign * STEP
      print(f"command {np.round(player.command, 1).tolist()}", flush=True)

  print(_HELP, flush=True)
  others = set(threading.enumerate())
  with noted_signals() as ended, mujoco.viewer.launch_passive(env.mj_model, data, key_callback=keys.put) as window:
    with window.lock():
      follow(window.cam, env.mj_model)
    while window.is_running() and not ended.is_set():
      began = time.perf_counter()
      while not keys.empty():
        obey(keys.get())
      state = player.policy_step()
      with window.lock():
        for name in ("qpos", "mocap_pos", "mocap_quat"):
          getattr(data, name)[:] = getattr(state.data, name)
        mujoco.mj_forward(env.mj_model, data)
        data.xfrc_applied[:] = 0
        mujoco.mjv_applyPerturbForce(env.mj_model, data, window.perturb)
        player.force = data.xfrc_applied.astype(np.float32)
      window.sync()
      player.pause_until_due(began)
  for drawing in set(threading.enumerate()) - others:  # a process that ends before the window's thread may hang
    drawing.join(_CLOSING)
