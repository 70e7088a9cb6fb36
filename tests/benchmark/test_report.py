"""The report: truthful about what is there and what is not, from rows of every age."""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from playground.benchmark import report
from playground.benchmark.report import Options, page, run, sections
from playground.benchmark.report.evidence import Evidence
from playground.benchmark.schema import Table as Rows
from playground.errors import ConfigError
from playground.paper import SUITES, paper_table
from playground.reporting import figures
from playground.reporting.page import Block, Image, Table

REFERENCE = Path(__file__).parents[2] / "results/reference"
ROW = {
  "benchmark": "throughput", "task": "CheetahRun", "agent": "ppo", "who": "ours", "quantity": "training_steps_per_s",
  "unit": "steps/s", "backend": "warp", "devices": 1, "device": "NVIDIA X", "commit": "abc",
  "conditions": "1.0 s timed", "date": "2026-01-01",
}  # fmt: skip


def evidence(folder: Path, *rows: dict[str, Any]) -> Evidence:
  table = Rows(folder / "rows.csv")
  for row in rows:
    table.add(ROW | row)
  return Evidence([folder])


def line_of(found: Evidence, task: str, number: int = 0) -> list[str]:
  """A task's row in the n-th table of the page."""
  tables = [block for block in page(found) if isinstance(block, Table)]
  return next(list(row) for row in tables[number].rows if row[0] == task)


def table_with(blocks: Sequence[Block], column: str) -> Table:
  return next(block for block in blocks if isinstance(block, Table) and column in block.header)


def test_mean_and_interval_over_seeds(tmp_path: Path):
  found = evidence(tmp_path, *({"seed": seed, "value": 870_000.0 + 1000 * seed} for seed in range(1, 6)))
  line = line_of(found, "CheetahRun")
  assert line[1:6] == ["435,162 ± 12,183", "873,000 ± 1,963", "2.01", "5", "warp"]
  assert line_of(found, "HumanoidRun")[2] == "not measured"


def test_a_gpu_counts_before_a_cpu_and_new_before_old(tmp_path: Path):
  found = evidence(
    tmp_path,
    {"seed": 1, "value": 3e6, "commit": "old"},
    {"seed": 1, "value": 1e6, "commit": "new", "date": "2026-02-01"},
    {"seed": 1, "value": 9e6, "device": "CPU Y x 2", "date": "2026-03-01"},
    {"seed": 1, "value": 8e6, "setting": "agent.num_envs=4", "date": "2026-03-01"},
  )
  assert line_of(found, "CheetahRun")[2] == "1,000,000"


def test_other_versions_are_another_experiment(tmp_path: Path):
  found = evidence(tmp_path, {"seed": 1, "value": 1e6}, {"seed": 2, "value": 2e6, "versions": "JAX 9"})
  assert line_of(found, "CheetahRun")[2] in ("1,000,000", "2,000,000")


def test_measured_again_replaces(tmp_path: Path):
  found = evidence(tmp_path, {"seed": 1, "value": 1e6}, {"seed": 1, "value": 2e6})
  assert line_of(found, "CheetahRun")[2] == "2,000,000"


