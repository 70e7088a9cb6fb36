"""The row of each task on a result page: its best runs, beside the public ones at equal steps."""

import dataclasses

import pytest

from playground.benchmark.report import tasks
from playground.benchmark.report.public import Curve
from playground.benchmark.report.tasks import Row, agents_table, by_mode, table
from playground.catalog import best_runs, entries, run_name

TASK = "CheetahRun"


def run(value: float, **columns: str) -> Row:
  same = {"task": TASK, "agent": "ppo", "who": "ours", "seed": "1", "backend": "warp", "steps": "60000000"}
  return {**same, "setting": "", "final_return": str(value), "final_mode_return": "", **columns}


def test_runs_that_differ_in_seed_alone_count_together():
  rows = [
    run(900, agent="sac"),
    run(100),
    run(300, seed="2"),
    run(999, who="playground 0.2.0"),
    run(999, task="WalkerRun"),
  ]
  assert best_runs(rows, TASK) == rows[:1]
  assert best_runs(rows[1:], TASK) == rows[1:3]
  assert best_runs(rows, "HopperHop") == []


def test_of_runs_as_good_those_with_the_most_seeds_count():
  rows = [run(900, agent="sac"), run(890), run(885, seed="2"), run(100, final_mode_return="880")]
  assert best_runs(rows, TASK) == rows[1:]
  assert best_runs([*rows, run(500, agent="reppo", final_mode_return="950")], TASK)[0]["agent"] == "reppo"
  assert best_runs([run(900, agent="sac"), run(890), run(895)], TASK) == [run(900, agent="sac")]


def test_runs_of_three_seeds_count_before_a_lucky_one():
  rows = [run(900, agent="sac"), *[run(100, seed=seed) for seed in "123"]]
  assert best_runs(rows, TASK) == rows[1:]
  assert best_runs(rows[:3], TASK) == rows[:1]


def test_of_runs_that_were_stopped_the_longest_count():
  ended = [(300, "5"), (290, "20"), (310, "10")]
  rows = [run(value, seed=seed, steps=steps) for seed in "123" for value, steps in ended]
  assert best_runs(rows, TASK) == rows[1::3]
  assert best_runs(rows[:-2], TASK) == rows[::3], "two seeds are too few"
  assert best_runs([*rows, run(320, agent="sac")], TASK) == rows[1::3]


def test_a_chain_counts_by_its_last_stage():
  rows = [run(20, experiment="chain", setting="stage=a"), run(9, experiment="chain", setting="stage=b")]
  assert best_runs(rows, TASK) == rows[1:]
  assert best_runs([*rows, run(5)], TASK) == rows[1:]
  assert best_runs([*rows, run(10)], TASK) == [run(10)]


@pytest.mark.parametrize("setting", ["env.events.push.enabled=false", "env.events.push=null"])
def test_runs_without_pushes_count_only_alone(setting: str):
  off = run(40, setting=setting)
  assert best_runs([off, run(5)], TASK) == [run(5)]
  assert best_runs([off], TASK) == [off]
  assert run_name(off) == "ppo, no pushes, nothing randomised"


def test_a_run_is_named_by_what_it_starts_from():
  assert run_name(run(1, agent="reppo", setting="init_from=<WalkerWalk>")) == "reppo, from WalkerWalk"
  assert run_name(run(1, setting="agent.mirror_augmentation=true")) == "ppo, mirrored data"
  assert run_name(run(1, setting="agent.num_envs=1 tuned=ppo/robust")) == "ppo, tuned=ppo/robust"
  assert run_name(run(1, experiment="go1_chain", setting="stage=rough")) == "ppo, go1_chain's rough"


@pytest.mark.parametrize(
  ("columns", "mode"), [({}, False), ({"agent": "reppo"}, True), ({"setting": "agent.deterministic_eval=true"}, True)]
)
def test_a_return_is_of_the_mode_where_the_run_was_evaluated_by_it(columns: Row, mode: bool):
  assert by_mode(run(1, **columns)) == mode


def test_a_row_of_the_table(monkeypatch: pytest.MonkeyPatch):
  theirs = [Curve("PPO (some)", "mode", [(10e6, 1.0), (90e6, 5.0)]), Curve("REPPO (x)", "sampled", [(50e6, 4.0)])]
  monkeypatch.setattr(tasks, "public_curves", lambda: {TASK: theirs})
  entry = entries()[TASK]
  in_c = lambda value, falls: {"c_mujoco_return": value, "c_mujoco_falls_per_episode": falls}
  runs = [run(100, final_mode_return="110", **in_c("90", "0.25")), run(300, seed="2", **in_c("92", "0.5"))]
  (row,) = table([entry], runs).rows
  assert row == [
    *(TASK, entry.status, "ppo", "60", f"{entry.budget / 1e6:.3g}", "2 (2)", "200 ± 1271", "110 (1)", "91, 0.38 falls"),
    *("3.5 (PPO, mode)", "4 (REPPO, sampled)"),
  ]
  (row,) = table([entry], [run(50, agent="reppo", steps="5000000")]).rows
  assert row[5:] == ["1 (1)", "", "50", "", "1 after 10 (PPO, mode)", "1 after 10 (PPO, mode)"]
  (row,) = table([entry], [run(5, c_mujoco_return="6", c_mujoco_success="1", c_mujoco_calm_return="7")]).rows
  assert row[8] == "6, success 1.00 (7)"
  (row,) = table([entry], []).rows
  assert row[2] == "not measured"


def test_a_seed_that_is_trained_again_is_no_other_sample() -> None:
  runs = [run(100), run(300, seed="2"), run(200), run(300, seed="2")]
  (row,) = table([entries()[TASK]], runs).rows
  assert row[5:7] == ["4 (2)", "225 ± 953"]  # of 150 and 300
  assert best_runs([run(220, agent="sac"), *runs], TASK) == runs


def test_a_row_for_each_agent_of_a_task_that_several_trained():
  rows = [
    run(700, success="0.5"),
    run(800, agent="ppo_v020", setting="env=CheetahRun", seed="2", success="0.75"),
    run(600, agent="fast_sac", device="CPU", falls_per_episode="0.25", steps="1000000"),
    run(640, agent="fast_sac", device="CPU", falls_per_episode="0.5", steps="1000000", seed="2"),
    run(999, agent="sac", who="playground 0.2.0"),
    run(5, task="WalkerRun"),
  ]
  entry = dataclasses.replace(entries()[TASK], agent="fast_sac")
  entries_ = [entry, entries()["WalkerRun"], entries()["HopperHop"]]
  assert agents_table(entries_, rows).rows == [
    [TASK, "ppo_v020", "60", "1 (1)", "800", "", "success 0.75", "GPU", ""],
    [TASK, "fast_sac", "1", "2 (2)", "", "620 ± 254", "0.38 falls", "CPU", "yes"],
  ]
