"""Golden windows: inside is 0, outside is 1, and what is no window is one sentence."""

import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from playground.benchmark import golden
from playground.benchmark.golden import Golden, Options, judge, read, run
from playground.benchmark.jobs import Measurement
from playground.benchmark.schema import Table
from playground.config import compose
from playground.config.files import shipped
from playground.errors import ConfigError, PlaygroundError, UnknownNameError

FACTS = {"device": "CPU", "versions": "1"}
ONE = """
cpu:
  pole:
    run: [env=CartpoleBalance, debug=fast, hardware=cpu, tuned=null]
    metrics: {eval/episode_reward: [0, 20], eval/episode_length: [20, 20]}
    from: here
"""


def write(folder: Path, text: str = ONE) -> str:
  (folder / "golden.yaml").write_text(text)
  return str(folder / "golden.yaml")


def test_names_may_be_numbers(tmp_path: Path) -> None:
  path = write(tmp_path, ONE.replace("pole:", "1:"))
  assert list(read(Path(path))["cpu"]) == ["1"]


def test_the_committed_sets() -> None:
  sets = read(shipped("benchmarks") / "golden.yaml")
  assert set(sets) == {"cpu", "gpu"}
  agents = {text for each in sets["cpu"].values() for text in each.overrides if text.startswith("agent=")}
  assert agents == {"agent=ppo", "agent=sac", "agent=reppo", "agent=fast_td3", "agent=fast_sac"}
  assert len(sets["gpu"]) == 9


@pytest.mark.slow
def test_the_committed_runs_are_valid() -> None:
  for runs in read(shipped("benchmarks") / "golden.yaml").values():
    for each in runs.values():
      assert compose(each.overrides).agent_name


@pytest.mark.parametrize(
  ("found", "good"),
  [({"a": 1.0}, True), ({"a": 2.0}, True), ({"a": 2.1}, False), ({"a": 0.9}, False), ({"a": float("nan")}, False)],
)
def test_the_ends_of_a_window_are_in_it(found: Mapping[str, float], good: bool) -> None:
  assert judge(Golden("x", (), {"a": (1.0, 2.0)}, "here"), found) is good


def test_what_was_not_measured_is_not_good(capsys: pytest.CaptureFixture[str]) -> None:
  assert not judge(Golden("x", (), {"a": (1.0, 2.0)}, "here"), {})
  assert capsys.readouterr().out == "x: a not measured\n"


@pytest.mark.parametrize(("value", "ended", "code"), [(10.0, 0, 0), (30.0, 0, 1), (10.0, 3, 3), (None, 1, 1)])
def test_exit_codes(
  tmp_path: Path, monkeypatch: pytest.MonkeyPatch, value: float | None, ended: int, code: int
) -> None:
  def measure(jobs: Sequence[Measurement], table: Table, facts: Mapping[str, Any], plan: Options) -> int:
    (job,) = jobs
    shared: dict[str, Any] = {**job.columns, "quantity": "golden_metric"}
    for text in job.arguments["settings"] if value is not None else ():
      table.add({**shared, "setting": text, "value": 20 if "length" in text else value})
    return ended

  monkeypatch.setattr(golden, "probe", lambda *_: (1, FACTS))
  monkeypatch.setattr(golden, "run_jobs", measure)
  options = Options(table=write(tmp_path), out=str(tmp_path / "rows.csv"))
  assert run(options) == code
  monkeypatch.setattr(golden, "run_jobs", lambda *_: 0)
  assert run(options) == 1, "rows of an earlier start are not judged, where all is trained again"


def left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str = ONE, devices: int = 1, code: int = 0) -> bool:
  """Runs the set with `rerun=false` and returns whether it was trained, which writes a row for each metric."""
  trained = False

  def measure(jobs: Sequence[Measurement], table: Table, machine: Mapping[str, Any], plan: Options) -> int:
    nonlocal trained
    (job,) = jobs
    trained = job.left(table, machine["device"]) is not None
    for setting in job.arguments["settings"] if trained else ():
      table.add({**job.columns, "quantity": "golden_metric", "setting": setting, "value": 20})
    return 0

  monkeypatch.setattr(golden, "probe", lambda *_: (devices, FACTS))
  monkeypatch.setattr(golden, "run_jobs", measure)
  assert run(Options(table=write(tmp_path, text), out=str(tmp_path / "rows.csv"), rerun=False)) == code
  return trained


