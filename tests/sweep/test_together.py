"""Which jobs of a sweep `launcher=together` gives one process, and such a sweep as users start it."""

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from playground.cli.run import main
from playground.config import compose
from playground.config.sweep_options import TogetherConfig
from playground.errors import ConfigError
from playground.runs.run_dir import RunDirectory
from playground.sweep.folder import Job, SweepDirectory
from playground.sweep.local import LocalLauncher, Slot
from playground.sweep.together import TogetherLauncher
from tests.processes import WITHOUT_WARP
from tests.runs.helpers import TASK, make_run
from tests.sweep.helpers import STUB, run


def make(path: Path, *overrides: str) -> SweepDirectory:
  jobs = [Job(f"{i:03d}", ["tuned=null", *text.split()], {}) for i, text in enumerate(overrides)]
  return SweepDirectory.create(path, "test", [], [], [], jobs)


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
  """The names of the jobs of each process that is started."""
  found: list[list[str]] = []

  def start(self: LocalLauncher, jobs: Sequence[Job], options: Sequence[str]) -> bool:
    found.append([*options, *(job.name for job in jobs)])
    self._workers |= dict.fromkeys(job.name for job in jobs)  # pyright: ignore
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


def test_jobs_of_one_program_stay_together_where_other_jobs_fill_the_slots(
  tmp_path: Path, started: list[list[str]]
) -> None:
  sweep = make(tmp_path, "seed=1", "seed=2", "env=PendulumSwingup seed=1", "env=PendulumSwingup seed=2")
  launcher = TogetherLauncher(sweep, TogetherConfig(), slots=[Slot(i, None, ()) for i in range(2)])
  assert all(launcher.start(job) for job in sweep.jobs)
  assert started == [["000", "001"], ["002", "003"]]


