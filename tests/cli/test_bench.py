"""`playground-bench`: what it says about mistakes, before anything is started."""

import sys
from pathlib import Path
from typing import Any

import pytest

from playground.benchmark import commands
from playground.cli.bench import main
from playground.errors import ConfigError
from tests.command import Command, caller


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Command:
  def started(*args: Any) -> None:
    raise AssertionError("a mistake must be found before a process is started")

  monkeypatch.setattr(commands, "probe", started)

  return caller(monkeypatch, "playground-bench", main)


@pytest.mark.parametrize(
  ("arguments", "message"),
  [
    (["throughputs"], "Did you mean 'throughput'?"),
    (["throughput"], "Name what to measure"),
    (["throughput", "suite=locomotions"], "Did you mean 'locomotion'?"),
    (["throughput", "tasks=CartpoleBalence"], "Did you mean 'CartpoleBalance'?"),
    (["throughput", "tasks=CheetahRun", "agent=pppo"], "Did you mean 'ppo'?"),
    (["throughput", "tasks=CheetahRun", "seed=5"], "Did you mean 'seeds'?"),
    (["throughput", "tasks=CheetahRun", "seeds=many"], "must be a whole number"),
    (["throughput", "tasks=CheetahRun", "workers=0"], "workers=0 must be a whole number from 1"),
    (["throughput", "tasks=CheetahRun", "agent.num_env=64"], "agent.num_env"),
    (["throughput", "tasks=CheetahRun", "seeds=0"], "seeds=0 must be a whole number from 1"),
    (["throughput", "tasks=CheetahRun", "seconds=-1"], "seconds=-1.0 must be a number above 0"),
    (["throughput", "tasks=CheetahRun", "seconds=inf"], "seconds=inf must be a number above 0"),
    (["throughput", "tasks=CheetahRun", "minutes=nan"], "minutes=nan must be a number above 0"),
    (["throughput", "tasks=CheetahRun", "gpus=[-1]"], "gpus=[-1] must be a list of whole numbers from 0"),
    (["throughput", "tasks=CheetahRun", "hardware.devices=2"], "hardware.devices= is no override of throughput"),
    (["throughput", "tasks=CheetahRun", "env.task=x"], "env.task=x is not of the form module:name"),
    (["throughput", "tasks=CartpoleBalance,CheetahRun", "env.swing_up=true"], "env.swing_up does not exist"),
    (["scaling", "tasks=CheetahRun", "num_envs="], "num_envs= is empty"),
    (["scaling", "tasks=CheetahRun", "num_envs=64,-4"], "num_envs=[64, -4] must be a list of whole numbers from 1"),
    (["topology", "tasks=CheetahRun", "devices=0"], "devices=[0] must be a list of whole numbers from 1"),
    (["topology", "tasks=CheetahRun", "hyperparameters="], "hyperparameters= is empty"),
    (["compare", "tasks=CheetahRun", "repeats=0"], "repeats=0 must be a whole number from 1"),
    (["learning", "tasks=CheetahRun", "backends=jax,cuda"], "backends=cuda does not exist: choose from jax, warp"),
    (["startup", "tasks=CheetahRun", "workers=2"], "wants the machine to itself"),
    (["topology", "tasks=CheetahRun", "hyperparameters=doubled"], "must be fixed, scaled or both"),
    (["chain", "experiment=go1_joystick"], "is no chain"),
    (["chain", f"runs={__file__}/runs"], "test_bench.py is not a folder that you may write to"),
    (["compare", "tasks=CheetahRun", "peer=playground021"], "Did you mean 'playground020'?"),
    (["compare", "tasks=CheetahRun", "peer_python=no_such_python"], "cannot be run"),
    (["compare", "tasks=CheetahRun", f"peer_python={sys.executable}"], "it has none: install it there, or name"),
    (["compare", "tasks=CheetahRun", "agent=sac"], "compare is of ppo"),
    (["learning", "tasks=CheetahRun", "peer_menagerie=no_such_folder"], "holds no robot models"),
    (["record"], "Name what to record: runs=<run directory>"),
    (["record", "runs=no_such_run"], "No run directory at no_such_run"),
    (["record", "runs=a", "episodes=0"], "episodes=0 must be a whole number from 1"),
    (["report", "rows=no_such_folder"], "rows=no_such_folder is not a folder"),
  ],
)
def test_a_mistake_is_one_sentence(
  command: Command, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
):
  assert command(*arguments) == 2
  captured = capsys.readouterr()
  assert captured.err.startswith("error: ") and captured.err.count("\n") == 1
  assert message in captured.err


def test_help(command: Command, capsys: pytest.CaptureFixture[str]):
  assert command() == 0
  listed = capsys.readouterr().out
  assert all(name in listed for name in (*commands.COMMANDS, "report", "gate"))
  assert command("throughput", "--help") == 0
  assert "seeds=5" in capsys.readouterr().out


def test_what_does_not_fit_the_machine_or_the_task_is_said_before_anything_is_compiled():
  with pytest.raises(ConfigError, match=r"^devices=\[1, 4\]: this machine has 2\.$"):
    commands.Topology(tasks=("CartpoleBalance",), devices=(1, 4)).jobs(2)
  with pytest.raises(ConfigError, match=r"agent\.num_envs=3"):
    commands.Scaling(tasks=("CartpoleBalance",), num_envs=(3,)).jobs(1)
  commands.Startup(tasks=("CartpoleBalance",), overrides=("hardware.devices=1",)).check()


def test_what_does_not_fit_the_machine_is_all_that_is_said(
  command: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
  monkeypatch.setattr(commands, "probe", lambda *_: (1, {"device": "a device", "versions": ""}))
  assert command("topology", "tasks=CartpoleBalance", "devices=4", f"out={tmp_path / 'rows.csv'}") == 2
  captured = capsys.readouterr()
  assert captured.out == "" and captured.err == "error: devices=[4]: this machine has 1.\n"


def test_commands_stand_for_jobs():
  throughput = commands.Throughput(suite="all", seeds=2).jobs(4)
  assert len(throughput) == len(set(map(str, throughput))) >= 40
  assert all(job.arguments["seeds"] == [1, 2] and not job.columns["setting"] for job in throughput)

  settings = [job.columns["setting"] for job in commands.Topology(tasks=("CartpoleBalance",)).jobs(4)]
  assert [text.split()[0] for text in settings] == [f"hardware.devices={n}" for n in (1, 2, 2, 4, 4)]
  assert settings[-1] == "hardware.devices=4 hardware.scale_envs=true"

  scaling = commands.Scaling(tasks=("CartpoleBalance",), num_envs=(1024, 65536)).jobs(4)
  assert [job.measure for job in scaling] == ["environment", "training"] * 2
  assert scaling[-1].columns["setting"] == "agent.num_envs=65536 agent.batch_size=2048"

  turns = commands.Compare(tasks=("CartpoleBalance",), repeats=2).jobs(4)
  assert [(job.measure, job.arguments["seeds"]) for job in turns] == [
    (who, [turn]) for turn in (1, 2) for who in ("training", "peer:rates", "peer:rates")
  ]
