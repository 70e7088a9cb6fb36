"""Our curves beside public ones: at equal steps, below first, each way to act by its name."""

from pathlib import Path

import pytest

from playground.benchmark.report import public
from playground.benchmark.report.evidence import Evidence
from playground.benchmark.report.public import Curve, at, beside_public, our_best, public_curves
from playground.benchmark.report.sections import Notes
from playground.benchmark.schema import Table as Rows
from playground.config.files import task_names
from playground.reporting.page import Image, Table


@pytest.mark.parametrize(("steps", "expected"), [(9, None), (10, 1.0), (15, 2.0), (20, 3.0), (25, 5.0), (99, 7.0)])
def test_a_curve_is_read_between_its_points(steps: float, expected: float | None) -> None:
  assert at([(10, 1.0), (20, 3.0), (30, 7.0)], steps) == expected


def test_the_committed_curves() -> None:
  curves = public_curves()
  assert set(curves) <= set(task_names()) and len(curves) > 35
  by_name = {curve.label: curve for curve in curves["G1JoystickFlatTerrain"]}
  ppo = by_name["PPO (brax) with wall clock, mode"]
  assert at(ppo.points, 53_248_000) == 8.11
  assert {curve.actions for curve in curves["G1JoystickFlatTerrain"]} == {"mode", "sampled"}
  assert not {"PandaPickCube", "AlohaHandOver"} & set(curves), "episodes of another length"


def test_reppo_is_not_ppo() -> None:
  labels = [curve.label for curve in public_curves()["HumanoidWalk"] if public.is_ppo(curve)]
  assert any("brax" in label for label in labels) and not any(label.startswith("REPPO") for label in labels)


def runs(folder: Path) -> Evidence:
  rows = ["CheetahRun_ppo_s1,0,1,", "CheetahRun_ppo_s1,100,50,70", "CheetahRun_ppo_s2,100,40,90"]
  rows += ["CheetahRun_sac_s1,100,900,", "WalkerRun_ppo_s1,100,96,", "HopperHop_ppo_s1,100,-1,"]
  header = "run,step,eval/episode_reward,eval/mode/episode_reward"
  (folder / "curves.csv").write_text("\n".join([header, *rows]) + "\n")
  return Evidence([folder])


def test_the_best_of_each_algorithm_and_way_to_act(tmp_path: Path) -> None:
  best = our_best(runs(tmp_path), {})["CheetahRun"]
  assert {(curve.label, curve.actions, curve.points[-1][1]) for curve in best} == {
    ("ours: ppo_s1", "as set", 50), ("ours: ppo_s2", "mode", 90), ("ours: sac_s1", "as set", 900),
  }  # fmt: skip


def test_a_run_without_an_algorithm_in_its_name_is_not_ppo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  header = "run,step,eval/episode_reward,eval/mode/episode_reward"
  rows = ["CheetahRun_s1,100,60,", "CheetahRun_theirs_s1,100,10,", "CheetahRun_ppo_s1,100,50,"]
  (tmp_path / "curves.csv").write_text("\n".join([header, *rows]) + "\n")
  monkeypatch.setattr(public, "public_curves", lambda: {"CheetahRun": [Curve("PPO (some)", "mode", [(50, 100.0)])]})
  table = next(block for block in beside_public(Evidence([tmp_path]), Notes()) if isinstance(block, Table))
  assert [(row[1], row[7]) for row in table.rows] == [("ours: ppo_s1", "below"), ("ours: s1", "")]


def test_rows_have_their_algorithm_in_a_column(tmp_path: Path) -> None:
  rows = Rows(tmp_path / "rows.csv")
  shared = {"benchmark": "learning", "setting": "step=100", "quantity": "return", "value": 50.0}
  rows.add({**shared, "task": "CheetahRun", "agent": "sac", "who": "ours"})
  rows.add({**shared, "task": "WalkerRun", "agent": "ppo", "who": "playground 0.2.0"})
  best = our_best(Evidence([tmp_path]), {})
  assert {task: [curve.label for curve in curves] for task, curves in best.items()} == {"CheetahRun": ["ours: sac"]}


def test_a_run_that_trains_as_long_as_the_public_comes_first(tmp_path: Path) -> None:
  rows = ["WalkerRun_short_s1,50,900,", "WalkerRun_long_s1,100,300,", "WalkerRun_long_s2,100,200,"]
  header = "run,step,eval/episode_reward,eval/mode/episode_reward"
  (tmp_path / "curves.csv").write_text("\n".join([header, *rows]) + "\n")
  label = lambda start: our_best(Evidence([tmp_path]), {"WalkerRun": start})["WalkerRun"][0].label
  assert [label(start) for start in (50, 100, 101)] == ["ours: short_s1", "ours: long_s1", "ours: short_s1"]


def test_tasks_where_we_are_below_come_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  theirs = {
    task: [Curve("PPO (some)", "mode", [(50, 100.0)]), Curve("REPPO", "mode", [(900, 990.0)])]
    for task in ("CheetahRun", "WalkerRun")
  } | {"HopperHop": [Curve("PPO (some)", "mode", [(200, 5.0)])]}
  monkeypatch.setattr(public, "public_curves", lambda: theirs)
  blocks = list(beside_public(runs(tmp_path), Notes()))
  assert any(isinstance(block, Image) for block in blocks)
  table, settings = (block for block in blocks if isinstance(block, Table))
  assert [(row[0], row[2], row[5], row[6], row[7]) for row in table.rows] == [
    ("CheetahRun", "as set", "100.0 (PPO (some))", "0.50", "below"),
    ("CheetahRun", "mode", "100.0 (PPO (some))", "0.90", "below"),
    ("WalkerRun", "as set", "100.0 (PPO (some))", "0.96", ""),
    ("CheetahRun", "as set", "100.0 (PPO (some))", "9.00", ""),
    ("HopperHop", "as set", "none so early", "", ""),
  ]
  assert table.rows[0][8] == "990.0 (REPPO)"
  assert ["kengz/SLM-Lab", "on", "off", "sampled"] in [list(row[:4]) for row in settings.rows]


def test_without_runs_of_ours_there_is_no_section(tmp_path: Path) -> None:
  assert list(beside_public(Evidence([tmp_path]), Notes())) == []
