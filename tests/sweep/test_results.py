"""What a sweep's jobs come to: table, intervals, curves, page."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from playground.files import write_json
from playground.reporting import figures
from playground.sweep.folder import Job, SweepDirectory
from playground.sweep.report import collect, group, group_keys, mean_curve, write_result


@pytest.fixture
def sweep(tmp_path: Path) -> SweepDirectory:
  """Two agents, three seeds each, of which one failed; none of them drawn from anywhere but here."""
  jobs = [
    Job(f"{i:03d}", [f"agent={a}", f"seed={s}"], {"agent": a, "seed": s})
    for i, (a, s) in enumerate((a, s) for a in ("ppo", "sac<1>") for s in range(3))
  ]
  sweep = SweepDirectory.create(tmp_path / "sweep", "mine", ["playground-run", "-m", "<b>"], [], [], jobs)
  for job in jobs[:-1]:
    folder = sweep.folder(job)
    folder.write(status="finished", attempt=1)
    score = 10.0 * job.varies["seed"]
    write_json(folder.path / "summary.json", {"final_return": score, "best_return": score, "steps_per_second": 1000.0})
    rows = [f"{step},{score + step},{step / 7}" for step in (0, 50, 100)]
    (folder.path / "metrics.csv").write_text("\n".join(["step,eval/episode_reward,time/wall_clock_s", *rows]) + "\n")
  sweep.folder(jobs[-1]).write(status="failed", reason="exit code 1: a < b", attempt=2)
  return sweep


def test_groups_differ_in_all_but_the_seed(sweep: SweepDirectory) -> None:
  groups = group(collect(sweep), group_keys(sweep))
  assert list(groups["agent"]) == ["ppo", "sac<1>"]
  assert list(groups["jobs"]) == [3, 2]
  assert list(groups["final_return"]) == [10.0, 5.0]
  # t quantiles 0.975 for 2 and 1 degrees of freedom, from tables
  assert list(groups["final_return_ci95"]) == pytest.approx([4.3027 * 10 / 3**0.5, 12.7062 * 7.0711 / 2**0.5], rel=1e-4)
  assert list(groups["steps_per_second_ci95"]) == [0, 0]


def test_seeds_alone_are_one_group(tmp_path: Path) -> None:
  jobs = pd.DataFrame({"seed": [1, 2], "status": "finished", "final_return": [1.0, 3.0]})
  for name in ("final_mode_return", "best_return", "steps_per_second", "wall_clock_s"):
    jobs[name] = np.nan
  groups = group(jobs, [])
  assert (groups["jobs"][0], groups["final_return"][0]) == (2, 2.0)


def test_what_is_written(sweep: SweepDirectory) -> None:
  names = [path.relative_to(sweep.path).as_posix() for path in write_result(sweep, lambda text: None)]
  assert names == [
    *("sweep.csv", "groups.csv", "plots/curves_over_steps.png", "plots/curves_over_wall_clock.png", "report.html"),
  ]
  table = pd.read_csv(sweep.path / "sweep.csv")
  assert list(table["status"]) == ["finished"] * 5 + ["failed"]
  assert list(table["overrides"][:2]) == ["agent=ppo seed=0", "agent=ppo seed=1"]
  assert table["reason"].to_numpy()[-1] == "exit code 1: a < b"
  page = (sweep.path / "report.html").read_text()
  assert page.count("data:image/png;base64,") == 2
  assert not re.search(r'(src|href)="(http|plots|/)', page), "it needs nothing but itself"
  assert "sac&lt;1&gt;" in page and "a &lt; b" in page and "&lt;b&gt;" in page
  assert "5 finished, 1 failed" in page


def test_a_sweep_that_has_only_begun_has_a_result(tmp_path: Path) -> None:
  sweep = SweepDirectory.create(tmp_path, "mine", [], [], [], [Job("000", ["seed=1"], {"seed": 1})])
  write_result(sweep, lambda text: None)
  assert list(pd.read_csv(tmp_path / "sweep.csv")["status"]) == ["queued"]


def test_a_log_shows_the_whole_key_and_value(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
  jobs = [Job(value, [], {"env.rewards.action_rate_l2.weight": value}) for value in ("-0.000711", "-0.000712")]
  sweep = SweepDirectory.create(tmp_path, "mine", [], [], [], jobs)
  for job in jobs:
    sweep.folder(job).write(status="finished")
  write_result(sweep, lambda text: None)
  words = capsys.readouterr().out.split()
  assert {"env.rewards.action_rate_l2.weight", "-0.000711", "-0.000712"} <= set(words)


def test_a_list_of_texts_is_no_markup(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
  jobs = [Job(name, [], {"a.joints": f"[{name}]"}) for name in ("hip", "knee")]
  sweep = SweepDirectory.create(tmp_path, "mine", [], [], [], jobs)
  for job in jobs:
    sweep.folder(job).write(status="finished")
  write_result(sweep, lambda text: None)
  shown = capsys.readouterr().out
  assert "[hip]" in shown and "[knee]" in shown


def test_a_whole_number_that_some_jobs_lack_stays_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  jobs = [Job(name, [], {"agent.half_life": value}) for name, value in (("ppo", None), ("mine", 5))]
  sweep = SweepDirectory.create(tmp_path, "mine", [], [], [], jobs)
  for job in jobs:
    sweep.folder(job).write(status="finished")
    (sweep.folder(job).path / "metrics.csv").write_text("step,eval/episode_reward\n0,1\n")
  drawn: list[str] = []
  monkeypatch.setattr(figures, "curves", lambda panels, *_: drawn.extend(panels["mine"]) or b"")
  write_result(sweep, lambda text: None)
  assert (tmp_path / "sweep.csv").read_text().splitlines()[2].startswith("mine,5,finished")
  assert [row.split(",")[0] for row in (tmp_path / "groups.csv").read_text().splitlines()[1:]] == ["null", "5"]
  assert drawn[:2] == ["half_life=null", "half_life=5"]


def test_a_task_has_a_panel_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  jobs = [
    Job(name, [f"experiment={name}"], {"experiment": name}, task=task)
    for name, task in (("go1_joystick", "Go1JoystickFlatTerrain"), ("spot_joystick", "SpotFlatTerrainJoystick"))
  ]
  sweep = SweepDirectory.create(tmp_path, "mine", [], [], [], jobs)
  for job in jobs:
    sweep.folder(job).path.mkdir(parents=True)
    (sweep.folder(job).path / "metrics.csv").write_text("step,eval/episode_reward\n0,1\n")
  drawn: list[dict[str, list[str]]] = []
  monkeypatch.setattr(
    figures, "curves", lambda panels, *_: drawn.append({k: list(v) for k, v in panels.items()}) or b""
  )
  write_result(SweepDirectory.open(tmp_path), lambda text: None)
  assert drawn[0] == {
    "Go1JoystickFlatTerrain": ["experiment=go1_joystick"],
    "SpotFlatTerrainJoystick": ["experiment=spot_joystick"],
  }


def test_a_chains_curve_is_of_its_last_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  sweep = SweepDirectory.create(tmp_path, "mine", [], [], [], [Job("chain", [], {}, task="Sparse")])
  folder = sweep.folder(sweep.jobs[0])
  folder.write(status="finished", attempt=1)
  tasks = {"dense": "Dense", "sparse": "Sparse", "slow": "Sparse"}
  stages = [{"name": name, "env": task} for name, task in tasks.items()]
  write_json(folder.path / "summary.json", {"status": "finished", "env": "Sparse", "stages": stages})
  rows = [f"{step}000000,{name},{step}" for step, name in enumerate(tasks)]
  (folder.path / "metrics.csv").write_text("\n".join(["step,stage,eval/episode_reward", *rows]) + "\n")
  drawn: list[Any] = []
  monkeypatch.setattr(figures, "curves", lambda panels, *_: drawn.append(panels) or b"")
  write_result(sweep, lambda text: None)
  curve = drawn[0]["Sparse"]["mean"]
  assert (curve.x[0], curve.x[-1], curve.y[0], curve.y[-1]) == (1.0, 2.0, 1.0, 2.0)


def test_a_dollar_is_no_formula(tmp_path: Path) -> None:
  jobs = [Job(name, [], {"project": name}) for name in ("$a_{$", "b")]
  sweep = SweepDirectory.create(tmp_path, "mine", [], [], [], jobs)
  for job in jobs:
    sweep.folder(job).path.mkdir(parents=True)
    (sweep.folder(job).path / "metrics.csv").write_text("step,eval/episode_reward\n0,1\n")
  assert tmp_path / "report.html" in write_result(sweep, lambda text: None)


def test_a_job_that_failed_early_leaves_its_groups_curve_whole(
  sweep: SweepDirectory, monkeypatch: pytest.MonkeyPatch
) -> None:
  (sweep.folder(sweep.jobs[-1]).path / "metrics.csv").write_text("step,eval/episode_reward,time/wall_clock_s\n0,1,0\n")
  drawn: list[Any] = []
  monkeypatch.setattr(figures, "curves", lambda panels, *_: drawn.append(panels["mine"]) or b"")
  write_result(sweep, lambda text: None)
  assert [[curve.x[-1] for curve in groups.values()] for groups in drawn] == [[1e-4, 1e-4], [100 / 7, 100 / 7]]
  assert drawn[0]["agent=sac<1>"].y[-1] == 105.0


def test_curves_are_compared_where_all_have_points() -> None:
  first = (np.array([0.0, 10.0]), np.array([0.0, 10.0]))
  second = (np.array([0.0, 20.0]), np.array([2.0, 22.0]))
  x, mean, half = mean_curve([first, second])
  assert (x[0], x[-1]) == (0, 10)
  np.testing.assert_allclose(mean, x + 1)
  np.testing.assert_allclose(half, 12.7062 * 2**0.5 / 2**0.5, rtol=1e-4)
  np.testing.assert_array_equal(mean_curve([first])[2], 0)
