"""What somebody watches from another thread or window: a player in time, and what the watcher asks for in between."""

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
_MOST_REQUESTS = 100  # that wait: whoever asks faster than the session acts is not heard


class Session:
  """A player that time passes for.

  One thread lets time pass. Others may set `paused`, `speed` and the player's command, and `ask` for the rest.

  Attributes:
    player: who acts; another takes its place when the terrain changes.
    trained: the run's policy that acts; None without a run.
    following: `LATEST` or `BEST` if that checkpoint is to act, as training goes on, None if the one that does.
    paused: whether time stands still.
    speed: simulated seconds in one.
    previous_qpos: the joints' positions at the decision before the last, [nq].
  """

  def __init__(
    self, env: Env, exported: ActingPolicy, seed: int, menu: Menu | None = None, following: str | None = LATEST
  ):
    """Starts an episode of a policy; `menu` holds the checkpoint that it is from, if a run is at hand."""
    self._seed = seed
    self.player = Player(env, exported, seed)
    self._menu = menu
    self.trained = menu.trained if menu else None
    self.following = following
    self.paused = False
    self.speed = 1.0
    self._requests: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
    self._tried: Path | None = None  # to follow: a checkpoint that cannot be read is said to be so once
    self._due = 0.0  # simulated seconds for which nothing has been decided yet
    self.previous_qpos = np.asarray(self.player.state.data.qpos)

  def ask(self, request: Callable[[], None]) -> None:
    """Has something done between two decisions, unless many requests wait already."""
    if self._requests.qsize() < _MOST_REQUESTS:
      self._requests.put(request)

  def carry_out(self) -> None:
    """Does what was asked for by now, up to the first that fails; raises PlaygroundError for that."""
    for _ in range(self._requests.qsize()):
      self._requests.get()()

  def advance(self, seconds: float) -> None:
    """Lets so much time pass at the chosen speed."""
    if self.paused:
      return
    self._due += seconds * self.speed
    while self._due >= self.player.period:
      self._due -= self.player.period
      self.previous_qpos = np.asarray(self.player.state.data.qpos)
      self.player.decide()
      if self.player.seconds <= self.player.period:  # of a new episode: nothing lies between it and the last
        self.previous_qpos = np.asarray(self.player.state.data.qpos)

  def step(self) -> None:
    """Lets the policy act once, and shows the state after it."""
    self.player.decide()
    self._begin()

  def qpos(self) -> np.ndarray:
    """The joints' positions at this instant, which lies between the last two decisions' [nq]."""
    model = self.player.env.mj_model
    now = np.asarray(self.player.state.data.qpos, float)
    pose, change = self.previous_qpos.astype(float), np.empty(model.nv)
    mujoco.mj_differentiatePos(model, change, 1.0, pose, now)
    mujoco.mj_integratePos(model, pose, change, min(1.0, self._due / self.player.period))
    return pose

  def reset(self) -> None:
    """Starts the next episode."""
    self.player.reset()
    self._begin()

  @property
  def terrain(self) -> str | None:
    """What the robot stands on, if the task lets that be chosen."""
    scene = self.player.env.config.get("scene")
    return scene.get("terrain") if hasattr(scene, "get") else None

  @property
  def push_speed(self) -> float:
    """The largest `velocity` of the task's interval event whose name begins with push, m/s; 3 without one."""
    events = self.player.env.config.get("events") or {}
    pushes = [event for name, event in events.items() if name.startswith("push") and event and event.mode == "interval"]
    return next((max(event.params.velocity) for event in pushes if "velocity" in (event.get("params") or {})), 3.0)

  def choose_terrain(self, name: str) -> None:
    """Builds the task on another terrain, which takes seconds; raises ConfigError if the task has none of it."""
    old = self.player
    config: Any = config_dict(old.env.config)
    config.scene.terrain = name
    env = load_on_c_physics(old.exported.contract["task"], config)
    self.player = Player(env, old.exported, self._seed)
    self.player.command = old.command
    self._begin()

  @property
  def acting(self) -> str:
    """Control steps trained of the policy that acts, in a chain behind its stage's name."""
    if self._menu is None or self.trained is None:
      return f"{self.player.exported.contract['origin']['steps']:,}"
    return self._menu.label(self.trained.checkpoint.path)

  def choices(self) -> dict[str, str | Path]:
    """What can be chosen to act, by label: `LATEST`, `BEST` if there is one, and checkpoints, newest last.

    The one that acts is among them, though gone. Empty without a run.
    """
    if self._menu is None or self.trained is None:
      return {}
    choices: dict[str, str | Path] = {LATEST: LATEST}
    if (best := self._menu.best()) is not None:
      choices[f"{BEST} ({self._menu.label(best)})"] = BEST
    checkpoints = self._menu.checkpoints(self.trained.checkpoint.path)
    return choices | {self._menu.label(path): path for path in checkpoints}

  def choose_checkpoint(self, choice: str | Path) -> None:
    """Lets one of `choices` act; raises CheckpointError if it is gone."""
    self.following, self._tried = None if isinstance(choice, Path) else choice, None
    if isinstance(choice, Path):
      self._act_as(choice)

  def follow(self) -> None:
    """Lets the newest or best checkpoint act, if that is asked for; raises CheckpointError if it cannot be read."""
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
    self.player.exported = export_policy(self.trained, self.player.state)

  def _begin(self) -> None:
    self._due = 0.0
    self.previous_qpos = np.asarray(self.player.state.data.qpos)