def test_every_benchmark_has_its_section(tmp_path: Path):
  speed = {"quantity": "training_steps_per_s"}
  found = evidence(
    tmp_path,
    {"benchmark": "compare", "seed": 1, "value": 200.0, **speed},
    {"benchmark": "compare", "seed": 2, "value": 300.0, **speed},
    {"benchmark": "compare", "who": "playground 0.2.0", "seed": 1, "value": 150.0, **speed},
    {"benchmark": "startup", "setting": "cold", "quantity": "start_to_first_update_s", "value": 12.5},
    {"benchmark": "together", "setting": "num_agents=1", "value": 1e4, **speed},
    {"benchmark": "together", "setting": "num_agents=5", "value": 3.5e4, **speed},
    {"benchmark": "scaling", "setting": "agent.num_envs=64", "value": 1e4, **speed},
    {"benchmark": "scaling", "setting": "agent.num_envs=128", "value": 2e4, **speed},
    {"benchmark": "topology", "setting": "hardware.devices=1", "value": 1e4, **speed},
    {
      "benchmark": "topology",
      "setting": "hardware.devices=2 hardware.scale_envs=true",
      "devices": 2,
      "value": 1.5e4,
      **speed,
    },
    {"benchmark": "topology", "setting": "hardware.devices=4", "devices": 4, "device": "NVIDIA Y", "value": 3e4},
    *(
      {"benchmark": "learning", "who": who, "setting": setting, "seed": 1, "quantity": quantity, "value": value}
      for who, score in (("ours", 612.5), ("playground 0.2.0", 598.5))
      for setting, quantity, value in (("step=0", "return", 1.5), ("", "best_return", 9.0), ("", "final_return", score))
    ),
    {"benchmark": "chain", "task": "a_chain", "setting": "stage=all", "quantity": "wall_clock_s", "value": 100.0},
    *(
      {"benchmark": "breakdown", "setting": f"part={part}", "quantity": "seconds_per_step", "value": value}
      for part, value in (("physics", 1e-6), ("task", 3e-6), ("update", 10e-6))
    ),
  )
  blocks = page(found)
  assert {block.name for block in blocks if isinstance(block, Image)} == {
    *("scaling", "topology", "breakdown", "runs", "public")
  }
  cells = {cell for block in blocks if isinstance(block, Table) for row in block.rows for cell in row}
  assert {"2.00", "12.5", "20,000", "a_chain", "100"} <= cells  # 300 / 150: the best of the turns
  devices = {row[1]: list(row[2:8]) for row in table_with(blocks, "efficiency").rows}
  assert devices["1"] == ["fixed", "10,000", "1.00", "1.00", "6,000", "NVIDIA X"]  # 60 M steps are the task's own
  assert devices["2"] == ["scaled", "15,000", "1.50", "0.75", "4,000", "NVIDIA X"]
  assert devices["4"] == ["fixed", "30,000", "", "", "2,000", "NVIDIA Y"], "of another device than the one alone"
  agents = [list(row[:4]) for row in table_with(blocks, "times one run").rows]
  assert agents == [["CheetahRun", "1", "10,000", "1.00"], ["CheetahRun", "5", "35,000", "3.50"]]
  scores = [list(row[:5]) for row in table_with(blocks, "return of each run").rows]
  assert scores == [["CheetahRun", "ppo", "ours", "", "612.5"], ["CheetahRun", "ppo", "playground 0.2.0", "", "598.5"]]
  shares = table_with(blocks, "update (µs)").rows[0]
  assert list(shares[1:8]) == ["1", "2", "", "", "", "", "7"]


def test_the_best_of_turns_is_the_fastest_and_the_smallest(tmp_path: Path):
  turns = [
    {"benchmark": "compare", "who": who, "seed": seed, "quantity": quantity, "value": value * seed}
    for who, factor in (("ours", 1.0), ("playground 0.2.0", 2.0))
    for quantity, value in (("training_steps_per_s", 10.0 / factor), ("start_to_first_update_s", 7.0 * factor))
    for seed in (1, 2)
  ]
  rows = table_with(page(evidence(tmp_path, *turns)), "times better").rows
  assert [[row[1], row[2], row[4], row[5]] for row in rows] == [
    ["start (s)", "7", "14", "2.00"],
    ["training steps/s", "20", "10", "2.00"],
  ]


def test_memory_is_that_of_the_same_measurement(tmp_path: Path):
  envs = {"benchmark": "scaling", "setting": "agent.num_envs=8 env.impl=jax agent.num_envs=64 agent.batch_size=32"}
  found = evidence(
    tmp_path,
    {**envs, "quantity": "env_steps_per_s", "value": 1e4},
    {**envs, "quantity": "peak_memory_gib", "value": 1.0},
    {**envs, "quantity": "training_steps_per_s", "value": 1e3, "seed": 1},
    {**envs, "quantity": "peak_memory_gib", "value": 3.0, "seed": 1},
    {**envs, "quantity": "training_steps_per_s", "value": 10.0, "seed": 1, "agent": "sac"},
  )
  assert [list(row[:5]) for row in table_with(page(found), "environments").rows] == [
    ["CheetahRun env.impl=jax", "environment", "64", "10,000", "1.00"],
    ["CheetahRun env.impl=jax", "training", "64", "1,000", "3.00"],
    ["CheetahRun sac env.impl=jax", "training", "64", "10", ""],
  ]


def test_a_breakdown_is_of_one_algorithm_and_setting(tmp_path: Path):
  row = {"benchmark": "breakdown", "quantity": "seconds_per_step"}
  sac, small = {"agent": "sac", "date": "2026-02-01"}, "agent.num_envs=64 "
  found = evidence(
    tmp_path,
    *({**row, "setting": f"part={part}", "value": value} for part, value in (("storing", 2e-6), ("update", 4e-6))),
    *({**row, **sac, "setting": f"part={part}", "value": value} for part, value in (("task", 1e-5), ("update", 4e-5))),
    {**row, "setting": f"{small}part=update", "value": 5e-6, "date": "2026-01-02"},
    {**row, "setting": f"{small}part=update", "value": 6e-6, "date": "2026-01-03", "commit": "new"},
  )
  table = table_with(page(found), "update (µs)")
  shown = {row[0]: [cell for cell in row[1:8] if cell] for row in table.rows}
  assert shown == {"CheetahRun": ["2", "2"], "CheetahRun sac": ["10", "30"], "CheetahRun agent.num_envs=64": ["6"]}


