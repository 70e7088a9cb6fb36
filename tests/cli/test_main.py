"""`playground`: list, show, and what the other commands hand over."""

import json
import re
import sys
import types
from pathlib import Path
from subprocess import run
from typing import Any

import pytest

from playground.catalog import entries
from playground.cli import list_tasks
from playground.cli.main import main
from playground.errors import CheckpointError, ConfigError
from playground.mdp import observations
from playground.text import millions
from tests.command import Command, caller


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Command:
  return caller(monkeypatch, "playground", main)


def _stub(monkeypatch: pytest.MonkeyPatch, module: str, name: str, result: Any) -> list[Any]:
  calls: list[Any] = []

  def function(*args: Any, **kwargs: Any) -> Any:
    calls.append((args, kwargs))
    if isinstance(result, Exception):
      raise result
    return result

  stub = types.ModuleType(module)
  setattr(stub, name, function)
  monkeypatch.setitem(sys.modules, module, stub)
  return calls


def test_list(command: Command, capsys: pytest.CaptureFixture[str]):
  assert command("list") == 0
  lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
  assert lines[0] == "task suite robot observation action backend agent budget status best run of ours"
  (line,) = (line for line in lines if line.startswith("CartpoleBalance "))
  best = entries()["CartpoleBalance"]
  shown = f"solved {best.best_return:.4g} ({best.best_run}, {millions(best.best_steps or 0)} M)"
  assert line.startswith(f"CartpoleBalance dm_control state 5 1 jax ppo 60 M {shown}")
  assert lines[-1].startswith(f"{len(lines) - 2} tasks.")
  assert command("list", "go1", "--suite", "locomotion", "--backend", "jax", "--json") == 0
  rows = json.loads(capsys.readouterr().out)
  assert {row["task"] for row in rows} == {"Go1Footstand", "Go1Handstand", "Go1JoystickFlatTerrain"}
  assert all(row["robot"] == "go1" for row in rows)
  assert command("list", "--suite", "locomotoin") == 2
  assert "--suite=locomotoin: choose from" in capsys.readouterr().err
  assert command("list", "--status", "open") == 0, "a status, whether a task has it or not"
  assert command("list", "--status", "opened") == 2
  assert "--status=opened: choose from learning, not measured, open, solved." in capsys.readouterr().err
  assert command("list", "cartpool") == 2
  assert "error: No task's name contains 'cartpool'" in capsys.readouterr().err


