"""The scene as the browser draws it."""

import copy

import mujoco
import numpy as np
import viser
from mjviser import ViserMujocoScene

from playground.deploy.player import Player
from playground.rendering.video import walks

_NEAR = 2.5  # m, the largest distance of the camera from a robot that walks: a terrain makes the model's extent huge
_FROM = np.array([0.8, -0.8, 0.4])  # direction of the camera
_ZENITH, _HORIZON = (120, 160, 210), (232, 239, 247)  # colours of the sky
_FLOOR, _SQUARES = (205, 212, 222), (176, 186, 200)  # colours of the floor
_SIDE, _COUNT = 0.5, 80  # m, of a square of the floor; squares in a row
_BELOW = 0.01  # m, of the floor under its squares: nearer ones flicker
_APART = 0.06  # m, between the robot and the arrows above it
_ARROWS = {"commanded": (40, 160, 90), "actual": (40, 90, 200)}  # velocities, green and blue
_SHOWN_AT_FIRST = {"velocity": True, "contacts": False, "follow": True}


class View:
  """Draws a player. A robot that walks stays in the middle, and the ground moves below it.

  Attributes:
    shown: whether arrows of velocity and contacts are drawn, and whether the camera follows a robot that walks.
    scene: mjviser's, of the task that is drawn.
    arrows: of the commanded and the actual velocity, for a robot that takes commands.
    boxes: the controls of `shown`.
  """

  def __init__(self, server: viser.ViserServer):
    """Draws nothing yet."""
    self._server = server
    self._model: mujoco.MjModel | None = None
    self._folder: viser.GuiFolderHandle | None = None
    self.shown = dict(_SHOWN_AT_FIRST)

  def show(self, player: Player, qpos: np.ndarray) -> None:
    """Draws the player's scene with the joints at `qpos` [nq]."""
    if self._model is not player.env.mj_model:
      self._begin(player)
    scene, data, state = self.scene, self._data, player.state.data
    scene.show_contact_points = scene.show_contact_forces = self.shown["contacts"]
    scene.camera_tracking_enabled = self._walks and self.shown["follow"]
    data.qpos[:] = qpos
    for name in ("mocap_pos", "mocap_quat", "qvel", "ctrl"):
      getattr(data, name)[:] = getattr(state, name)
    (mujoco.mj_forward if self.shown["contacts"] else mujoco.mj_kinematics)(scene.mj_model, data)
    scene.update_from_mjdata(data)
    if self._floor is not None:
      step = 2 * _SIDE
      self._floor.position = (*(np.round(data.xpos[self._root, :2] / step) * step), self._floor.position[2])
    self._draw_velocity(player)

  def _begin(self, player: Player) -> None:
    model = self._model = player.env.mj_model
    self._server.scene.reset()
    self._server.scene.set_background_image(_sky())
    self.scene = ViserMujocoScene(self._server, copy.copy(model), num_envs=1)  # it changes the model's colours
    self._data = mujoco.MjData(self.scene.mj_model)
    self._walks = walks(model)
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    self._root = int(model.jnt_bodyid[free[0]]) if len(free) else 0
    self._floor = self._add_floor(model)
    self.arrows = {}
    if self._walks and player.takes_commands:
      self.arrows = {name: self._add_arrow(name, color) for name, color in _ARROWS.items()}
    self._add_controls()
    center = np.zeros(3) if self._walks else model.stat.center
    distance = 1.5 * model.stat.extent
    self._server.initial_camera.look_at = center
    self._server.initial_camera.position = center + (min(distance, _NEAR) if self._walks else distance) * _FROM

  def _add_floor(self, model: mujoco.MjModel) -> viser.MeshHandle | None:
    """Makes a plane of the world an opaque floor with squares; returns the squares, None without such a plane."""
    planes = np.flatnonzero((model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & (model.geom_bodyid == 0))
    if not len(planes):
      return None
    for plane in planes:  # the names that mjviser gives them
      grid = self._server.scene.get_handle_by_name(f"/fixed_bodies/world/{model.geom(plane).name or None}")
      if isinstance(grid, viser.GridHandle):
        grid.position = grid.position - np.array([0.0, 0.0, _BELOW])
        grid.plane_color, grid.plane_opacity, grid.cell_thickness, grid.section_thickness = _FLOOR, 1.0, 0.0, 0.0
    vertices, faces = _squares()
    return self._server.scene.add_mesh_simple(
      "/fixed_bodies/squares",
      vertices,
      faces,
      color=_SQUARES,
      cast_shadow=False,
      receive_shadow=0.3,
      side="double",
      position=(0.0, 0.0, float(model.geom_pos[planes[0], 2])),
    )

  def _add_arrow(self, name: str, color: tuple[int, int, int]) -> viser.ArrowsHandle:
    return self._server.scene.add_arrows(
      f"/velocity/{name}",
      np.zeros((1, 2, 3), np.float32),
      color,
      shaft_radius=0.012,
      head_radius=0.03,
      head_length=0.06,
    )

  def _draw_velocity(self, player: Player) -> None:
    """Moves the arrows: the commanded and the actual horizontal velocity, m per m/s, above the robot."""
    if not self.arrows:
      return
    root, data = self._root, self._data
    forward = data.xmat[root].reshape(3, 3)[:2, 0]
    forward = forward / max(float(np.linalg.norm(forward)), 1e-6)
    ahead, left = player.task_command[:2]
    commanded = ahead * forward + left * np.array([-forward[1], forward[0]])
    tail = np.zeros(3) if self.scene.camera_tracking_enabled else data.xpos[root].copy()
    tail[2] += (data.geom_xpos[:, 2] + self.scene.mj_model.geom_rbound)[self._moving].max() - data.xpos[root, 2]
    for name, velocity in (("commanded", commanded), ("actual", data.qvel[:2])):
      tail[2] += _APART
      self.arrows[name].visible = self.shown["velocity"]
      self.arrows[name].points = np.stack([tail, tail + np.append(velocity, 0.0)])[None].astype(np.float32)

  @property
  def _moving(self) -> np.ndarray:
    """Whether each geom belongs to the robot [ngeom]."""
    model = self.scene.mj_model
    return model.body_rootid[model.geom_bodyid] == model.body_rootid[self._root]

  def _add_controls(self) -> None:
    """Adds what can be shown and hidden; the geometry groups are mjviser's."""
    gui = self._server.gui
    if self._folder is not None:
      self._folder.remove()
    labels = {"contacts": "Contact points and forces"}
    labels |= {"follow": "Camera follows"} if self._walks else {}
    labels |= {"velocity": "Velocity (green: command)"} if self.arrows else {}
    self._folder = gui.add_folder("Show", expand_by_default=False)
    with self._folder:
      self.boxes = {name: self._add_box(name, label) for name, label in labels.items()}
      with gui.add_folder("Groups of geoms and sites", expand_by_default=False):
        self.scene.create_groups_gui()

  def _add_box(self, name: str, label: str) -> viser.GuiCheckboxHandle:
    box = self._server.gui.add_checkbox(label, self.shown[name])
    box.on_update(lambda _: self.shown.update({name: box.value}))
    return box


def _sky() -> np.ndarray:
  """An image that goes from the colour of the zenith to that of the horizon [256, 2, 3]."""
  share = np.clip(np.linspace(0, 2, 256), 0, 1)[:, None, None]
  return np.repeat((1 - share) * _ZENITH + share * _HORIZON, 2, axis=1).astype(np.uint8)


def _squares() -> tuple[np.ndarray, np.ndarray]:
  """Vertices and faces of every second square of a chessboard about the origin."""
  x, y = (axis.ravel() for axis in np.meshgrid(*[np.arange(-_COUNT // 2, _COUNT // 2)] * 2))
  corners = np.stack([x, y], -1)[(x + y) % 2 == 0][:, None] + np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
  vertices = np.pad(corners.reshape(-1, 2) * _SIDE, ((0, 0), (0, 1)))
  first = 4 * np.arange(len(corners))[:, None, None]
  return vertices, (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
