"""Runs environments in real time for a viewer, and handles the viewer's requests between policy steps."""

import queue
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from playground.config import config_dict
from playground.deploy.menu import Menu
from playground.deploy.player import Player
from playground.deploy.policy import ActingPolicy
from playground.deploy.trained import export_policy, load_on_c_physics
from playground.envs.base import Env
from playground.learning.checkpoints import BEST

LATEST = "latest"
_MOST_REQUESTS = 100  # that may wait; further requests are dropped


class Session:
  """Steps environments of one task in real time.

  One thread calls `advance` and `carry_out`. Other threads may set `paused`, `speed` and `selected`, and `ask` for the
  rest.

  Attributes:
    players: the environments. Changing the terrain replaces all of them.
    selected: index of the environment that is plotted and followed.
    trained: the acting policy of a run; None without a run.
    following: `LATEST` or `BEST` to load that checkpoint when training writes it, None to keep the acting one.
    paused: whether time stands still.
    speed: simulated seconds per second.
    on_step: functions that are called with the selected environment after each of its policy steps.
  """

  def __init__(
    self,
    env: Env,
    exported: ActingPolicy,
    seed: int,
    menu: Menu | None = None,
    following: str | None = LATEST,
    model_seed: int | None = None,
  ):
    """Starts an episode of a policy.

    Args:
      env: the task.
      exported: the policy.
      seed: of the first environment's episodes.
      menu: lists the checkpoints of the policy's run; None without a run.
      following: see the attribute.
      model_seed: of the model on another terrain, as `load_on_c_physics` takes it.
    """
    self._seed, self._model_seed = seed, model_seed
    self.players = [Player(env, exported, seed)]
    self.selected = 0
    self._menu = menu
    self.trained = menu.trained if menu else None
    self.following = following
    self.paused = False
    self.speed = 1.0
    self.on_step: list[Callable[[Player], None]] = []
    self._requests: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
    self._tried: Path | None = None  # the last checkpoint followed; one that cannot be read is reported once
    self._due = 0.0  # simulated seconds since the last policy step

  @property
  def player(self) -> Player:
    """The selected environment."""
    return self.players[min(self.selected, len(self.players) - 1)]

  def set_num_envs(self, number: int) -> None:
    """Adds environments, each in a separate episode, or removes the last ones."""
    first, have = self.players[0], len(self.players)
    self.players = self.players[:number] + [first.copy(self._seed + i) for i in range(have, number)]

  def set_command(self, command: np.ndarray | None) -> None:
    """Sets the command of all environments, see `Player.command`."""
    for player in self.players:
      player.command = command

  def ask(self, request: Callable[[], None]) -> None:
    """Queues a function to call between two policy steps; drops it if the queue is full."""
    if self._requests.qsize() < _MOST_REQUESTS:
      self._requests.put(request)

  def carry_out(self) -> None:
    """Calls the queued functions up to the first that raises PlaygroundError, which it raises."""
    for _ in range(self._requests.qsize()):
      self._requests.get()()

  def advance(self, seconds: float) -> None:
    """Advances by `seconds * speed` simulated seconds, unless paused."""
    if self.paused:
      return
    self._due += seconds * self.speed
    while self._due >= self.player.period:
      self._due -= self.player.period
      self._policy_step()

  def step(self) -> None:
    """Advances by one policy step, and shows the state after it."""
    self._policy_step()
    self._show_present()

  def qpos(self, player: Player) -> np.ndarray:
    """Returns joint positions at this instant, interpolated between the last two policy steps, [nq]."""
    model = player.env.mj_model
    now = np.asarray(player.state.data.qpos, float)
    pose, change = player.previous_qpos.astype(float), np.empty(model.nv)
    mujoco.mj_differentiatePos(model, change, 1.0, pose, now)
    mujoco.mj_integratePos(model, pose, change, min(1.0, self._due / player.period))
    return pose

  def reset(self) -> None:
    """Starts the next episode of every environment."""
    for player in self.players:
      player.reset()
    self._show_present()

  def push(self, speed: float) -> None:
    """Pushes every environment's robot, see `Player.push`."""
    for player in self.players:
      player.push(speed)

  @property
  def terrain(self) -> str | None:
    """The terrain's name; None if the task has no choice of terrain."""
    scene = self.player.env.config.get("scene")
    return scene.get("terrain") if hasattr(scene, "get") else None

  @property
  def push_speed(self) -> float:
    """Returns the largest `velocity` of the interval event whose name begins with push, m/s; 3 without one."""
    events = self.player.env.config.get("events") or {}
    pushes = [event for name, event in events.items() if name.startswith("push") and event and event.mode == "interval"]
    return next((max(event.params.velocity) for event in pushes if "velocity" in (event.get("params") or {})), 3.0)

  def choose_terrain(self, name: str) -> None:
    """Builds the task on another terrain, which takes seconds; raises ConfigError if the task has no terrain."""
    old = self.player
    config: Any = config_dict(old.env.config)
    config.scene.terrain = name
    if config.scene.get("terrain_params"):
      config.scene.terrain_params = {}  # are of the other terrain
    env = load_on_c_physics(old.exported.contract["task"], config, model_seed=self._model_seed)
    number, self.players = len(self.players), [Player(env, old.exported, self._seed)]
    self.players[0].command, self.players[0].manual_action = old.command, old.manual_action
    self.set_num_envs(number)
    self._show_present()

  @property
  def acting(self) -> str:
    """Environment steps of the acting policy's training, after its stage's name in a curriculum."""
    if self._menu is None or self.trained is None:
      return f"{self.player.exported.contract['origin']['steps']:,}"
    return self._menu.label(self.trained.checkpoint.path)

  def choices(self) -> dict[str, str | Path]:
    """Returns the choices of `choose_checkpoint` by label: `LATEST`, `BEST` if there is one, checkpoints, newest last.

    The acting checkpoint is always included, even if it was deleted. Without a run there are no choices.
    """
    if self._menu is None or self.trained is None:
      return {}
    choices: dict[str, str | Path] = {LATEST: LATEST}
    if (best := self._menu.best()) is not None:
      choices[f"{BEST} ({self._menu.label(best)})"] = BEST
    checkpoints = self._menu.checkpoints(self.trained.checkpoint.path)
    return choices | {self._menu.label(path): path for path in checkpoints}

  def choose_checkpoint(self, choice: str | Path) -> None:
    """Changes the policy to one of `choices`; raises CheckpointError if it was deleted."""
    self.following, self._tried = None if isinstance(choice, Path) else choice, None
    if isinstance(choice, Path):
      self._act_as(choice)

  def follow(self) -> None:
    """Loads a new checkpoint that `following` selects; raises CheckpointError if the checkpoint is unreadable."""
    if self.following is None or self._menu is None:
      return
    wanted = self._menu.best() if self.following == BEST else self._menu.checkpoints()[-1]
    if wanted is not None and wanted != self._tried:
      self._tried = wanted
      self._act_as(wanted)

  def _act_as(self, path: Path) -> None:
    assert self.trained is not None
    if path == self.trained.checkpoint.path:
      return
    self.trained = self.trained.at(path)
    exported = export_policy(self.trained, self.player.state)
    for player in self.players:
      player.exported = exported

  def _policy_step(self) -> None:
    for player in self.players:
      player.policy_step()
    for function in self.on_step:
      function(self.player)

  def _show_present(self) -> None:
    """Shows the present states, without interpolation."""
    self._due = 0.0
    for player in self.players:
      player.show_present()
