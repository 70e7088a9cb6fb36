"""From a command line to a sweep on disk."""

import sys
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace

import pytest

from playground.config.sweep_options import LocalConfig, SlurmConfig
from playground.errors import CheckpointError, ConfigError, PlaygroundError
from playground.sweep import local
from playground.sweep.folder import Job, SweepDirectory
from playground.sweep.plan import compose_jobs, plan, settings_of

LINE = ["env=CartpoleBalance,PointMass", "seed=1,2", "agent.max_grad_norm=null,1.0", "debug=fast"]


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
  monkeypatch.chdir(tmp_path)
  return tmp_path


def test_jobs_are_named_after_what_they_differ_in(here: Path) -> None:
  sweep, settings = plan([*LINE, "sweep_dir=mine", "launcher.slots_per_gpu=2"])
  assert sweep.path == Path("mine")
  assert [job.name for job in sweep.jobs][::3] == [
    "000_CartpoleBalance_seed=1_max_grad_norm=null",
    "003_CartpoleBalance_seed=2_max_grad_norm=1",
    "006_PointMass_seed=2_max_grad_norm=null",
  ]
  assert sweep.jobs[3].varies == {"env": "CartpoleBalance", "seed": 2, "agent.max_grad_norm": 1.0}
  assert sweep.jobs[3].overrides == ["env=CartpoleBalance", "seed=2", "agent.max_grad_norm=1.0", "debug=fast"]
  assert {job.steps for job in sweep.jobs} == {320}
  assert {job.needs for job in sweep.jobs} == {None}
  assert settings.launcher == settings_of(sweep).launcher == LocalConfig(slots_per_gpu=2)
  assert isinstance(settings_of(sweep, ["launcher=slurm"]).launcher, SlurmConfig)


def test_a_listed_job_is_named_after_what_it_says_itself(here: Path) -> None:
  jobs = ["env=CartpoleBalance agent.max_grad_norm=2.0", "experiment=cheetah_run seed=4,5"]
  Path("my jobs").mkdir()
  Path("my jobs/these.yaml").write_text(f"params: {{debug: fast, tuned: null}}\njobs: {jobs}\n")
  line = "sweep='my jobs/these.yaml'"
  sweep, _ = plan([line])
  assert sweep.path.parent == Path("results/sweeps/these")
  assert [job.name for job in sweep.jobs] == [
    "000_CartpoleBalance_max_grad_norm=2", "001_cheetah_run_seed=4", "002_cheetah_run_seed=5",
  ]  # fmt: skip
  assert [job.varies["env"] for job in sweep.jobs] == ["CartpoleBalance", "CheetahRun", "CheetahRun"]
  assert [job.task for job in sweep.jobs] == ["CartpoleBalance", "CheetahRun", "CheetahRun"]
  assert plan([line])[0].path == sweep.path  # the same command goes on with it
  with pytest.raises(ConfigError, match="its sweep file cannot list jobs"):
    plan([line, "search=optuna", "agent.learning_rate=interval(1e-4,1e-2)"])


def test_a_run_in_other_words_is_no_second_job(here: Path) -> None:
  line = ["env=CartpoleBalance", "agent.num_timesteps=1e6,1000000,2e6", "seed=1,2"]
  sweep, _ = plan(line)
  assert [job.varies["agent.num_timesteps"] for job in sweep.jobs] == [1_000_000, 1_000_000, 2_000_000, 2_000_000]
  assert [job.varies["seed"] for job in sweep.jobs] == [1, 2, 1, 2]
  assert len(compose_jobs(line)) == 4


def test_a_chain_is_of_its_last_task(here: Path) -> None:
  sweep, _ = plan(["experiment=cartpole_sparse_chain,cartpole_balance", "debug=fast"])
  assert [job.task for job in sweep.jobs] == ["CartpoleSwingupSparse", "CartpoleBalance"]
  stage = "curriculum.stages.sparse.overrides=['env=CartpoleSwingupSparse']"
  line = ["env=CartpoleSwingup,CartpoleBalance", "curriculum=sparse_chain", stage, "agent=fast_sac", "debug=fast"]
  assert {job.varies["env"] for job in plan(line)[0].jobs} == {"CartpoleSwingupSparse"}


def test_the_same_command_finds_its_sweep_again(here: Path) -> None:
  first, _ = plan(["seed=1,2"])
  assert first.path.parent == Path("results/sweeps/quickstart")
  assert plan(["seed=1,2", "launcher.cores_per_job=1"])[0].path == first.path
  assert plan(["seed=1,2,3"])[0].path != first.path
  for job in first.jobs:
    first.folder(job).write(status="finished")
  assert plan(["seed=1,2"])[0].path != first.path, "a finished sweep is done anew"
  assert plan(["seed=1,2", f"sweep_dir={first.path}"])[0].path == first.path, "unless its folder is named"
  with pytest.raises(ConfigError, match="holds a sweep of other jobs"):
    plan(["seed=4,5", f"sweep_dir={first.path}"])


