"""Draws the scene in the browser."""

import copy
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import viser
from mjviser import ViserMujocoScene
from mjviser.conversions import is_fixed_body, merge_geoms

from playground.deploy.player import Player
from playground.deploy.session import Session
from playground.rendering.video import camera_names, walks

_NEAR = 2.5  # m, the largest distance of the camera from a robot that walks: a terrain makes the model's extent huge
_FROM = np.array([0.8, -0.8, 0.4])  # direction of the camera
_UP = np.array([0.0, 0.0, 1.0])
_FIELD_OF_VIEW = np.radians(60)  # of the free camera, vertical
# Colours of zenith, horizon, and the floor's light and dark squares, on a light and on a dark page.
_COLORS = {
  False: ((120, 160, 210), (232, 239, 247), (205, 212, 222), (150, 162, 180)),
  True: ((14, 19, 30), (56, 66, 84), (66, 72, 84), (44, 50, 62)),
}
_SIDE, _COUNT = 0.5, 80  # m, of a square of the floor; squares in a row
_BELOW = 0.1  # m, from the squares down to mjviser's plane: a nearer one hides squares where the depth buffer is coarse
_APART = 0.06  # m, between the robot and the arrows above it
_ARROWS = {"commanded": (40, 160, 90), "actual": (40, 90, 200)}  # velocities, green and blue
_SHOWN_AT_FIRST = {"velocity": True, "contacts": False, "follow": True, "dark": False}
_MOST_ENVS = 9
_SPACING = 1.5  # m between robots that walk; others are as far apart as 1.5 times the model's extent
FREE = "free"  # the camera that the mouse moves


