"""`playground-bench record`: rows and curves of run directories, without training but for one."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from playground.benchmark import record
from playground.benchmark.record import Options
from playground.benchmark.report.evidence import Evidence
from playground.benchmark.report.suites import AGENTS, GALLERY, TABLES, write_pages
from playground.config import compose
from playground.errors import CheckpointError, ConfigError, PlaygroundError
from playground.files import locking, read_csv
from playground.runs.run_dir import RunDirectory
from playground.runs.train import train
from tests.runs.helpers import make_run

ROOT = Path(__file__).parents[2]
TINY = ["env=CartpoleBalance", "debug=fast", "hardware=cpu", "tracking=csv", "seed=7"]
MACHINE: dict[str, Any] = {
  "impl": "warp", "platform": "gpu", "device": "NVIDIA X", "num_devices": 1, "matmul_precision": "highest",
  "network_precision": "tensorfloat32",
}  # fmt: skip
Make = Callable[..., Path]


@pytest.fixture
def reference(tmp_path: Path) -> Path:
  return Path(
    shutil.copytree(ROOT / "results/reference", tmp_path / "reference", ignore=shutil.ignore_patterns("*.png"))
  )


@pytest.fixture
def make(tmp_path: Path) -> Make:
  """Makes a run directory as training leaves it, without checkpoints."""

  def made(*overrides: str, metrics: str, status: Any = "finished", name: str = "run") -> Path:
    run = make_run(tmp_path / name, compose(overrides).resolved, overrides)
    run.write_manifest(**MACHINE)
    run.set_status(status)
    run.metrics_csv.write_text(metrics)
    return run.path

  return made


def last_row(table: Path) -> dict[str, str]:
  return read_csv(table)[-1]


def test_a_run_and_its_curve_come_to_tables_and_pages(reference: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
  pytest.importorskip("onnxruntime")
  run = tmp_path / "run"
  assert train(compose([*TINY, f"run_dir={run}"])) == 0
  (run / "overrides.yaml").write_text("".join(f"- {text}\n" for text in TINY))  # as the command writes them
  before = {path.name: path.read_text() for path in reference.glob("*.csv")}
  options = Options(
    runs=(str(run),), c_mujoco=True, episodes=1, alone=True, note="tiny, on test", reference=str(reference)
  )
  assert record.run(options) == 0
  row = last_row(reference / "dm_control.csv")
  assert (row["task"], row["agent"], row["who"], row["seed"]) == ("CartpoleBalance", "ppo", "ours", "7")
  assert (row["setting"], row["steps"], row["device"], row["backend"]) == ("debug=fast", "320", "CPU", "jax")
  assert row["note"] == "1 episodes in C MuJoCo; tiny, on test"
  summary = RunDirectory(run).summary
  for column in ("final_return", "final_mode_return", "best_return"):
    assert float(row[column]) == pytest.approx(summary[column], abs=0.051)
  assert float(row["c_mujoco_return"]) == pytest.approx(summary["final_mode_return"], abs=5)
  assert float(row["training_steps_per_s"]) > 0 and float(row["command_to_end_s"]) > 0
  assert "physics float32, networks float32" in row["conditions"] and "4 episodes an evaluation" in row["conditions"]
  changed = {path.name for path in reference.glob("*.csv") if path.read_text() != before[path.name]}
  assert changed == {"dm_control.csv", "dm_control_curves.csv"}
  assert all((reference / name).read_text().startswith(before[name]) for name in changed), "older rows stay"
  name = last_row(reference / "dm_control_curves.csv")["run"]
  assert name.startswith("CartpoleBalance_ppo_s7")
  (first, last) = Evidence([reference]).curves[name]
  assert first[0] == 0 and last == (320, pytest.approx(summary["final_return"], abs=1e-3))
  capsys.readouterr()
  assert record.run(options) == 0
  assert "is in" in capsys.readouterr().out
  assert last_row(reference / "dm_control.csv") == row and len(Evidence([reference]).curves[name]) == 2
  for page in (*(f"{kind}-{name}.md" for name in TABLES for kind in ("results", "runs")), AGENTS, GALLERY):
    shutil.copyfile(ROOT / "docs" / page, tmp_path / page)
  write_pages(tmp_path, reference)
  assert "| CartpoleBalance | ppo debug=fast | jax |" in (tmp_path / "runs-dm-control.md").read_text()


METRICS = """step,eval/episode_reward,eval/sampled/episode_reward,eval/episode_fall,eval/episode_tracking_error/lin_vel
0,1.0,1.1,1.0,0.9
11000000,27.125,25.0,0.25,0.3
12500000,,,,
"""


def test_a_stopped_run_that_evaluates_the_mode(reference: Path, make: Make) -> None:
  overrides = ["env=T1JoystickFlatTerrain", "agent=fast_sac", "agent.num_timesteps=50000000", "env.action_scale=0.25"]
  added = "tuned=fast_sac/T1JoystickFlatTerrain"  # by the program
  run = make(*overrides, added, "agent.num_evals=3", "video.enable=false", metrics=METRICS, status="preempted")
  assert record.run(Options(runs=(str(run),), machine="four Xs", reference=str(reference))) == 0
  row = last_row(reference / "locomotion.csv")
  assert row["setting"] == "env.action_scale=0.25 agent.num_evals=3", "a default is none"
  assert row["note"] == (
    "evaluated by the policy's mode; sampled 25.00; stopped after 12 of 50 M steps, last evaluated after 11 M; "
    "then with agent.num_timesteps=50000000"
  )
  assert (row["final_return"], row["final_mode_return"], row["best_return"]) == ("27.12", "27.12", "27.12")
  assert (row["falls_per_episode"], row["tracking_error_lin_m_s"], row["steps"]) == ("0.250", "0.300", "11000000")
  assert row["training_steps_per_s"] == row["c_mujoco_return"] == ""
  assert row["conditions"].startswith("four Xs; Python ") and "networks TF32" in row["conditions"]
  point = last_row(reference / "locomotion_curves.csv")
  assert point["eval/mode/episode_reward"] == point["eval/episode_reward"] == "27.125"


def test_falls_are_the_modes_where_a_run_that_samples_evaluates_it_too(reference: Path, make: Make) -> None:
  metrics = (
    "step,eval/episode_reward,eval/episode_fall,eval/mode/episode_reward,eval/mode/episode_fall\n9,3,0.5,4,0.1\n"
  )
  run = make("env=Go1JoystickFlatTerrain", metrics=metrics)
  assert record.run(Options(runs=(str(run),), reference=str(reference))) == 0
  row = last_row(reference / "locomotion.csv")
  assert (row["final_return"], row["final_mode_return"], row["falls_per_episode"]) == ("3.00", "4.00", "0.100")


def test_two_runs_have_two_curves_and_two_rows(reference: Path, make: Make) -> None:
  task = ("env=Go1JoystickFlatTerrain", "seed=77")  # a seed that the tables lack, whatever commit they are of
  first = make(*task, metrics=METRICS)
  other = make(*task, "agent.discounting=0.9", metrics=METRICS.replace("27.125", "26"), name="b")
  assert record.run(Options(runs=(str(first), str(other), str(first)), reference=str(reference))) == 0
  rows = [row["setting"] for row in read_csv(reference / "locomotion.csv")[-2:]]
  assert rows == ["", "agent.discounting=0.9"]
  names = list(dict.fromkeys(row["run"] for row in read_csv(reference / "locomotion_curves.csv")))[-2:]
  assert names[1] == f"{names[0]}_2"


def test_a_default_that_has_changed_is_a_setting(reference: Path, make: Make) -> None:
  run = make("env=PandaPickCube", "agent.discounting=0.5", metrics=METRICS)
  (run / "overrides.yaml").write_text("- init_from=null\n")
  assert record.run(Options(runs=(str(run),), reference=str(reference))) == 0
  row = last_row(reference / "manipulation.csv")
  assert (row["setting"], row["note"]) == ("agent.discounting=0.5", "")


def test_terms_that_were_removed_are_a_setting(reference: Path, make: Make) -> None:
  run = make("env=T1JoystickFlatTerrain", "randomization=none", "env.events.push=null", metrics=METRICS)
  assert record.run(Options(runs=(str(run),), reference=str(reference))) == 0
  row = last_row(reference / "locomotion.csv")
  assert row["setting"] == "randomization=none env.events.push=null" and "then with" not in row["note"]


def test_images_have_a_table_and_stages_a_setting(reference: Path, make: Make) -> None:
  images = make("env=CartpoleBalanceVision", metrics="step,eval/episode_reward,eval/mode/episode_reward\n100,24,24.5\n")
  chain = make_run(images.parent / "chain", {"name": "chain"}, ["curriculum.scale=0.4", "hardware=cpu"])
  stage = make("env=Go1Getup", metrics=METRICS, name="chain/2_fast")
  assert record.run(Options(runs=(str(images), str(stage)), reference=str(reference))) == 0
  row = last_row(reference / "vision.csv")
  assert (row["final_return"], row["note"]) == ("24.0", "by the policy's mode 24.5")
  assert last_row(reference / "locomotion.csv")["setting"] == "curriculum.scale=0.4 stage=fast", chain.path
  assert last_row(reference / "locomotion_curves.csv")["stage"] == "fast"
  with pytest.raises(ConfigError, match=r"vision.csv has no columns c_mujoco_\*"):
    record.run(Options(runs=(str(images),), c_mujoco=True, reference=str(reference)))


def test_what_cannot_be_recorded_is_refused_before_anything_is_written(reference: Path, make: Make) -> None:
  good = make("env=Go1JoystickFlatTerrain", metrics=METRICS, name="good")
  before = (reference / "locomotion.csv").read_bytes()

  def refused(bad: Path | str, error: type[PlaygroundError], match: str, **options: Any) -> None:
    with pytest.raises(error, match=match):
      record.run(Options(**{"runs": (str(good), str(bad)), "reference": str(reference), **options}))
    assert (reference / "locomotion.csv").read_bytes() == before

  refused("", ConfigError, "Name what to record", runs=())
  refused(good, ConfigError, "no_such is not a folder", reference="no_such")
  refused("no_such", CheckpointError, "No run directory at no_such")
  refused(good, CheckpointError, "no checkpoint", c_mujoco=True)
  refused(make("env=v020/CartpoleBalance", metrics=METRICS, name="a"), ConfigError, "only tasks that")
  untrained = make("env=CheetahRun", metrics="step,eval/episode_reward\n0,1.0\n5,\n", name="b")
  refused(untrained, ConfigError, "was not evaluated after training")
  config = (untrained / "config.yaml").read_text()
  (untrained / "config.yaml").write_text(re.sub(r"(?m)^env:\n( .*\n)+", "env: x\n", config))
  refused(untrained, ConfigError, "lacks env.impl")
  (untrained / "config.yaml").write_text(config)
  (untrained / "manifest.json").write_text('{"versions": "x"}')
  refused(untrained, CheckpointError, "its 'versions' has the wrong type")
  (untrained / "manifest.json").write_text("{}")
  refused(untrained, ConfigError, "manifest.json lacks impl")
  (untrained / "manifest.json").unlink()
  refused(untrained, ConfigError, "manifest.json is missing: only a whole run")
  with locking(good / "run.lock"):
    refused(good, ConfigError, "is being written by process")
  run = make("env=CheetahRun", metrics=METRICS, name="c")
  for name, column in (("dm_control_curves.csv", "step"), ("dm_control.csv", "conditions")):
    header = (reference / name).read_text()
    (reference / name).write_text(header.replace(column, "other", 1))
    refused(run, ConfigError, f"{name} lacks the column {column}")
  (reference / "dm_control.csv").unlink()
  refused(run, ConfigError, "dm_control.csv cannot be read")
