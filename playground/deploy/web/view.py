"""The scene as the browser draws it."""

import copy

import mujoco
import numpy as np
import viser
from mjviser import ViserMujocoScene

from playground.deploy.player import Player
from playground.rendering.video import walks

_NEAR = 2.5  # m, at most, from which a robot that walks is looked at: a terrain makes the model's extent huge
_FROM = np.array([0.8, -0.8, 0.4])  # direction to look from


class View:
  """Draws a player. A robot that walks stays in the middle, and the ground moves below it."""

  def __init__(self, server: viser.ViserServer):
    """Draws nothing yet."""
    self._server = server
    self._model: mujoco.MjModel | None = None

  def show(self, player: Player, qpos: np.ndarray) -> None:
    """Draws the player's scene with the joints at `qpos` [nq]."""
    if self._model is not player.env.mj_model:
      self._begin(player.env.mj_model)
    self._data.qpos[:] = qpos
    for name in ("mocap_pos", "mocap_quat"):
      getattr(self._data, name)[:] = getattr(player.state.data, name)
    mujoco.mj_kinematics(self._scene.mj_model, self._data)
    self._scene.update_from_mjdata(self._data)

  def _begin(self, model: mujoco.MjModel) -> None:
    self._model = model
    self._server.scene.reset()
    self._scene = ViserMujocoScene(self._server, copy.copy(model), num_envs=1)  # it changes the model's colours
    self._data = mujoco.MjData(self._scene.mj_model)
    self._scene.camera_tracking_enabled = follows = walks(model)
    center = np.zeros(3) if follows else model.stat.center
    distance = 1.5 * model.stat.extent
    self._server.initial_camera.look_at = center
    self._server.initial_camera.position = center + (min(distance, _NEAR) if follows else distance) * _FROM
