"""A contract that somebody has changed: it works, or is refused in one sentence."""

import copy
import functools
import math
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import yaml

from playground import registry
from playground.cli import play
from playground.cli.main import main
from playground.config import compose
from tests.command import caller
from tests.deploy.untrained import UntrainedRun

GONE = object()
VALUES = [GONE, None, "text", "", -1, 0, 3, 2.5, 1e30, 10**30, math.nan, math.inf, True, [], ["x", None], {}, {1: 2}]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
  path = tmp_path_factory.mktemp("changes") / "run"
  UntrainedRun(path, "CartpoleBalance", "debug=fast", "env.episode_length=40").save(100)
  with pytest.MonkeyPatch.context() as patched:
    assert caller(patched, "playground", main)("export", str(path)) == 0
  return path / "export"


def places(node: Any, *path: Any) -> Iterator[tuple[Any, ...]]:
  """The ways to everything in nested mappings and lists."""
  if path:
    yield path
  entries = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
  for name, value in entries:
    yield from places(value, *path, name)


def changed(contract: dict[str, Any], path: tuple[Any, ...], value: Any) -> dict[str, Any]:
  contract = copy.deepcopy(contract)
  *way, last = path
  node = functools.reduce(lambda node, name: node[name], way, contract)
  if value is GONE:
    del node[last]
  else:
    node[last] = value
  return contract


def untraced(monkeypatch: pytest.MonkeyPatch) -> None:
  """Evaluations are traced and not compiled; what is composed from the same words is composed once."""
  make = play.make_evaluator

  def traced(*args: Any) -> Any:
    evaluate = make(*args)
    zeros = lambda shapes: jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes)
    return lambda *args: zeros(jax.eval_shape(evaluate, *args))

  composed = functools.cache(lambda *words: compose(words))
  monkeypatch.setattr(play, "make_evaluator", traced)
  monkeypatch.setattr(registry, "compose", lambda words: composed(*words))
  monkeypatch.setattr(play.configs, "compose", lambda words: composed(*words))


@pytest.mark.parametrize(("step", "each"), [(3, 1), pytest.param(1, 6, marks=pytest.mark.slow)])
def test_every_change_works_or_is_one_sentence(
  folder: Path, step: int, each: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  untraced(monkeypatch)
  command, policy = caller(monkeypatch, "playground", main), folder / "policy.yaml"
  contract, draw, codes = yaml.safe_load(policy.read_text()), random.Random(0), []
  contract["command"] = {"max": [1.0, 1.0, 1.0], "min": None}
  for path in list(places(contract))[::step]:
    for value in draw.sample(VALUES, each):
      policy.write_text(yaml.safe_dump(changed(contract, path, value)))
      what = f"{path} -> {'gone' if value is GONE else value!r}"
      try:
        codes.append(command("play", str(folder / "policy.onnx"), "--episodes", "1"))
      except Exception as error:
        raise AssertionError(what) from error
      lines = capsys.readouterr().err.splitlines()
      refused = len(lines) == 1 and lines[0].startswith("error: ") and len(lines[0]) < 1000
      assert codes[-1] == 0 or (codes[-1] == 2 and refused), (what, lines)
  least = 10 * each // step
  assert codes.count(0) > least and codes.count(2) > least