def test_of_two_commands_for_one_new_folder_the_second_writes_nothing(
  here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  check = local.LocalLauncher.check

  def late(config: LocalConfig, jobs: Sequence[Job]) -> None:
    monkeypatch.setattr(local.LocalLauncher, "check", check)
    plan(["seed=1,2", "sweep_dir=mine"])

  monkeypatch.setattr(local.LocalLauncher, "check", late)
  with pytest.raises(CheckpointError, match=r"^sweep_dir=mine became another sweep's while .*: repeat the command\.$"):
    plan(["seed=3,4", "sweep_dir=mine"])
  assert [job.varies for job in SweepDirectory.open("mine").jobs] == [{"seed": 1}, {"seed": 2}]


def test_sweeps_of_one_second_have_folders_of_their_own(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  started, other = datetime(2026, 1, 1), Path("results/sweeps/quickstart/2026-01-01_00-00-00")
  monkeypatch.setattr("playground.sweep.plan.datetime", SimpleNamespace(now=lambda: started))
  exists = Path.exists

  def seen_too_early(path: Path, **kwargs: bool) -> bool:
    there = exists(path, **kwargs)
    if path == other and not there:  # another command makes it right after this one has looked
      path.mkdir(parents=True)
    return there

  monkeypatch.setattr(Path, "exists", seen_too_early)
  assert plan(["seed=1,2"])[0].path == other.with_name(f"{other.name}_2")


def test_a_search_does_not_take_a_grid_for_its_own(here: Path) -> None:
  line = "agent.learning_rate=1e-3,1e-4"
  first, _ = plan([line])
  search = [line, "search=optuna", "search.trials=2"]
  assert (begun := plan(search)[0]).path != first.path
  assert plan(search)[0].path == begun.path


def test_a_shuffled_sweep_goes_on(here: Path) -> None:
  first, _ = plan(["seed=shuffle(range(6))"])
  assert all(plan(["seed=shuffle(range(6))"])[0].path == first.path for _ in range(3))


def test_a_damaged_sweep_does_not_stop_another(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
  first, _ = plan(["seed=1,2"])
  (first.path / "sweep.yaml").write_text("a: 1\n")
  assert plan(["seed=1,2"])[0].path != first.path
  assert f"{first.path / 'sweep.yaml'} is damaged: name is null. It is passed over." in capsys.readouterr().err


def test_what_a_job_needs(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setattr(local, "visible_gpus", list)  # with one, two are refused
  sweep, _ = plan(["hardware=cpu,gpu", "sweep_dir=a"])
  assert [job.needs for job in sweep.jobs] == [0, None]
  assert plan(["hardware.devices=2", "sweep_dir=b"])[0].jobs[0].needs == 2


@pytest.mark.parametrize(
  ("line", "said"),
  [
    ("launcher=slurm", "there is no sbatch here"),
    ("launcher=slurm launcher.minutes=1", r"launcher\.minutes=1 leaves no time to train"),
    ("launcher.gpus=2", r"launcher\.gpus=2, but this machine has 1\."),
    ("launcher.mps=true launcher.slots_per_gpu=2", "nvidia-cuda-mps-control, .* is not on PATH"),
    ("hardware.devices=2", r"asks for hardware\.devices=2, but launcher=local has 1 GPUs"),
  ],
)
def test_nothing_is_written_when_the_launcher_cannot_work(
  here: Path, monkeypatch: pytest.MonkeyPatch, line: str, said: str
) -> None:
  monkeypatch.setenv("PATH", str(here))
  monkeypatch.setattr(local, "visible_gpus", lambda: ["0"])
  with pytest.raises(PlaygroundError, match=said):
    plan(["seed=1,2", *line.split()])
  assert list(here.iterdir()) == []


@pytest.mark.parametrize(("launcher", "module"), [("slurm", "submitit"), ("ray", "ray")])
def test_nothing_is_written_when_the_launcher_is_not_installed(
  here: Path, monkeypatch: pytest.MonkeyPatch, launcher: str, module: str
) -> None:
  monkeypatch.delitem(sys.modules, f"playground.sweep.{launcher}", raising=False)
  monkeypatch.setitem(sys.modules, module, None)
  with pytest.raises(ConfigError, match=rf"^launcher={launcher} needs .*: pip install -e '\.\[{launcher}\]'"):
    plan(["seed=1,2", f"launcher={launcher}"])
  assert list(here.iterdir()) == []


def test_a_sweep_without_a_job_is_refused(here: Path) -> None:
  with pytest.raises(ConfigError, match="This sweep has no job"):
    plan(["seed=range(3,1)"])
  assert list(here.iterdir()) == []


def test_a_sweep_may_be_in_the_home_folder(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setenv("HOME", str(here / "home"))
  assert plan(["seed=1,2", "sweep_dir=~/mine"])[0].path == here / "home/mine"


def test_nothing_is_written_when_a_job_cannot_work(here: Path) -> None:
  with pytest.raises(ConfigError, match=r"^Job experiment=quickstart agent\.num_envs=7: "):
    plan(["agent.num_envs=128,7"])
  assert list(here.iterdir()) == []


@pytest.mark.parametrize(
  ("override", "message"),
  [
    ("action_rate_l2.weight=-0.1,x", r"weight=x: env\.rewards\.action_rate_l2\.weight=x must be a number"),
    ("joint_powr_l1.weight=1,2", r"weight=1: env\.rewards\.joint_powr_l1: no function .* 'joint_power_l1'"),
  ],
)
def test_a_jobs_terms_are_checked_before_anything_is_written(here: Path, override: str, message: str) -> None:
  with pytest.raises(ConfigError, match=f"^Job .*{message}"):
    plan(["env=Go1JoystickFlatTerrain", f"env.rewards.{override}", "sweep_dir=mine"])
  assert not list(here.iterdir())