def test_rows_of_another_number_of_devices_are_of_another_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  assert [left(tmp_path, monkeypatch, devices=devices) for devices in (1, 1, 4, 4, 1)] == [
    True, False, True, False, False,
  ]  # fmt: skip


def test_a_metric_that_the_table_lacks_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  assert left(tmp_path, monkeypatch) and not left(tmp_path, monkeypatch)
  more = ONE.replace("metrics: {", "metrics: {eval/episode_fall: [0, 30], ")
  assert left(tmp_path, monkeypatch, more) and not left(tmp_path, monkeypatch, more)


def test_each_run_is_on_its_own_hardware(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  def probe(overrides: Sequence[str], gpus: Sequence[int]) -> tuple[int, dict[str, str]]:
    probed.append(compose(overrides).hardware.devices or 8)
    return probed[-1], {**FACTS, "device": f"device {len(probed)}"}

  def measure(jobs: Sequence[Measurement], table: Table, machine: Mapping[str, Any], plan: Options) -> int:
    found.extend((job.columns["device"], job.columns["devices"]) for job in jobs)
    return 1

  probed: list[int] = []
  found: list[tuple[str, str]] = []
  monkeypatch.setattr(golden, "probe", probe)
  monkeypatch.setattr(golden, "run_jobs", measure)
  entry = ONE.partition("cpu:\n")[2]
  others = entry.replace("pole:", "one:").replace("tuned=null", "tuned=null, ++hardware.devices=1")
  text = ONE + others + others.replace("one:", "same:")
  assert run(Options(table=write(tmp_path, text), out=str(tmp_path / "rows.csv"))) == 1
  assert probed == [8, 1]
  assert found == [("device 1", "8"), ("device 2", "1"), ("device 2", "1")]


def test_other_overrides_are_another_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  other = ONE.replace("tuned=null", "tuned=null, agent.learning_rate=1e-3")
  assert [left(tmp_path, monkeypatch, text) for text in (ONE, other, ONE)] == [True, True, False]


@pytest.mark.parametrize(
  ("text", "message"),
  [
    ("a", "must hold sets of runs"),
    ("cpu: {}", "must hold sets of runs"),
    ("cpu: [", "cannot be read"),
    pytest.param("[" * 100_000, "cannot be read: maximum recursion depth", id="deep"),
    ("cpu: 2026-02-30", "cannot be read"),
    (ONE.replace("    from: here\n", ""), "cpu.pole must have the keys run, metrics, from"),
    (ONE.replace("[0, 20]", "[20, 0]"), r"eval/episode_reward=\[20, 0\] must be two numbers"),
    (ONE.replace("[0, 20]", "[.nan, 0]"), "must be two numbers"),
    (ONE.replace("[0, 20]", "3"), "must be two numbers"),
    (ONE.replace("tuned=null", "agent.learning_rat=1"), "learning_rat"),
  ],
)
def test_mistakes_are_said_before_anything_runs(tmp_path: Path, text: str, message: str) -> None:
  with pytest.raises(PlaygroundError, match=message):
    run(Options(table=write(tmp_path, text)))


def test_unknown_names(tmp_path: Path) -> None:
  table = write(tmp_path)
  with pytest.raises(UnknownNameError, match="set: 'gpuu' is unknown"):
    run(Options(table=table, set="gpuu"))
  with pytest.raises(UnknownNameError, match="Did you mean 'pole'"):
    run(Options(table=table, only=("poles",)))
  with pytest.raises(ConfigError, match="cannot be read"):
    run(Options(table=str(tmp_path / "none.yaml")))


@pytest.mark.slow
@pytest.mark.parametrize(("window", "code"), [("[0, 20]", 0), ("[0, 1]", 1)])
def test_a_run(tmp_path: Path, window: str, code: int) -> None:
  table = write(tmp_path, ONE.replace("[0, 20]", window))
  command = [sys.executable, "-m", "playground.cli.bench", "golden", f"table={table}", f"out={tmp_path / 'rows.csv'}"]
  done = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[2])
  assert done.returncode == code, done.stdout + done.stderr
  assert "pole: eval/episode_length 20, window 20 to 20: ok" in done.stdout
  assert ("OUTSIDE (window from here)" in done.stdout) == bool(code)