@pytest.mark.parametrize(("needs", "groups"), [(4, 1), (2, 2), (None, 4)])
def test_jobs_of_several_gpus_share_processes_that_run_side_by_side(
  tmp_path: Path, started: list[list[str]], monkeypatch: pytest.MonkeyPatch, needs: int | None, groups: int
) -> None:
  monkeypatch.setattr("playground.sweep.local.visible_gpus", lambda: ["0", "1", "2", "3"])
  jobs = [Job(f"{i:03d}", ["tuned=null", f"seed={i}"], {}, needs) for i in range(8)]
  sweep = SweepDirectory.create(tmp_path, "test", [], [], [], jobs)
  launcher = TogetherLauncher(sweep, TogetherConfig())
  assert all(launcher.start(job) for job in jobs)
  assert [len(names) for names in started] == [8 // groups] * groups


def test_finished_jobs_are_left_out_and_a_search_adds_jobs(tmp_path: Path, started: list[list[str]]) -> None:
  sweep = make(tmp_path, "seed=1", "seed=2", "seed=3")
  sweep.folder(sweep.jobs[0]).write(status="finished")
  launcher = TogetherLauncher(sweep, TogetherConfig(cores_per_job=1000))
  new = Job("new", ["tuned=null", "seed=4"], {})
  sweep.add(new)
  assert launcher.start(sweep.jobs[1]) and launcher.start(sweep.jobs[2]) and launcher.start(new)
  assert started == [["001", "002"], ["new"]]


def test_a_population_is_one_process(tmp_path: Path, started: list[list[str]]) -> None:
  sweep = make(tmp_path, *(f"seed={i}" for i in range(4)))
  explore = ["agent.learning_rate", "agent.entropy_cost"]
  settings = TogetherConfig(exploit_every=2, explore=explore, cores_per_job=1)
  launcher = TogetherLauncher(sweep, settings)
  assert all(launcher.start(job) for job in sweep.jobs)
  assert started == [["--exploit-every=2", *(f"--explore={key}" for key in explore), "000", "001", "002", "003"]]


@pytest.mark.parametrize(
  ("jobs", "settings", "message"),
  [
    (["seed=1"], {}, "needs two or more jobs"),
    (["seed=1", "seed=2 agent.num_envs=64"], {}, "differ in more than seeds and numbers"),
    (["seed=1", "seed=2 env.events.damping.params.range=[0.8,1.2]"], {}, "need the same env"),
    (["seed=1", "seed=2"], {"explore": ["agent.num_envs"]}, "launcher.explore=agent.num_envs must be one of agent.l"),
    (["seed=1 agent.desired_kl=0.01", "seed=2 agent.desired_kl=0.01"], {}, "has no effect with agent.desired_kl"),
    (["seed=1", "seed=2 checkpoint.keep=2"], {}, "differ in more than seeds and numbers"),
    (["seed=1 checkpoint.keep=2", "seed=2 checkpoint.keep=2"], {}, "checkpoint.keep=2 must be 3 or more with launcher"),
    (["seed=1 agent.num_evals=3", "seed=2 agent.num_evals=3"], {}, "agent.num_evals=3 must be 4 or more with launcher"),
    (["seed=1"], {"exploit_every": 0, "explore": ["agent.tau"]}, "launcher.explore=[agent.tau] needs launcher."),
    (["seed=1", "seed=2", "seed=3"], {"max_agents": 2}, "launcher.max_agents=2 is below the 3 jobs"),
  ],
)
def test_what_is_no_population(jobs: list[str], settings: dict[str, Any], message: str, tmp_path: Path) -> None:
  damping = "env.events.damping={mode:startup,func:model_field}"
  params = "env.events.damping.params={field:dof_damping,target:all,operation:scale,range:[0.9,1.1]}"
  listed = [Job(text, ["tuned=null", damping, params, *text.split()], {}) for text in jobs]
  with pytest.raises(ConfigError, match=re.escape(message)):
    TogetherLauncher.check(TogetherConfig(**{"exploit_every": 2, **settings}), listed)


GROUP = f"""
import itertools, subprocess, sys
for apart, run in itertools.groupby(sys.argv[1:], "--".__eq__):
  if not apart:
    subprocess.run([*{STUB!r}, *run], check=True)
"""  # does what the stub does for each of the runs


def test_one_process_does_the_jobs_of_a_group(tmp_path: Path) -> None:
  sweep = make(tmp_path / "sweep", "seed=1", "seed=2")
  assert run(sweep, "launcher=together", command=(sys.executable, "-c", GROUP)) == 0
  assert [state.status for state in sweep.states().values()] == ["finished"] * 2
  first, second = (sweep.folder(job) for job in sweep.jobs)
  assert first.record["job_pid"] == second.record["job_pid"]
  assert "trained together with 000" in second.log.read_text()
  assert list(pd.read_csv(sweep.path / "sweep.csv")["final_return"]) == [2.0, 3.0]


def test_a_process_that_trained_nothing_finished_nothing(tmp_path: Path) -> None:
  sweep = make(tmp_path / "sweep", "seed=1", "seed=2")
  assert run(sweep, "launcher=together", command=(sys.executable, "-c", "print('nothing')")) == 2
  assert [state.status for state in sweep.states().values()] == ["failed"] * 2
  assert {sweep.folder(job).record["reason"] for job in sweep.jobs} == {"exit code 0: nothing"}


def test_jobs_are_composed_where_they_run(
  tmp_path: Path, started: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
  monkeypatch.chdir(tmp_path)
  store = make_run(tmp_path / "mine", compose(TASK).resolved).checkpoints
  (store / f"{400:012d}").mkdir(parents=True)
  sweep = make(tmp_path / "sweep", "seed=1 init_from=mine", "seed=2 init_from=mine", "seed=3")
  RunDirectory(sweep.folder(sweep.jobs[2]).path).path.mkdir(parents=True)
  (sweep.folder(sweep.jobs[2]).path / "config.yaml").write_text("a: 1\n")  # of no run: the job fails alone
  monkeypatch.chdir("/")
  launcher = TogetherLauncher(sweep, TogetherConfig(cores_per_job=1000))
  assert all(launcher.start(job) for job in sweep.jobs)
  assert started == [["000", "001"], ["002"]]


LOST = f"""
import itertools, pathlib, shutil, subprocess, sys
runs = [list(run) for apart, run in itertools.groupby(sys.argv[1:], "--".__eq__) if not apart]
for run in runs:
  folder = pathlib.Path(run[-1].partition("=")[2].strip("'"))
  if folder.name == {{lost!r}}:
    shutil.rmtree(folder)
    print(f"{{{{folder.name}}}} failed: {{{{folder}}}} cannot be written.", flush=True)
  else:
    subprocess.run([*{STUB!r}, *run], check=True)
print("video       none")
sys.exit(2)
"""


@pytest.mark.parametrize("lost", ["000", "001"])
def test_a_removed_folder_costs_the_others_nothing(tmp_path: Path, lost: str) -> None:
  """That of the first job has the log of the group."""
  sweep = make(tmp_path / "sweep", "seed=1", "seed=2", "seed=3")
  assert run(sweep, "launcher=together", command=(sys.executable, "-c", LOST.format(lost=lost))) == 1
  records = {job.name: sweep.folder(job).record for job in sweep.jobs}
  expected = {"000": "finished", "001": "finished", "002": "finished", lost: "failed"}
  assert {name: record["status"] for name, record in records.items()} == expected
  said = "exit code 2: no output" if lost == "000" else f"{sweep.path / 'jobs' / lost} cannot be written."
  assert records[lost]["reason"] == said


def test_a_job_that_failed_before_the_others_were_stopped_says_so(tmp_path: Path) -> None:
  sweep = make(tmp_path / "sweep", "seed=1", "seed=2")
  group = "import time\nprint('001 failed: it is damaged.', flush=True)\ntime.sleep(60)"
  assert run(sweep, "launcher=together", "launcher.timeout=2", command=(sys.executable, "-c", group)) == 2
  records = {job.name: sweep.folder(job).record for job in sweep.jobs}
  found = {name: (record["status"], record["reason"]) for name, record in records.items()}
  assert found == {"000": ("timeout", "took longer than launcher.timeout=2 s"), "001": ("failed", "it is damaged.")}


@pytest.mark.slow
def test_a_sweep_of_one_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  sweep = ["-m", *TASK, "agent.num_timesteps=200", "seed=1,2", "launcher=together", f"sweep_dir={tmp_path / 'sweep'}"]
  monkeypatch.setattr("sys.argv", ["playground-run", *sweep])
  monkeypatch.setenv("PYTHONPATH", WITHOUT_WARP["PYTHONPATH"])
  with pytest.raises(SystemExit) as exit_:
    main()
  assert exit_.value.code == 0
  table = pd.read_csv(tmp_path / "sweep" / "sweep.csv")
  assert list(table["status"]) == ["finished"] * 2
  logs = [(tmp_path / "sweep/jobs" / name / "job.log").read_text() for name in sorted(table["job"])]
  assert "2 agents in one program" in logs[0] and f"trained together with {sorted(table['job'])[0]}" in logs[1]