def test_a_task_of_another_package_that_does_not_compose_is_listed_with_the_reason(
  monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
  def compose(_: list[str]) -> None:
    raise ConfigError("The files of env=Broken do not compose: line 4.")

  monkeypatch.setattr(list_tasks, "compose", compose)
  assert list_tasks.list_tasks(["Broken", "CartpoleBalance"], {}, as_json=False) == 0
  out = capsys.readouterr().out
  assert "Broken: The files of env=Broken do not compose: line 4.\n2 tasks." in out and "dm_control" in out


def test_list_needs_no_jax():
  code = (
    "import sys; sys.argv = ['playground', 'list']; from playground.cli.main import main\n"
    "try: main()\nfinally: assert 'jax' not in sys.modules"
  )
  run([sys.executable, "-c", code], check=True, capture_output=True)  # a third of a second


@pytest.mark.parametrize(
  ("args", "shown"),
  [
    (
      [
        "Go1JoystickFlatTerrain",
        "env.observations.state.gyro.delay=[0,1]",
        "env.rewards.joint_deviation_l2.weight=-0.1",
      ],
      [
        *("robot go1", "Tracks commanded forward, sideways and turning velocity", "action 12 in [-1, 1]"),
        *("control 50 Hz (0.02 s)", "physics 250 Hz (0.004 s), 5 per control step", "backend auto: jax on CPU"),
        *("episode 1000 control steps (20 s)", "reward sum of the terms, clipped to [0.0, 10000.0]"),
        *(
          "state 48 linvel 3 uniform 0.1",
          "gyro 3 uniform 0.2 [0, 1] Angular velocity of the base",
          "privileged_state 123",
        ),
        "track_linear_velocity_exp 1 std 0.5 exp(-|command_xy - v_xy|² / std²)",
        "stand_still -1 command below 0.01 Sum |q - default| over the joints",
        *(
          "joint_deviation_l1 playground/mdp/rewards.py:",
          "joint_torques_norms -0.0002",
          "joint_deviation_l2 -0.1 Sum",
        ),
        *("fell_over limit 0.0 The world z of", "upvector_below playground/mdp/terminations.py:"),
        *("velocity max [1.5, 0.8, 1.2], resample_s 5.0", "VelocityWalk playground/mdp/commands.py:"),
        *("events (randomization: go1)", "payload startup body_mass trunk: add uniform(-1, 1) model_field"),
        "model_field playground/mdp/events.py:",
        *("reset_root_xy reset distance 0.5 Moves", "push interval no velocity [0.0, 3.0]"),
        *("ppo (tuned/ppo/Go1JoystickFlatTerrain.yaml)", "network.policy_hidden_layer_sizes [512, 256, 128]"),
      ],
    ),
    (
      ["CartpoleBalance", "env.impl=jax"],
      [
        *("state 5 cart_position 1", "upright Cartpole.reward playground/envs/dm_control/cartpole.py:", "backend jax"),
        *("nonfinite_state Some", "commands none events (randomization: none) none"),
      ],
    ),
    (
      ["PandaPickCubeCartesian"],
      ["gripper_pos 3 site gripper Position of a site", "site_pos playground/mdp/manipulators.py:"],
    ),
    (["CartpoleBalance", "env.impl=jax"], ["backend jax"]),
    (
      ["randomization=go1"],
      ["randomization: go1", "body_mass trunk: add uniform(-1, 1)", "geom_friction[:, 0] floor: set"],
    ),
    (["joystick", "robot=go1"], ["joystick", "robot go1", "ppo (tuned/ppo/joystick.yaml)"]),
  ],
)
def test_show(command: Command, capsys: pytest.CaptureFixture[str], args: list[str], shown: list[str]):
  assert command("show", *args) == 0
  out = " ".join(capsys.readouterr().out.split())
  for text in shown:
    assert text in out


def test_show_names_the_line_of_a_term_that_a_helper_makes(command: Command, capsys: pytest.CaptureFixture[str]):
  assert command("show", "Go1JoystickFlatTerrain") == 0
  out = capsys.readouterr().out
  lines = Path(observations.__file__).read_text(encoding="utf-8").splitlines()
  for name in ("gyro", "actuator_force", "last_contact"):
    (line,) = (i for i, text in enumerate(lines, 1) if text.startswith(f"{name} ="))
    assert re.search(rf"^ +{name} .* playground/mdp/observations\.py:{line} *$", out, re.M), name


@pytest.mark.parametrize(
  ("line", "message"),
  [
    ("show CartpoleBalance --num-views 2", "--num-views=2 needs --views=<file>."),
    ("play CartpoleBalance --port 9", "--port=9 is of the page in the browser, which this command does not show."),
    ("play CartpoleBalance --viewer --host ::", "--host=:: is of the page in the browser, which this command does not"),
    ("view CartpoleBalance --video a.mp4 --port 9", "--port=9 is of the page in the browser, which this command does"),
    ("play CartpoleBalance --web --episodes 3", "--episodes=3 are measured, and --web measures none."),
  ],
)
def test_options_that_do_nothing_are_refused(
  command: Command, capsys: pytest.CaptureFixture[str], line: str, message: str
) -> None:
  assert command(*line.split()) == 2
  assert capsys.readouterr().err.startswith(f"error: {message}")


def test_show_refuses(command: Command, capsys: pytest.CaptureFixture[str]):
  assert command("show", "CartpoleBalanc") == 2
  assert "Did you mean 'CartpoleBalance'?" in capsys.readouterr().err
  assert command("show", "Go1JoystickFlatTerrain", "randomization=g1") == 2
  assert command("show", "randomization=go1", "env=CartpoleBalance") == 2
  out, err = capsys.readouterr()
  assert "target 'left_foot_floor' is no pair of the model" in err and not out
  assert command("show", "randomization=go1", "--views", "views.png") == 2
  assert "--views shows a task: playground show <task> randomization=" in capsys.readouterr().err
  assert command("show", "randomization=go2") == 2
  assert "Did you mean 'go1'?" in capsys.readouterr().err


@pytest.mark.parametrize(
  ("args", "shown"),
  [
    (["agent", "agent=sac"], ["one of fast_sac, fast_td3, ppo,", "agent.num_envs 128 a whole number from 1"]),
    (["robot", "env=Go1Getup"], ["env.robot.root trunk body that is pushed", "env.robot.mjcf"]),
    (
      ["env.action_scale", "env=Go1Getup"],
      ["env.action_scale 0.5 a number or a list of numbers above 0", "Values are those of Go1Getup"],
    ),
    (["env.rewards", "env=Go1Getup"], ["factor on the function's value", "env.rewards.upright_exp"]),
    (["env.observations.privileged_state", "env=Go1JoystickFlatTerrain"], ["privileged_state.gyro"]),
    (
      ["env.commands.velocity.params", "env=Go1JoystickFlatTerrain"],
      ["params.max [1.5, 0.8, 1.2] largest command of each component", "params.min (null) smallest; None is -max."],
    ),
    (["robot"], ["robot=<option>: one of aero_hand,"]),
    (["launcher", "launcher=slurm"], ["one of local, ray, slurm", "launcher.partition"]),
    (["debug"], ["debug=<option>: one of fast, profile"]),
    (["visuals"], ["video.visuals primitives primitives, menagerie"]),
  ],
)
def test_keys(command: Command, capsys: pytest.CaptureFixture[str], args: list[str], shown: list[str]):
  assert command("keys", *args) == 0
  out = " ".join(capsys.readouterr().out.split())
  for text in shown:
    assert text in out


def test_an_unknown_command_is_answered_with_the_nearest(command: Command, capsys: pytest.CaptureFixture[str]):
  assert command("lst") == 2
  out, err = capsys.readouterr()
  assert not out and err.startswith("error: playground lst does not exist") and "Did you mean 'list'?" in err


@pytest.mark.parametrize("name", ["eval", "export", "play"])
def test_a_task_of_a_pretrained_policy_is_answered_with_the_nearest(
  command: Command, capsys: pytest.CaptureFixture[str], name: str
):
  assert command(name, "CartpolBalance") == 2
  said = "error: CartpolBalance is no run directory, checkpoint or task. Did you mean 'CartpoleBalance'?\n"
  assert capsys.readouterr().err == said


def test_keys_refuses(command: Command, capsys: pytest.CaptureFixture[str]):
  assert command("keys", "agnt") == 2
  assert "Did you mean 'agent'?" in capsys.readouterr().err
  assert command("keys", "env.rewards.foo") == 2
  assert "env.rewards.foo does not exist" in capsys.readouterr().err
  assert command("keys", "env.commands.velocty", "env=Go1JoystickFlatTerrain") == 2
  assert "its term is not one of the task's. Did you mean 'velocity'?" in capsys.readouterr().err
  assert command("keys", "env.vision.brightness.0") == 2
  assert "a key before 0 holds a value" in capsys.readouterr().err
  assert command("keys", ".") == 2
  assert capsys.readouterr().err.startswith("error: A section, a key or a group is missing: choose from ")


def test_doctor(command: Command, monkeypatch: pytest.MonkeyPatch):
  assert _stub(monkeypatch, "playground.cli.doctor", "doctor", 1) == []
  assert command("doctor") == 1


def test_eval_and_replay(command: Command, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
  calls = _stub(monkeypatch, "playground.cli.eval", "evaluate_run", 0)
  assert command("eval", "results/a", "--episodes", "4", "terrain=stairs") == 0
  options = {
    "overrides": ["terrain=stairs"],
    "episodes": 4,
    "seed": 0,
    "deterministic": False,
    "video": None,
    "camera": None,
  }
  assert calls == [((), {"path": "results/a", **options})]
  _stub(monkeypatch, "playground.cli.replay", "replay", CheckpointError("No dump\nthere."))
  assert command("replay", "dump.npz") == 2
  assert capsys.readouterr().err == "error: No dump there.\n"


@pytest.mark.parametrize(
  "args", [[], ["lst"], ["eval"], ["doctor", "env.impl=jax"], ["show", "CartpoleBalance", "--veiws"]]
)
def test_usage(command: Command, args: list[str]):
  assert command(*args) == 2
