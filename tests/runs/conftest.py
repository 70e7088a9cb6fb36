"""Whole runs in this process: their compilation cache, what they refuse and what their loops begin and end with."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import pytest
from jax.experimental.compilation_cache import compilation_cache

from playground.cli.run import main
from playground.learning.loop import Loop
from playground.runs import train as train_module


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
  """One compilation cache for all runs of this module, those in this process included; empty at first."""
  folder = tmp_path_factory.mktemp("cache")
  before = jax.config.jax_compilation_cache_dir
  jax.config.update("jax_compilation_cache_dir", str(folder / "xla"))
  compilation_cache.reset_cache()
  yield folder
  jax.config.update("jax_compilation_cache_dir", before)
  compilation_cache.reset_cache()


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
  """Runs the command in this process: exit code 2 and one sentence, which it returns."""

  def run(*args: str) -> str:
    monkeypatch.setattr(sys, "argv", ["playground-run", *args])
    capsys.readouterr()
    with pytest.raises(SystemExit) as exit_:
      main()
    assert exit_.value.code == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    return lines[0]

  return run


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
  """For every run in this process: the update that its loop began after, the policy before and the policy after."""
  seen: list[Any] = []

  class Watched(Loop):
    def run(self, state: Any, update: int | None = None) -> tuple[Any, bool]:
      before = jax.device_get(self.trainer.policy(state))
      state, completed = super().run(state, update)
      seen.append((update, before, jax.device_get(self.trainer.policy(state))))
      return state, completed

  monkeypatch.setattr(train_module, "Loop", Watched)
  return seen
