"""`playground-run` with a bad value for every key: it says one sentence, or the task is built and can be compiled."""

import os
import re
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from playground.cli.run import main
from playground.config import compose
from playground.runs import train as train_module

BAD = ["null", "-1", "0", "inf", "nan", "1e39", "text", "[]", "{}", "true", "[2,1]", str(10**30)]
TASKS = ["CartpoleBalance", "Go1JoystickFlatTerrain", "LeapCubeReorient"]
AGENTS = ["ppo", "sac"]
NOT_KEYS = ("name", "choices", "curriculum.stages")  # `name` is the run's; stages are a chain's
SHARE = 97  # of the default suite: one case of so many


class CompilingBegins(Exception):
  """The run has been built: what follows is compiling it."""


def leaves(node: Any, key: str = "") -> Iterator[str]:
  """Dotted keys of all values; of lists that hold mappings, too."""
  entries = dict(enumerate(node)) if isinstance(node, list) and any(isinstance(x, Mapping) for x in node) else node
  if isinstance(entries, Mapping) and entries:
    for name, value in entries.items():
      yield from leaves(value, f"{key}.{name}" if key else str(name))
  elif not key.startswith(NOT_KEYS):
    yield key


@cache
def cases() -> list[tuple[str, ...]]:
  """Command lines: each key of three tasks and two agents, once, with each bad value."""
  found: dict[str, tuple[str, ...]] = {}
  for task in TASKS:
    for agent in AGENTS:
      chosen = (f"env={task}", f"agent={agent}")
      for key in leaves(compose([*chosen, "debug=fast"]).resolved):
        of = {"env": task, "agent": agent}.get(key.partition(".")[0], "")
        found.setdefault(f"{of} {key}", (*chosen, key))
  return [(*chosen, f"{key}={value}") for *chosen, key in found.values() for value in BAD]


@pytest.fixture(scope="module")
def built() -> Iterator[None]:
  """Stops each run where it would compile, with its task traced."""

  def stop(trainer: Any, evaluate: Any, draw: Any, *_: Any) -> None:
    env = trainer.env.unwrapped
    jax.eval_shape(draw)
    state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
    jax.eval_shape(env.step, state, jax.ShapeDtypeStruct((env.action_size,), jnp.float32))
    raise CompilingBegins

  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(train_module, "compile_program", stop)
    yield


def run(line: tuple[str, ...], folder: Path, patch: pytest.MonkeyPatch, capsys: Any) -> str | None:
  """What the command says when it refuses, None if it would begin to compile."""
  precision, folder_of_cache = jax.config.jax_default_matmul_precision, jax.config.jax_compilation_cache_dir
  environment = dict(os.environ)
  patch.chdir(folder)
  patch.setattr(sys, "argv", ["playground-run", "debug=fast", "hardware=cpu", *line])
  capsys.readouterr()
  try:
    main()
  except CompilingBegins:
    return None
  except SystemExit as exit_:
    out, err = capsys.readouterr()
    assert exit_.code == 2, out + err
    lines = err.splitlines()
    assert len(lines) == 1 and re.fullmatch(r"error: .+[.?]", lines[0]), err
    return lines[0]
  finally:
    os.environ.clear()
    os.environ.update(environment)
    jax.config.update("jax_default_matmul_precision", precision)
    jax.config.update("jax_compilation_cache_dir", folder_of_cache)
  raise AssertionError("the command returned")


def check(lines: list[tuple[str, ...]], folder: Path, patch: pytest.MonkeyPatch, capsys: Any) -> None:
  """Fails with all lines that end otherwise."""
  wrong, refused = [], 0
  for line in lines:
    try:
      refused += run(line, folder, patch, capsys) is not None
    except Exception as error:
      wrong.append(f"{' '.join(line)}: {type(error).__name__}: {str(error).strip()[:300]}")
  assert not wrong, "\n".join(wrong)
  assert refused > len(lines) / 2


def test_a_bad_value_is_one_sentence_or_builds(
  built: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  check(cases()[::SHARE], tmp_path, monkeypatch, capsys)


WERE_TRACEBACKS = [
  "env=Go1JoystickFlatTerrain env.commands.velocity.params.min=1",
  "env=Go1JoystickFlatTerrain env.commands.velocity.params.max=[-1,1,1]",
  "env=Go1JoystickFlatTerrain env.observations.state=[]",
  "env=Go1JoystickFlatTerrain env.observations.state.gravity.noise.uniform={}",
  "env=Go1JoystickFlatTerrain env.robot.feet=[]",
  "env=Go1JoystickFlatTerrain env.robot.foot_contact=[]",
  "env=Go1JoystickFlatTerrain env.robot.foot_contact=null",
  "env=Go1JoystickFlatTerrain env.robot.foot_contact=[[],[],[],[]]",
  "env=Go1JoystickFlatTerrain env.robot.feet=[FR,FR,RR,RL]",
  "env=Go1JoystickFlatTerrain env.robot.sensors.linvel=orientation",
  "env=Go1JoystickFlatTerrain env.robot.foot_linvel=[orientation,orientation,orientation,orientation]",
  "env=Go1JoystickFlatTerrain env.robot.mjcf=null",
  "env=Go1JoystickFlatTerrain env.robot.foot_linvel=[]",
  "env=Go1JoystickFlatTerrain env.robot.pose_weights=[2,1]",
  "env=LeapCubeReorient env.robot.sensors.fingertip_pos=[]",
]


@pytest.mark.parametrize("line", WERE_TRACEBACKS)
def test_what_was_a_traceback_is_one_sentence(
  line: str, built: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  task, override = line.split()
  said = run((task, override), tmp_path, monkeypatch, capsys)
  assert said is not None and override.split("=")[0] in said


@pytest.mark.slow
@pytest.mark.parametrize("part", range(SHARE))
def test_every_bad_value_is_one_sentence_or_builds(
  part: int, built: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  check(cases()[part::SHARE], tmp_path, monkeypatch, capsys)