def test_what_overrides_changed_is_said(tmp_path: Path):
  start = {"benchmark": "startup", "quantity": "start_to_first_update_s"}
  rate = {"benchmark": "topology", "setting": "env.impl=jax hardware.devices=1", "seed": 1, "agent": "sac"}
  found = evidence(tmp_path, {**start, "setting": "agent.num_envs=64 warm", "value": 9.0}, {**rate, "value": 60.0})
  blocks = page(found)
  starts = [list(row[:3]) for row in table_with(blocks, "caches").rows]
  assert starts == [["CheetahRun agent.num_envs=64", "warm", "9.0"]]
  assert table_with(blocks, "efficiency").rows[0][0] == "CheetahRun sac env.impl=jax"


def test_only_what_one_call_measured_stands_beside_each_other(tmp_path: Path):
  speed = {"benchmark": "compare", "quantity": "training_steps_per_s", "seed": 1}
  peer = {**speed, "who": "playground 0.2.0"}
  found = evidence(
    tmp_path,
    {**speed, "commit": "old", "value": 100.0},
    {**peer, "commit": "old", "backend": "jax", "value": 50.0},
    {**speed, "commit": "new", "value": 120.0},
    {**peer, "commit": "new", "backend": "warp", "value": 40.0},
  )
  rows = table_with(page(found), "times better").rows
  assert sorted(row[5] for row in rows) == ["2.00", "3.00"]

  small = "env.impl=jax agent.num_envs=8"
  of_commands = [{**speed, "value": 100.0}, {**peer, "setting": "env.impl=warp", "value": 50.0}]
  of_commands += [{**speed, "setting": small, "value": 30.0}]
  of_commands += [{**peer, "setting": f"{small} env.impl=warp", "value": 10.0}]
  rows = table_with(page(evidence(tmp_path / "other", *of_commands)), "times better").rows
  assert [(row[0], row[5]) for row in rows] == [("CheetahRun", "2.00"), (f"CheetahRun {small}", "3.00")]


def whole_run(devices: int, setting: str, seed: int, **quantities: float) -> list[dict[str, Any]]:
  columns = {"benchmark": "topology", "devices": devices, "seed": seed}
  columns["setting"] = " ".join(filter(None, (f"hardware.devices={devices}", setting, "agent.num_timesteps=1000")))
  rows = [{**columns, "quantity": name, "value": value} for name, value in quantities.items()]
  curve = ((0, 1.0), (1000, quantities["final_return"]))
  return rows + [
    {**columns, "setting": f"{columns['setting']} step={step}", "quantity": "return", "value": score}
    for step, score in curve
  ]


def test_whole_runs_stand_beside_the_rates_of_a_topology(tmp_path: Path):
  rate = {"benchmark": "topology", "quantity": "training_steps_per_s", "seed": 1}
  result = {"steps": 1024, "training_steps_per_s": 77.0}
  found = evidence(
    tmp_path,
    {**rate, "setting": "hardware.devices=1", "value": 100.0},
    {**rate, "setting": "hardware.devices=10", "devices": 10, "value": 400.0},
    {**rate, "setting": "hardware.devices=2 hardware.scale_envs=true", "devices": 2, "value": 160.0},
    *whole_run(1, "", 1, **result, wall_clock_s=15.0, final_return=5.0),
    *whole_run(1, "", 2, **result, wall_clock_s=25.0, final_return=7.0),
    *whole_run(2, "hardware.scale_envs=true", 1, **result, wall_clock_s=8.0, final_return=4.0),
    *whole_run(4, "", 1, **result, wall_clock_s=5.0, final_return=3.0),
  )
  blocks = page(found)
  rates = [list(row[1:6]) for row in table_with(blocks, "efficiency").rows]
  assert rates == [
    ["1", "fixed", "100.0", "1.00", "1.00"],
    ["2", "scaled", "160.0", "1.60", "0.80"],
    ["10", "fixed", "400.0", "4.00", "0.40"],
  ], "a whole run's own rate is none of them"
  runs = [list(row[1:8]) for row in table_with(blocks, "measured (s)").rows]
  assert runs == [
    ["1", "fixed", "1,024", "20.0 ± 63.5", "1.00", "10.24", "6.0 ± 12.7"],
    ["2", "scaled", "1,024", "8.0", "2.50", "6.4", "4.0"],
    ["4", "fixed", "1,024", "5.0", "4.00", "", "3.0"],
  ], "no rate of four was measured"
  settings = [row[3] for row in table_with(blocks, "return of each run").rows]
  assert "hardware.devices=2 hardware.scale_envs=true agent.num_timesteps=1000" in settings and len(settings) == 3
  curves = sections.runs_by_step(found)
  assert curves == {
    "CheetahRun": {
      "devices=1": [(0, 1.0), (1000, 6.0)],
      "devices=2 scale_envs=true": [(0, 1.0), (1000, 4.0)],
      "devices=4": [(0, 1.0), (1000, 3.0)],
    }
  }


