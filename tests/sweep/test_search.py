"""Optuna in place of every combination."""

import os
from pathlib import Path

import pandas as pd
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution

from playground.errors import ConfigError
from playground.sweep.folder import SweepDirectory
from playground.sweep.plan import plan, settings_of
from playground.sweep.search import distribution, first_values
from tests.sweep.helpers import output, run

LINE = ["env=CartpoleBalance", "seed=0", "agent.learning_rate=tag(log,interval(0.01,1))", "agent.num_envs=64,128"]
SEARCH = ["search=optuna", "search.trials=4", "search.parallel=2"]


@pytest.mark.parametrize(
  ("line", "expected"),
  [
    ("a=interval(0,1)", FloatDistribution(0, 1)),
    ("a=tag(log,interval(1e-4,1e-2))", FloatDistribution(1e-4, 1e-2, log=True)),
    ("a=int(interval(1,4))", IntDistribution(1, 4)),
    ("a=range(2,9,2)", IntDistribution(2, 8, step=2)),
    ("a=1,null,x", CategoricalDistribution(["1", "null", "x"])),
    ("a=choice([8],[8,8])", CategoricalDistribution(["[8]", "[8,8]"])),
  ],
)
def test_distributions(line: str, expected: BaseDistribution) -> None:
  assert distribution(OverridesParser.create().parse_override(line)) == expected


@pytest.mark.parametrize(
  ("lines", "message"),
  [
    (["a=glob(*)"], "a=glob(*): a search draws from"),
    (["a=shuffle(1,2)"], "a=shuffle(1,2): a search draws from"),  # another order in each process
    (["a=range(3,3)"], "a=range(3,3) has no values to draw from"),
    (["a=range(0.1,0.1,0.1)"], "a=range(0.1,0.1,0.1) has no values to draw from"),
    (["a=tag(log,interval(0,1))"], "a=tag(log,interval(0,1)): an interval needs ends"),
    (["seed=1"], "search=optuna needs something to draw"),
  ],
)
def test_what_cannot_be_drawn(lines: list[str], message: str) -> None:
  with pytest.raises(ConfigError) as caught:
    first_values(lines)
  assert str(caught.value).startswith(message)


def test_a_search_finds_and_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  """The stub's return is highest at a learning rate of 0.3."""
  monkeypatch.chdir(tmp_path)
  sweep, _ = plan([*LINE, *SEARCH, "sweep_dir=mine"])
  assert sweep.jobs == []
  assert run(sweep, *SEARCH, "search.trials=2") == 0
  assert len(SweepDirectory.open("mine").jobs) == 2
  os.truncate("mine/study.log", os.path.getsize("mine/study.log") - 10)  # as a kill or a full disk leaves it
  more = [*SEARCH, "search.sampler=random", "launcher.timeout=600"]
  sweep, _ = plan([*LINE, *more, "sweep_dir=mine"])
  assert run(sweep, *more) == 0
  saved = settings_of(SweepDirectory.open("mine"))  # for `playground sweep retry`
  assert (saved.resolved["search"]["sampler"], saved.launcher.timeout) == ("random", 600)
  table = pd.read_csv("mine/sweep.csv")
  assert len(table) == 4 and set(table["status"]) == {"finished"}
  rates = list(table["agent.learning_rate"])
  assert len(set(rates)) == 4 and 0.01 <= min(rates) <= max(rates) <= 1
  assert set(table["agent.num_envs"]) <= {64, 128}
  expected = [-((rate - 0.3) ** 2) for rate in rates]
  assert list(table["final_return"]) == pytest.approx(expected)
  assert f"Best of 4 trials: final_return {max(expected):g}" in output(sweep)


def test_nothing_to_draw_is_found_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.chdir(tmp_path)
  with pytest.raises(ConfigError, match="search=optuna needs something to draw"):
    plan(["seed=1", "search=optuna"])
  assert list(tmp_path.iterdir()) == []


def test_an_interval_of_a_whole_number_is_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.chdir(tmp_path)
  with pytest.raises(ConfigError, match=r"agent\.num_envs=.* has the wrong type"):
    plan(["env=CartpoleBalance", "agent.num_envs=interval(4,16)", "search=optuna"])
  assert list(tmp_path.iterdir()) == []
