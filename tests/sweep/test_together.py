"""Which jobs of a sweep `launcher=together` gives one process, and such a sweep as users start it."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import pytest

from playground.cli.run import main
from playground.config.sweep_options import TogetherConfig
from playground.sweep.folder import Job, SweepDirectory
from playground.sweep.local import LocalLauncher
from playground.sweep.together import TogetherLauncher
from tests.runs.helpers import TASK


def make(path: Path, *overrides: str) -> SweepDirectory:
  jobs = [Job(f"{i:03d}", ["tuned=null", *text.split()], {}) for i, text in enumerate(overrides)]
  return SweepDirectory.create(path, "test", [], [], [], jobs)


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
  """The names of the jobs of each process that is started."""
  found: list[list[str]] = []

  def start(self: LocalLauncher, jobs: Sequence[Job]) -> bool:
    found.append([job.name for job in jobs])
    self._workers |= dict.fromkeys(found[-1])  # pyright: ignore
    return True

  monkeypatch.setattr(LocalLauncher, "_start", start)
  return found


@pytest.mark.parametrize(
  ("max_agents", "groups"),
  [(16, [["000", "001", "003"], ["002"], ["004"]]), (2, [["000", "001"], ["002"], ["003"], ["004"]])],
)
def test_jobs_of_one_program_are_one_process(
  tmp_path: Path, started: list[list[str]], max_agents: int, groups: list[list[str]]
) -> None:
  sweep = make(tmp_path, "seed=1", "seed=2", "agent.num_envs=64", "agent.entropy_cost=0", "env=PendulumSwingup")
  launcher = TogetherLauncher(sweep, TogetherConfig(max_agents=max_agents, cores_per_job=1000))
  assert all(launcher.start(job) for job in sweep.jobs)
  assert started == groups


def test_finished_jobs_are_left_out_and_a_search_adds_jobs(tmp_path: Path, started: list[list[str]]) -> None:
  sweep = make(tmp_path, "seed=1", "seed=2", "seed=3")
  sweep.folder(sweep.jobs[0]).write(status="finished")
  launcher = TogetherLauncher(sweep, TogetherConfig(cores_per_job=1000))
  new = Job("new", ["tuned=null", "seed=4"], {})
  sweep.add(new)
  assert launcher.start(sweep.jobs[1]) and launcher.start(sweep.jobs[2]) and launcher.start(new)
  assert started == [["001", "002"], ["new"]]


def test_a_sweep_of_one_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  sweep = ["-m", *TASK, "agent.num_timesteps=200", "seed=1,2", "launcher=together", f"sweep_dir={tmp_path / 'sweep'}"]
  monkeypatch.setattr("sys.argv", ["playground-run", *sweep])
  with pytest.raises(SystemExit) as exit_:
    main()
  assert exit_.value.code == 0
  table = pd.read_csv(tmp_path / "sweep" / "sweep.csv")
  assert list(table["status"]) == ["finished"] * 2
  logs = [(tmp_path / "sweep/jobs" / name / "job.log").read_text() for name in sorted(table["job"])]
  assert "2 agents in one program" in logs[0] and f"trained together with {sorted(table['job'])[0]}" in logs[1]
