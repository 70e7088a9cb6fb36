"""`playground tune-buffers`: random actions, a trained policy beside them, and what is refused. No physics."""

from typing import Any

import jax
import pytest

from playground import registry
from playground.cli import tune_buffers as command_module
from playground.cli.main import main
from playground.config import compose
from playground.physics.warp_buffer_sizes import BufferSizes
from tests.command import Command, caller

RUN = "results/somewhere"


class LoadedPolicy:
  task = "PandaPickCube"
  config = compose(["env=PandaPickCube", "env.success_distance=0.01", "env.njmax=200"])

  @staticmethod
  def act(obs: Any, key: jax.Array) -> jax.Array:
    raise NotImplementedError


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
  """What would have been measured: a policy needs more than random actions do."""
  asked: list[tuple[Any, ...]] = []

  def measure(build: Any, njmax: int, act: Any, envs: int, steps: int, **watch: Any) -> BufferSizes:
    asked.append((build({}).success_distance, act, envs, steps))
    return BufferSizes(19, 4.0, 1) if act is None else BufferSizes(49, 6.56, 4)

  monkeypatch.setattr(registry, "build", lambda config: config)
  monkeypatch.setattr(command_module, "wrap_for_training", lambda task: task)
  monkeypatch.setattr(command_module, "measure_buffers", measure)
  monkeypatch.setattr(command_module, "load_policy", lambda path: LoadedPolicy)
  return asked


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Command:
  monkeypatch.setenv("COLUMNS", "80")
  call = caller(monkeypatch, "playground", main)
  return lambda *args: call("tune-buffers", *args)


def rows(out: str) -> dict[str, list[str]]:
  """The numbers of the printed table by key."""
  lines = [[cell.strip() for cell in line.strip("│").split("│")] for line in out.splitlines() if "env.n" in line]
  return {key.removeprefix("env."): cells for key, *cells in lines}


def test_random_actions(command: Command, measured: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
  assert command("PandaPickCube", "env.success_distance=0.02", "--envs", "64", "--steps", "7") == 0
  assert measured == [(0.02, None, 64, 7)]
  config = registry.config("PandaPickCube")
  out = capsys.readouterr().out
  assert "PandaPickCube on Warp, 64 environments, 7 policy steps" in out
  assert rows(out) == {
    "njmax": ["19", "24", str(config.njmax)],
    "naconmax_per_env": ["4.00", "5", str(config.naconmax_per_env)],
    "naccdmax_per_env": ["1", "2", "null"],
  }


def test_a_policy_beside_them(command: Command, measured: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
  assert command("PandaPickCube", "--run", RUN) == 0
  assert [asked[:2] for asked in measured] == [(0.01, None), (0.01, LoadedPolicy.act)], "the task as the run had it"
  assert rows(capsys.readouterr().out) == {
    "njmax": ["19", "49", "64", "200"],
    "naconmax_per_env": ["4.00", "6.56", "9", "24"],
    "naccdmax_per_env": ["1", "4", "5", "null"],
  }
  assert command("PandaPickCube", "env.success_distance=0.02", "--run", RUN) == 0
  assert [asked[0] for asked in measured[2:]] == [0.02, 0.02]


@pytest.mark.slow  # compiles Warp's kernels for the CPU: half a minute
def test_a_real_task_shows_progress_apart_from_its_result(command: Command, capsys: pytest.CaptureFixture[str]) -> None:
  pytest.importorskip("warp")
  assert command("CartpoleBalance", "--envs", "4", "--steps", "10") == 0
  said = capsys.readouterr()
  assert rows(said.out)["njmax"] == ["0", "0", "2"]
  compiling, *steps = said.err.splitlines()
  assert compiling == "random policy: compiling with njmax=32 naconmax_per_env=32 naccdmax_per_env=1"
  assert "100.0 %  40/40 steps" in steps[-1]


@pytest.mark.parametrize(
  ("args", "why"),
  [
    (["PandaPickCub"], "Did you mean 'PandaPickCube'"),
    (["PandaPickCube", "--envs", "0"], "--envs=0 must be a whole number from 1 to"),
    (["PandaPickCube", "env.njmx=3"], "Did you mean 'env.njmax'"),
    (["PandaOpenCabinet", "--run", RUN], f"--run={RUN} is one of PandaPickCube, not of PandaOpenCabinet"),
  ],
)
def test_what_is_refused_before_anything_is_measured(
  command: Command, measured: list[Any], capsys: pytest.CaptureFixture[str], args: list[str], why: str
) -> None:
  assert command(*args) == 2
  (line,) = capsys.readouterr().err.splitlines()
  assert why in line and not measured