def test_a_table_of_whole_runs_has_a_column_for_each_quantity(tmp_path: Path):
  (tmp_path / "runs.csv").write_text(
    "task,agent,who,seed,final_return,training_steps_per_s,note,device\n"
    "CheetahRun,sac,ours,1,977.6,,alone,NVIDIA X\n"
    "CheetahRun,sac,ours,2,612.5,17092,alone,NVIDIA X\n"
    "CheetahRun,sac,ours,1,977.6,17031,beside others,NVIDIA X\n"
  )
  found = Evidence([tmp_path])
  scores = [(row[1], row[2], row[4]) for row in table_with(page(found), "return of each run").rows]
  assert scores == [("sac", "ours", "977.6"), ("sac", "ours", "977.6, 612.5")], "a note sets runs apart"
  assert sorted(row["value"] for row in found.rows if row["quantity"] == "training_steps_per_s") == [17031, 17092]


def test_the_committed_results_make_a_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
  draw = figures.curves  # of 130 panels: matplotlib takes 0.1 s for each
  few = lambda panels, *labels: draw(dict(itertools.islice(panels.items(), 2)), *labels)
  monkeypatch.setattr(figures, "curves", few)
  assert run(Options(out=str(tmp_path), rows=(str(REFERENCE),))) == 0
  markdown, html = (tmp_path / "report.md").read_text(), (tmp_path / "report.html").read_text()
  tasks = [row["registry_env"] for suite in SUITES for row in paper_table(f"{suite}_throughput")]
  assert len(tasks) == 48
  assert all(f"| {task} | " in markdown and f"<td>{task}</td>" in html for task in tasks)
  assert "src=" not in html and 'href="http' not in html, "it needs nothing beside it"
  assert (tmp_path / "report_images" / "curves.svg").is_file()


def test_rows_that_are_being_written_and_damaged_ones(tmp_path: Path):
  found = evidence(tmp_path, {"seed": 1, "value": 1e6})
  assert len(found.rows) == 1
  path = tmp_path / "rows.csv"
  whole = path.read_text()
  path.write_text(whole + "throughput,CheetahRun,ppo,ours,,2,training_steps_per_s,9")
  assert [row["value"] for row in Evidence([tmp_path]).rows] == [1e6], "90000 may have been meant"
  for value, message in (
    ("1000 or so", "rows.csv, line 2 has training_steps_per_s=1000 or so, which must be a number above 0"),
    ("1,000", "rows.csv, line 2 has too many columns"),
  ):
    path.write_text(whole.replace("1000000.0", value))
    with pytest.raises(ConfigError, match=message):
      run(Options(out=str(tmp_path), rows=(str(tmp_path),)))


@pytest.mark.parametrize(
  ("row", "message"),
  [
    ({"benchmark": "topology", "devices": ""}, "has devices=, which must be a whole number from 1 to 1,000,000,000"),
    ({"benchmark": "topology", "devices": "two"}, "has devices=two, which must be a whole number"),
    ({"benchmark": "together", "setting": "env.impl=jax"}, "has num_agents=, which must be a whole number from 1"),
    ({"benchmark": "pixels", "setting": "env.vision.width=a"}, "has env.vision.width=a, which must be"),
    ({"benchmark": "scaling", "setting": "env.impl=jax"}, "has agent.num_envs=, which must be a whole number from 1"),
    (
      {"benchmark": "scaling", "setting": f"agent.num_envs={'9' * 400}"},
      f"has agent.num_envs={'9' * 40}..., which must be a whole number from 1 to 1,000,000,000 for scaling",
    ),
    ({"quantity": "return", "setting": "step=abc"}, "has step=abc, which must be a number"),
    (
      {"benchmark": "breakdown", "quantity": "seconds_per_step", "setting": "part=update", "value": 0},
      "has seconds_per_step=0, which must",
    ),
    ({"benchmark": "topology", "value": "nan"}, "has training_steps_per_s=nan, which must be a number"),
    ({"quantity": "final_return", "value": "nan"}, "has final_return=nan, which must be a number"),
    ({"quantity": "mode_return", "setting": "step=5", "value": "-inf"}, "has mode_return=-inf, which must be a number"),
    ({"quantity": "return", "setting": "step=nan"}, "has step=nan, which must be a number"),
  ],
)
def test_a_row_with_a_wrong_number_is_named(row: dict[str, Any], message: str, tmp_path: Path):
  with pytest.raises(ConfigError, match=rf"^{tmp_path}/rows.csv, line 3 {message}.*: mend or remove that line\.$"):
    evidence(tmp_path, {"seed": 1, "value": 1e6}, {"value": 1.0, **row})


