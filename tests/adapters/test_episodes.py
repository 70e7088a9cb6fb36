"""How the episodes end that other libraries see, and what is said without these libraries."""

import importlib
import re
import sys

import numpy as np
import pytest

from playground import registry
from playground.adapters.episodes import Episodes, Moment
from playground.errors import ConfigError
from tests.dummy import Point


def ends(monkeypatch: pytest.MonkeyPatch, env: Point, steps: int) -> list[Moment]:
  monkeypatch.setattr(registry, "load", lambda name, overrides=None: env)
  episodes = Episodes("Point", physics="mjx")
  episodes.reset(0)
  return [episodes.step(np.zeros(2)) for _ in range(steps)]


def test_a_failure_terminates(monkeypatch: pytest.MonkeyPatch) -> None:
  moments = ends(monkeypatch, Point(nan_at=3), 3)
  assert [moment.terminated for moment in moments] == [False, False, True]
  assert not any(moment.truncated for moment in moments)


def test_time_truncates_and_actions_are_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
  moments = ends(monkeypatch, Point(episode_length=4, action_repeat=2), 2)
  assert [moment.truncated for moment in moments] == [False, True]
  assert not any(moment.terminated for moment in moments)
  first = moments[0]
  assert isinstance(first.obs, dict) and first.obs["privileged_state"].shape == (4,)
  assert first.reward == pytest.approx(-first.metrics["distance"]), "both are of two control steps"


@pytest.mark.parametrize(
  ("adapter", "library", "needed"),
  [
    ("gym", "gymnasium", "gymnasium: pip install -e '.[gym]'"),
    ("dm", "dm_env", "dm-env: pip install -e '.[gym]'"),
    ("rsl_rl", "torch", "RSL-RL and torch: pip install -e '.[rsl-rl]'"),
  ],
)
def test_without_its_library_an_adapter_says_how_to_install_it(
  monkeypatch: pytest.MonkeyPatch, adapter: str, library: str, needed: str
) -> None:
  name = f"playground.adapters.{adapter}"
  monkeypatch.setitem(sys.modules, library, None)
  monkeypatch.delitem(sys.modules, name, raising=False)
  with pytest.raises(ConfigError, match=rf"^{re.escape(f'{name} needs {needed}')}"):
    importlib.import_module(name)