class View:
  """Draws a session. A walking robot stays in the middle of the view, and the ground moves below it.

  Attributes:
    shown: whether velocity arrows and contacts are drawn, the camera follows a walking robot, and the page is dark.
    scene: mjviser's scene of the task.
    squares: the floor's light and dark squares; none on a terrain.
    planes: mjviser's planes, below the squares.
    arrows: of the commanded and the actual velocity, for a robot that follows commands.
    boxes: the controls of `shown`.
    num_envs: the control of the number of environments.
    selected: the control of the environment, from 1 on, that is followed and plotted.
    camera: the control of the camera.
  """

  def __init__(self, server: viser.ViserServer, session: Session, tab: viser.GuiTabHandle):
    """Draws the scene, and adds the controls to `tab`."""
    self._server, self._session, self._tab = server, session, tab
    self._model: mujoco.MjModel | None = None
    self._folder: viser.GuiFolderHandle | None = None
    self.shown = dict(_SHOWN_AT_FIRST)
    with tab:
      self.num_envs = server.gui.add_slider("Environments", 1, _MOST_ENVS, 1, 1, hint="side by side")
      self.selected = server.gui.add_slider(
        "Selected", 1, _MOST_ENVS, 1, 1, hint="the one that is followed and plotted"
      )
    self.num_envs.on_update(lambda _: session.ask(self._set_num_envs))
    self.selected.on_update(lambda _: setattr(session, "selected", int(self.selected.value) - 1))
    self._set_num_envs()
    self._begin(session.player)

  def show(self) -> None:
    """Draws the session at this instant."""
    session, player = self._session, self._session.player
    if self._model is not player.env.mj_model or self.scene.num_envs != len(session.players):
      self._begin(player)
    scene, data = self.scene, self._data
    scene.show_contact_points = scene.show_contact_forces = self.shown["contacts"]
    scene.camera_tracking_enabled = self._walks and self.shown["follow"]
    scene.env_idx = session.players.index(player)
    places = self._places - self._places[scene.env_idx]
    arrays = self._arrays(session.players)
    for name in ("body_xpos", "mocap_pos"):
      arrays[name] += places[:, None]
    scene.update_from_arrays(**arrays)
    self._pose(player)
    for handle, position in self._copies:
      handle.batched_positions = np.delete(places, scene.env_idx, 0) + position
    step = 2 * _SIDE
    for squares in self.squares:
      squares.position = (*(np.round(data.xpos[self._root, :2] / step) * step), squares.position[2])
    self._draw_velocity(player)
    self._move_cameras()

  def next_camera(self) -> None:
    """Chooses the next camera of the menu."""
    options, now = self.camera.options, self.camera.value
    self.camera.value = options[(options.index(now) + 1) % len(options) if now in options else 0]

  @property
  def model_camera(self) -> str | None:
    """The chosen camera of the model; None for the free camera."""
    return None if self.camera.value not in camera_names(self.scene.mj_model) else self.camera.value

  def _set_num_envs(self) -> None:
    number = int(self.num_envs.value)
    self._session.set_num_envs(number)
    self.selected.visible, self.selected.max = number > 1, max(2, number)
    self.selected.value = min(self.selected.value, number)

  def _pose(self, player: Player) -> mujoco.MjData:
    """Returns MuJoCo's data of an environment at this instant, which the next call overwrites."""
    data, state = self._data, player.state.data
    data.qpos[:] = self._session.qpos(player)
    for name in ("mocap_pos", "mocap_quat", "qvel", "ctrl"):
      getattr(data, name)[:] = getattr(state, name)
    mujoco.mj_kinematics(self.scene.mj_model, data)
    return data

  def _arrays(self, players: Sequence[Player]) -> dict[str, Any]:
    """Returns the arguments of mjviser's `update_from_arrays`, a row for each environment."""
    rows: list[dict[str, np.ndarray]] = []
    for player in players:
      data = self._pose(player)
      row = {name: getattr(data, name).copy() for name in ("mocap_pos", "mocap_quat", "qpos", "qvel", "ctrl")}
      rows.append(row | {"body_xpos": data.xpos.copy(), "body_xmat": data.xmat.reshape(-1, 3, 3).copy()})
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}

  def _begin(self, player: Player) -> None:
    model, number = player.env.mj_model, len(self._session.players)
    fresh, self._model = self._model is not model, model
    self._server.scene.reset()
    self.scene = ViserMujocoScene(self._server, copy.copy(model), num_envs=number)  # it recolours geoms
    self._data = mujoco.MjData(self.scene.mj_model)
    self._walks = walks(model)
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    self._root = int(model.jnt_bodyid[free[0]]) if len(free) else 0
    self.squares: list[viser.MeshHandle] = []
    self.planes: list[viser.GridHandle] = []
    self._add_floor(model)
    self._places = np.zeros((number, 3))
    if not (model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD).any():  # on a terrain, robots stay at their own positions
      spacing = _SPACING if self._walks else 1.5 * model.stat.extent
      self._places[:, 1], self._places[:, 0] = spacing * np.array(np.divmod(np.arange(number), 3))
    self._copies = self._add_copies() if number > 1 else []
    self._paint()
    self.arrows = {}
    if self._walks and player.takes_commands:
      self.arrows = {name: self._add_arrow(name, color) for name, color in _ARROWS.items()}
    if fresh:
      self._add_controls()
    center = np.zeros(3) if self._walks else model.stat.center
    distance = 1.5 * model.stat.extent
    self._server.initial_camera.look_at = center
    self._server.initial_camera.position = center + (min(distance, _NEAR) if self._walks else distance) * _FROM

  def _add_floor(self, model: mujoco.MjModel) -> None:
    """Draws a plane of the world as light and dark squares, and makes mjviser's plane their background."""
    planes = np.flatnonzero((model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & (model.geom_bodyid == 0))
    for plane in planes:  # the names that mjviser gives them
      grid = self._server.scene.get_handle_by_name(f"/fixed_bodies/world/{model.geom(plane).name or None}")
      if isinstance(grid, viser.GridHandle):
        grid.position = grid.position - np.array([0.0, 0.0, _BELOW])
        grid.plane_opacity, grid.cell_thickness, grid.section_thickness, grid.shadow_opacity = 1.0, 0.0, 0.0, 0.0
        self.planes.append(grid)
    if len(planes):
      for odd in (False, True):
        squares = self._server.scene.add_mesh_simple(
          f"/fixed_bodies/squares/{'dark' if odd else 'light'}",
          *_squares(odd),
          cast_shadow=False,
          receive_shadow=0.3,
          side="double",
          position=(0.0, 0.0, float(model.geom_pos[planes[0], 2])),
        )
        self.squares.append(squares)

  def _add_copies(self) -> list[tuple[viser.BatchedGlbHandle, np.ndarray]]:
    """Draws the geoms fixed to the world for each further environment; mjviser draws them once.

    Returns:
      Handles, and their positions in an environment.
    """
    model, others = self.scene.mj_model, len(self._session.players) - 1
    mujoco.mj_kinematics(model, self._data)
    endless = np.isin(model.geom_type, (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD)))
    copies = []
    for geom, body in enumerate(model.geom_bodyid):
      shown = model.geom_rgba[geom, 3] > 0 and self.scene.geom_groups_visible[model.geom_group[geom]]
      if shown and is_fixed_body(model, body) and not endless[geom]:
        handle = self._server.scene.add_batched_meshes_trimesh(
          f"/fixed_bodies/copies/{geom}",
          merge_geoms(model, [geom]),
          batched_wxyzs=np.tile(self._data.xquat[body], (others, 1)),
          batched_positions=np.zeros((others, 3)),
          lod="off",
        )
        copies.append((handle, self._data.xpos[body].copy()))
    return copies

  def _paint(self) -> None:
    """Colours sky and floor, and the page's panels."""
    zenith, horizon, *floor = _COLORS[self.shown["dark"]]
    self._server.scene.set_background_image(_sky(zenith, horizon))
    for grid in self.planes:
      grid.plane_color = tuple(np.mean(floor, 0).astype(int).tolist())
    for squares, color in zip(self.squares, floor, strict=False):  # a scene without a plane has no squares
      squares.color = color
    dark = self.shown["dark"]
    self._server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium", dark_mode=dark)

  def _move_cameras(self) -> None:
    """Moves the browsers' cameras to the chosen camera of the model, and back to where they began."""
    name = self.model_camera
    if name is None and self._camera is None:
      return
    if name is None:
      start = self._server.initial_camera
      up, position, target, field_of_view = _UP, start.position, start.look_at, _FIELD_OF_VIEW
    else:
      camera = self.scene.mj_model.camera(name).id
      mujoco.mj_comPos(self.scene.mj_model, self._data)  # some cameras follow a centre of mass
      mujoco.mj_camlight(self.scene.mj_model, self._data)
      _, up, back = self._data.cam_xmat[camera].reshape(3, 3).T
      position = self._data.cam_xpos[camera] - (
        self._data.xpos[self._root] if self.scene.camera_tracking_enabled else 0
      )
      target, field_of_view = position - back, np.radians(self.scene.mj_model.cam_fovy[camera])
    for client in self._server.get_clients().values():
      if client.camera.update_timestamp:  # it has reported its pose
        client.camera.up_direction, client.camera.position = up, position
        client.camera.look_at, client.camera.fov = target, float(field_of_view)
    self._camera = name

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
    """Adds the menu of cameras and the boxes of `shown`; mjviser adds those of geom and site groups."""
    gui, model = self._server.gui, self.scene.mj_model
    if self._folder is not None:
      self._folder.remove()
    labels = {"dark": ("Dark", "colours of the page"), "contacts": ("Contacts", "points and forces")}
    labels |= {"follow": ("Follow", "the robot stays in the middle")} if self._walks else {}
    labels |= {"velocity": ("Velocity", "green: command, blue: actual")} if self.arrows else {}
    self._camera: str | None = None
    with self._tab:
      self._folder = gui.add_folder("Show")
    with self._folder:
      self.camera = gui.add_dropdown("Camera", (FREE, *camera_names(model)), hint="key C")
      self.boxes = {name: self._add_box(name, *label) for name, label in labels.items()}
      with gui.add_folder("Groups of geoms and sites", expand_by_default=False):
        self.scene.create_groups_gui()

  def _add_box(self, name: str, label: str, hint: str) -> viser.GuiCheckboxHandle:
    box = self._server.gui.add_checkbox(label, self.shown[name], hint=hint)
    box.on_update(lambda _: self._toggle(name, box.value))
    return box

  def _toggle(self, name: str, on: bool) -> None:
    self.shown[name] = on
    if name == "dark":
      self._session.ask(self._paint)


def _sky(zenith: tuple[int, int, int], horizon: tuple[int, int, int]) -> np.ndarray:
  """Returns an image [256, 2, 3] uint8 that fades from the zenith's colour to the horizon's."""
  share = np.clip(np.linspace(0, 2, 256), 0, 1)[:, None, None]
  return np.repeat((1 - share) * zenith + share * horizon, 2, axis=1).astype(np.uint8)


def _squares(odd: bool) -> tuple[np.ndarray, np.ndarray]:
  """Returns vertices [4N, 3] and faces [2N, 3] of a chessboard's even or odd squares about the origin."""
  x, y = (axis.ravel() for axis in np.meshgrid(*[np.arange(-_COUNT // 2, _COUNT // 2)] * 2))
  corners = np.stack([x, y], -1)[(x + y) % 2 == odd][:, None] + np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
  vertices = np.pad(corners.reshape(-1, 2) * _SIDE, ((0, 0), (0, 1)))
  first = 4 * np.arange(len(corners))[:, None, None]
  return vertices, (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