def test_an_evaluation_without_a_number_is_no_point_of_a_curve(tmp_path: Path):
  (tmp_path / "run").mkdir()
  metrics = tmp_path / "run" / "metrics.csv"
  metrics.write_text("step,eval/episode_reward\n0,1.0\n100,nan\n200,\n300,4.0\n")
  assert Evidence([tmp_path]).curves == {"run": [(0, 1.0), (300, 4.0)]}
  metrics.write_text("step,eval/episode_reward\n0,inf\n")
  with pytest.raises(ConfigError, match=r"line 2 has eval/episode_reward=inf, which must be a number"):
    Evidence([tmp_path])


def test_rows_of_tasks_and_agents_that_are_not_installed_are_shown(tmp_path: Path):
  rate = {"benchmark": "topology", "value": 100.0}
  found = evidence(tmp_path, {**rate, "task": "TheirTask"}, {**rate, "agent": "theirs"}, {**rate, "agent": ""})
  rows = table_with(page(found), "its budget takes (s)").rows
  assert {(row[0], row[3], row[6]) for row in rows} == {
    *(("CheetahRun theirs", "100.0", ""), ("CheetahRun", "100.0", ""), ("TheirTask", "100.0", ""))
  }


def test_parts_of_another_version_have_no_breakdown(tmp_path: Path):
  row = {"benchmark": "breakdown", "quantity": "seconds_per_step", "value": 1e-6}
  found = evidence(tmp_path, {**row, "setting": "part=gone"}, {**row, "task": "HopperHop", "setting": "part=physics"})
  assert [row[0] for row in table_with(page(found), "physics (µs)").rows] == ["HopperHop"]


def test_memory_that_is_none_has_no_ratio(tmp_path: Path):
  memory = {"benchmark": "compare", "quantity": "used_memory_gib", "seed": 1}
  found = evidence(tmp_path, {**memory, "value": 0.0}, {**memory, "who": "playground 0.2.0", "value": 1.0})
  assert [row[5] for row in table_with(page(found), "times better").rows] == [""]


def test_a_folder_of_rows_that_is_not_there_is_named(tmp_path: Path):
  with pytest.raises(ConfigError, match=r"^rows=.*/none is not a folder"):
    run(Options(out=str(tmp_path), rows=(str(REFERENCE), str(tmp_path / "none"))))


def test_without_rows_it_says_so(tmp_path: Path):
  with pytest.raises(ConfigError, match="no measured row"):
    run(Options(out=str(tmp_path), rows=(str(tmp_path),)))


def test_a_folder_that_cannot_be_is_said_before_the_page_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
  monkeypatch.setattr(report, "page", pytest.fail)
  (tmp_path / "file").touch()
  with pytest.raises(ConfigError, match=r"^out=.*/file/page cannot be written: .*/file is not a folder that you may"):
    run(Options(out=str(tmp_path / "file" / "page"), rows=(str(REFERENCE),)))


def test_runs_of_other_lengths_and_experiments_are_others(tmp_path: Path) -> None:
  header = "task,agent,who,experiment,setting,seed,backend,steps,final_return,devices,device,conditions\n"
  of = lambda experiment, steps, value: f"Go1Getup,ppo,ours,{experiment},,1,jax,{steps},{value},1,NVIDIA H200,\n"
  lines = [of("", 100, 1.5), of("", 200, 2.5), of("chain", 200, 3.5), of("chain", 200, 4.5)]
  (tmp_path / "runs.csv").write_text(header + "".join(lines))
  assert sorted(figure.mean for figure in Evidence([tmp_path]).find(quantity="final_return")) == [1.5, 2.5, 4.5]
