"""Watching a policy: commands and pushes of the watcher, and episodes that begin anew."""

import contextlib
import signal
import threading
import time
from collections.abc import Iterator, Mapping
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import mujoco.viewer
import numpy as np
import pytest

from playground.deploy.player import Player
from playground.deploy.viewer import view
from playground.envs.base import State
from playground.envs.c_physics import on_c_physics
from playground.physics.backend import PhysicsData
from playground.registry import load
from tests.dummy import Point

NO_ACTION: Any = SimpleNamespace(actions=lambda obs: np.zeros(2))


class Commanded(Point):
  """Shows the command and the force that reached it; draws a command of its own, 7, in each step."""

  mj_model: Any = SimpleNamespace(nbody=1)  # pyright: ignore[reportIncompatibleVariableOverride]

  def reset(self, rng: jax.Array, model: Any = None) -> State:
    state = super().reset(rng)
    data = state.data.replace(xfrc_applied=jnp.zeros((1, 6)))
    return state.replace(data=data, info=state.info | {"command": jnp.zeros(3)})

  def post_step(self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array) -> State:
    state = super().post_step(data, info, action)
    return state.replace(
      reward=info["command"][0],
      metrics={"force": data.xfrc_applied[0, 0]},
      info=state.info | {"command": jnp.full(3, 7.0)},
    )


def test_what_the_watcher_asks_for() -> None:
  player = Player(Commanded(episode_length=4), NO_ACTION)
  assert player.takes_commands and player.period == 0.1
  assert player.policy_step().reward == 0
  assert player.policy_step().reward == 7  # the task's own
  player.command, player.force[0, 0] = np.array([0.5, 0, 0]), 20.0
  state = player.policy_step()
  assert (state.reward, state.metrics["force"]) == (0.5, 20)
  assert player.episode_return == 7.5
  player.command, player.force[0, 0] = None, 0.0
  assert (player.policy_step().reward, player.state.metrics["force"]) == (7, 0)
  player.policy_step()  # of the next episode
  assert (player.state.info["age"], player.episode_return) == (1, 0)


class Pushed(Commanded):
  """Its event adds a force on the body in each step, as those that push by force do."""

  def pre_step(self, state: State) -> State:
    return state.replace(data=state.data.replace(xfrc_applied=state.data.xfrc_applied.at[0, :3].add(5.0)))


def test_the_watchers_force_is_added_to_the_tasks() -> None:
  player = Player(Pushed(), NO_ACTION)
  assert player.policy_step().metrics["force"] == 5
  player.force[0, 0] = 20.0
  assert [player.policy_step().metrics["force"] for _ in range(2)] == [25, 25]


def test_nothing_is_earned_after_an_end(monkeypatch: pytest.MonkeyPatch) -> None:
  step = Commanded.post_step
  monkeypatch.setattr(Commanded, "post_step", lambda *args: step(*args).replace(done=jnp.ones(())))
  assert Player(Commanded(action_repeat=4), NO_ACTION).policy_step().info["age"] == 1


def test_an_episode_that_breaks_begins_anew() -> None:
  player = Player(Commanded(nan_at=2), NO_ACTION)
  player.policy_step()
  assert np.isnan(player.policy_step().data.qpos).all()
  assert np.isfinite(player.policy_step().data.qpos).all() and player.state.info["age"] == 1


@pytest.mark.parametrize(
  "task, followed, open_until", [("CartpoleBalance", False, None), ("Go1JoystickFlatTerrain", True, 3)]
)
def test_the_viewer_shows_the_policy(
  task: str, followed: bool, open_until: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
  """Until its window is closed, or ctrl+c."""
  env = on_c_physics(load(task))
  shown: list[np.ndarray] = []
  keys: list[Any] = []
  data_of_window: list[mujoco.MjData] = []
  camera = mujoco.MjvCamera()
  drawing = threading.Thread(target=time.sleep, args=(0.5,))  # as MuJoCo's does, for a while after its window is closed

  def sync() -> None:
    shown.append(data_of_window[0].qpos.copy())
    if open_until is None and len(shown) == 3:
      signal.raise_signal(signal.SIGINT)

  @contextlib.contextmanager
  def window(model: mujoco.MjModel, data: mujoco.MjData, key_callback: Any) -> Iterator[Any]:
    assert model is env.mj_model
    keys.append(key_callback)
    data_of_window.append(data)
    yield SimpleNamespace(
      is_running=lambda: open_until is None or len(shown) < open_until,
      lock=contextlib.nullcontext,
      cam=camera,
      perturb=mujoco.MjvPerturb(),
      sync=sync,
    )
    drawing.start()

  monkeypatch.setattr(mujoco.viewer, "launch_passive", window)
  full: Any = SimpleNamespace(actions=lambda obs: np.ones(env.action_size))
  view(env, full, 0)
  assert not drawing.is_alive()
  assert len(shown) == 3 and not np.array_equal(shown[0], shown[2])
  assert followed or shown[0][0] < shown[1][0] < shown[2][0]  # the cart drives off
  assert (camera.type == mujoco.mjtCamera.mjCAMERA_TRACKING) == followed
  keys[0](265)  # a command, also to a task that takes none
