"""`playground-bench pixels`: its jobs, its table, and a real one in the slow tests."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from playground.benchmark.commands import COMPARED_CONDITIONS, Pixels
from playground.benchmark.report import sections
from playground.benchmark.report.evidence import Evidence
from playground.benchmark.report.pixels import pixels
from playground.benchmark.schema import Table
from playground.errors import ConfigError
from playground.reporting.page import Table as Shown

CHECKOUT = Path(__file__).parents[2]


def test_every_size_and_number_is_a_job_under_the_papers_conditions() -> None:
  jobs = Pixels(sizes=(64, 128), num_envs=(1024, 4096)).jobs(1)
  assert [job.columns["task"] for job in jobs] == ["CartpoleBalanceVision"] * 4 + ["PandaPickCubeCartesianVision"] * 4
  setting = "env.ctrl_dt=0.04 env.episode_length=75 env.vision.width=64 env.vision.height=64 agent.num_envs=4096"
  assert jobs[1].columns["setting"] == f"{setting} agent.batch_size=512"
  assert jobs[1].last["setting"] == f"{setting} agent.batch_size=512 part=update"
  assert "randomization=panda_vision" in jobs[-1].arguments["overrides"]
  (compared,) = Pixels(sizes=(80,), compared=True).jobs(1)
  assert compared.columns["setting"].startswith(f"env.ctrl_dt={1 / 60} env.sim_dt={1 / 120}")
  assert compared.last["setting"].endswith("part=pixels")


def test_a_task_without_a_camera_is_refused() -> None:
  with pytest.raises(ConfigError, match=r"CartpoleBalance has no images: add env.vision.enable=true"):
    Pixels(tasks=("CartpoleBalance",)).check()
  camera = ("env.vision.enable=true", "env.vision.camera=fixed")
  Pixels(tasks=("CartpoleBalance",), overrides=camera).check()


@pytest.mark.parametrize(
  ("options", "message"),
  [
    ({"agent": "sac"}, "agent=sac reads no images: pixels is of agent=ppo"),
    ({"sizes": (64, 0)}, r"sizes=\[64, 0\] must be a list of whole numbers from 1"),
    ({"num_envs": ()}, "num_envs= is empty"),
    ({"compared": True, "tasks": ("PandaPickCubeCartesianVision",)}, "compared=true is of CartpoleBalanceVision alone"),
  ],
)
def test_what_cannot_be_measured(options: dict[str, Any], message: str) -> None:
  with pytest.raises(ConfigError, match=message):
    Pixels(**options).check()


def test_the_report_has_ours_beside_the_papers(tmp_path: Path) -> None:
  table = Table(tmp_path / "pixels.csv")
  row = {"benchmark": "pixels", "task": "CartpoleBalanceVision", "agent": "ppo", "who": "ours", "device": "GPU"}
  sizes = "env.vision.width=64 env.vision.height=64 agent.num_envs=1024"
  for conditions in ("a=1", COMPARED_CONDITIONS[0]):
    for part, seconds in (
      ("episodes", 1e-6),
      ("pixels", 4e-6),
      ("inference", 5e-6),
      ("storing", 6e-6),
      ("update", 2e-5),
    ):
      setting = f"{conditions} {sizes} part={part}"
      table.add({**row, "setting": setting, "quantity": "seconds_per_step", "value": seconds, "unit": "s"})
  table.add({**row, "setting": f"a=1 {sizes}", "quantity": "used_memory_gib", "value": 1.25, "unit": "GiB"})
  blocks = pixels(Evidence([tmp_path]), sections.Notes())
  speeds, shares, bars = ([list(row) for row in block.rows] for block in blocks if isinstance(block, Shown))
  of_ours = ["CartpoleBalanceVision", "ours", "64", "1024"]
  assert speeds[0][:11] == [*of_ours, "1,000,000", "250,000", "200,000", "50,000", "1.25", "GPU", "a=1"]
  paper = ["CartpoleBalance", "paper, Madrona", "64", "1024"]
  assert speeds[2][:8] == [*paper, "1,370,000", "403,000", "341,000", "31,300"]
  assert shares[0][:8] == [*of_ours, "1 (5%)", "3 (15%)", "1 (5%)", "15 (75%)"]
  assert shares[2][:8] == [*paper, "0.73 (2%)", "1.75 (5%)", "0.451 (1%)", "29 (91%)"]
  assert {row[0] for row in bars} == {"ours", "madrona_mjx", "isaac_lab", "maniskill"}
  ours = [row[1:] for row in bars if row[0] == "ours"]
  assert ours == [
    ["CartpoleBalanceVision", conditions, "64", "250,000", "GPU"]
    for conditions in ("simulator_comparison", "trainable_env")
  ]


@pytest.mark.slow
@pytest.mark.parametrize("compared", [False, True])
def test_a_real_one(tmp_path: Path, compared: bool) -> None:
  small = ["sizes=8", "num_envs=8", "seconds=0.2", "cache=true", "hardware=cpu", "debug=fast", f"compared={compared}"]
  command = [sys.executable, "-m", "playground.cli.bench", "pixels", "tasks=CartpoleBalanceVision", *small]
  done = subprocess.run([*command, f"out={tmp_path}/out.csv"], capture_output=True, text=True, cwd=CHECKOUT)
  assert done.returncode == 0, done.stdout + done.stderr
  rows = pd.read_csv(tmp_path / "out.csv")
  parts = ["physics", "task", "episodes", "pixels"] + ["inference", "storing", "update"] * (not compared)
  assert [text.split("part=")[1] for text in rows["setting"]] == parts and min(rows["value"]) > 0
