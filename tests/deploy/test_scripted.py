"""Zero and random actions on a task: `playground play --agent` and `playground view`."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from playground import registry
from playground.cli.main import main
from playground.config import compose
from playground.deploy.scripted import ScriptedPolicy
from playground.deploy.session import Session
from playground.deploy.trained import load_on_c_physics
from tests.command import Command, caller


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Command:
  return caller(monkeypatch, "playground", main)


def test_actions_of_a_batch() -> None:
  env = registry.load("CartpoleBalance")
  zero, random = (ScriptedPolicy(agent, "CartpoleBalance", env, 0) for agent in ("zero", "random"))
  obs = np.zeros((3, 2, 5))
  assert zero.actions(obs).shape == (3, 2, 1) and not zero.actions(obs).any()
  assert 0 < np.abs(random.actions(obs)).max() <= 1 and (random.actions(obs) != random.actions(obs)).any()


def test_a_command_of_any_name_has_its_range() -> None:
  walk = {"func": "uniform_velocity", "params": {"max": [1.0, 0.0, 0.5]}}
  env = registry.load("Go1JoystickFlatTerrain", overrides={"commands.velocity": None, "commands.walk": walk})
  assert ScriptedPolicy("zero", "Go1JoystickFlatTerrain", env, 0).contract["command"] == {"max": [1.0, 0.0, 0.5]}


def test_play_measures_a_task(command: Command, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: Any):
  monkeypatch.chdir(tmp_path)
  assert command("play", "CartpoleBalance", "--agent", "zero", "--episodes", "1") == 0
  assert "CartpoleBalance, 0 steps trained" in capsys.readouterr().out
  assert list(tmp_path.iterdir()) == []
  assert command("play", "CartpoleBalanc", "--agent", "zero") == 2
  assert "acts on a task, and CartpoleBalanc is none. Did you mean 'CartpoleBalance'?" in capsys.readouterr().err


def test_view_shows_it_in_the_browser(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
  sessions: list[Session] = []
  monkeypatch.setattr("playground.deploy.web.server.watch", lambda session, *_: sessions.append(session))
  assert command("view", "Go1JoystickFlatTerrain", "terrain=rough", "--no-events", "--port", "0") == 0
  (session,) = sessions
  assert session.terrain == "rough" and session.acting == "0" and session.choices() == {}
  assert session.player.exported.contract["command"]["max"] == [1.5, 0.8, 1.2]
  assert not session.player.env.config.events.push.enabled
  calm = load_on_c_physics("Go1JoystickFlatTerrain", registry.config("Go1JoystickFlatTerrain"), interval_events=False)
  assert not calm.config.events.push.enabled, "of a policy's task"
  section = compose(["env=Go1JoystickFlatTerrain", "terrain=rough"]).env
  drawn = load_on_c_physics("Go1JoystickFlatTerrain", section, model_seed=1)
  assert (session.player.env.mj_model.body_mass != drawn.mj_model.body_mass).any()


def test_a_robot_of_ones_own_is_viewed_as_it_is_trained(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
  sessions: list[Session] = []
  monkeypatch.setattr("playground.deploy.web.server.watch", lambda session, *_: sessions.append(session))
  assert command("view", "env=joystick", "robot=spot", "--port", "0") == 0
  (session,) = sessions
  assert session.player.exported.contract["task"] == "joystick" and session.player.env.config.robot.name == "spot"


@pytest.mark.parametrize(
  "line",
  [
    ["view", "CartpoleBalance", "env=CheetahRun", "--port", "0"],
    ["play", "CartpoleBalance", "env=CheetahRun", "--agent", "zero"],
    ["show", "env=CartpoleBalance", "env=CheetahRun"],
    ["tune-buffers", "CartpoleBalance", "env=CheetahRun"],
  ],
)
def test_a_second_task_is_refused(command: Command, capsys: pytest.CaptureFixture[str], line: list[str]) -> None:
  assert command(*line) == 2
  assert "env=CheetahRun is a second task: the command is about CartpoleBalance." in capsys.readouterr().err
