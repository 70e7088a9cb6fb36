"""The gate: a slowed function fails it, the same function does not, on a busy machine too."""

import math
from pathlib import Path

import pytest

from playground.benchmark.gate import Limit, Options, judge, measure, run
from playground.benchmark.gate.checks import Pair
from playground.config.files import shipped
from playground.errors import ConfigError, UnknownNameError


def work(amount: int) -> None:
  sum(math.sqrt(i) for i in range(amount))


def pair(times: int) -> Pair:
  return lambda: work(times * 20_000), lambda: work(20_000)


def test_a_slowed_function_fails_and_the_same_one_does_not(capsys: pytest.CaptureFixture[str]):
  limits = {"some": Limit(measure(pair(2), 15), 1.5)}
  assert judge({"some": lambda: pair(2)}, limits, 15) == 0
  assert judge({"some": lambda: pair(6)}, limits, 15) == 1
  assert "slower than committed: some" in capsys.readouterr().err


def test_one_bad_moment_is_no_slowdown():
  turns = iter([1, 50, 50, 50] + 20 * [1])  # the first turn compiles
  unlucky: Pair = (lambda: work(next(turns) * 20_000), lambda: work(20_000))
  assert judge({"some": lambda: unlucky}, {"some": Limit(1.0, 2.0)}, 3) == 0


def test_the_committed_table_is_of_the_checks():
  from playground.benchmark.gate import _read
  from playground.benchmark.gate.checks import CHECKS

  limits = _read(shipped("benchmarks") / "gate.csv")
  assert set(limits) == set(CHECKS)
  assert all(limit.ratio > 0 and limit.tolerance > 1 for limit in limits.values())


def test_mistakes(tmp_path: Path):
  with pytest.raises(UnknownNameError, match="Did you mean 'ppo_update'"):
    run(Options(checks=("ppo_updat",)))
  with pytest.raises(ConfigError, match="cannot be read"):
    run(Options(table=str(tmp_path / "none.csv")))
  with pytest.raises(UnknownNameError, match="Did you mean 'ppo_update'"):
    run(Options(checks=("ppo_updat",), update=True, table=str(tmp_path / "none.csv")))  # may be new
  with pytest.raises(ConfigError, match="no committed ratio"):
    judge({"old": pytest.fail, "new": pytest.fail}, {"old": Limit(1.0, 1.5)}, 1)


@pytest.mark.parametrize(
  ("table", "message"),
  [
    ("check,ratio,tolerance\n", "holds no check"),
    ("a machine's name\n", "is not a table of the gate"),
    ("check,ratio,tolerance\nppo_update,2,nan\n", "ppo_update has ratio 2, tolerance nan"),
    ("check,ratio,tolerance\nppo_update,0,1.5\n", "ppo_update has ratio 0, tolerance 1.5"),
    ("check,ratio,tolerance\nppo_update,2\n", "cannot be read"),
  ],
)
def test_a_table_that_would_let_all_pass_is_refused(tmp_path: Path, table: str, message: str):
  path = tmp_path / "gate.csv"
  path.write_text(table)
  with pytest.raises(ConfigError, match=message):
    run(Options(table=str(path)))
  if "holds" not in message:
    with pytest.raises(ConfigError, match=message):
      run(Options(table=str(path), update=True, checks=("ppo_update",)))
  assert path.read_text() == table


@pytest.mark.slow
def test_a_slowed_task_fails(monkeypatch: pytest.MonkeyPatch):
  from playground.benchmark.gate.checks import env_step
  from playground.physics.backend import Physics

  limits = {"env_step": Limit(measure(env_step("CartpoleBalance", 256), 15), 1.5)}
  step = Physics.step
  twice = lambda self, model, data, ctrl, count: step(self, model, step(self, model, data, ctrl, count), ctrl, count)
  monkeypatch.setattr(Physics, "step", twice)
  assert judge({"env_step": lambda: env_step("CartpoleBalance", 256)}, limits, 15) == 1
