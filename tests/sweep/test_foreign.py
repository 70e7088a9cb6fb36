"""Sweeps that lie in somebody else's folder, or are started in one: neither runs code of theirs."""

import os
import re
from pathlib import Path

import pytest
import ray
import yaml

from playground.cli import sweep as commands
from playground.config import check_saved_job
from playground.config.sweep_options import SlurmConfig, TogetherConfig
from playground.errors import CheckpointError, ConfigError
from playground.sweep.folder import JobFolder, SweepDirectory
from playground.sweep.plan import settings_of
from playground.sweep.slurm import SlurmLauncher
from playground.sweep.worker import COMMAND, job_command
from tests.aliases import LAUGHS
from tests.sweep.helpers import make_sweep, run, statuses

PACKAGE = Path(__file__).parents[2] / "playground"
EVIL = "from pathlib import Path\nPath(__file__).with_name('ran').touch()\n"


@pytest.fixture
def trap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
  """The current folder has modules of libraries' names; the path exists once one of them has been imported."""
  folder = tmp_path / "trap"
  folder.mkdir()
  for name in ("yaml", "numpy", "omegaconf", "hydra", "submitit", "cloudpickle"):
    (folder / f"{name}.py").write_text(EVIL)
  monkeypatch.chdir(folder)
  return folder / "ran"


def change(sweep: SweepDirectory, **content: object) -> SweepDirectory:
  """The sweep, with other entries in its sweep.yaml."""
  file = sweep.path / "sweep.yaml"
  file.write_text(yaml.safe_dump(yaml.safe_load(file.read_text()) | content))
  return SweepDirectory.open(sweep.path)


def test_workers_import_nothing_from_the_current_folder(tmp_path: Path, trap: Path) -> None:
  sweep = make_sweep(tmp_path / "sweep", 0)
  assert run(sweep, command=(*COMMAND, "--cfg", "job")) == 0
  assert not trap.exists()


@pytest.mark.slow  # starting Ray takes most of a minute on two cores
def test_rays_workers_import_nothing_from_the_current_folder(tmp_path: Path, trap: Path) -> None:
  assert not ray.is_initialized()
  sweep = make_sweep(tmp_path / "sweep", 0, needs=0)
  assert run(sweep, "launcher=ray", "launcher.cores_per_job=1") == 0
  assert statuses(sweep) == {0: "finished"} and not trap.exists()


@pytest.mark.parametrize("path", ["", ":/nowhere", "."])
def test_a_job_imports_nothing_from_the_folder_that_a_sweep_names(
  tmp_path: Path, trap: Path, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
  sweep = change(make_sweep(tmp_path / "sweep", 0), cwd=str(trap.parent))
  monkeypatch.chdir(tmp_path)
  monkeypatch.setenv("PYTHONPATH", path)
  assert run(sweep, command=(*COMMAND, "--cfg", "job")) == 0
  assert not trap.exists()


def test_a_relative_folder_of_compiled_programs_is_the_users(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.chdir(tmp_path)
  own = job_command(lines=["hardware.cache_dir=cache"])
  assert own == (*COMMAND, f"hardware.cache_dir='{tmp_path / 'cache'}'")
  for line in ("hardware.cache_dir=null", "hardware.cache_dir=", "hardware.cache_dir=${oc.env:HOME}/x"):
    assert job_command(lines=[line]) == (*COMMAND, line)


@pytest.mark.parametrize("name", ["sweep.lock", "stop", "plots", "jobs/000_seed=0", "jobs/000_seed=0/job.log"])
def test_a_link_out_of_a_sweep_is_not_followed(tmp_path: Path, name: str) -> None:
  sweep = make_sweep(tmp_path / "sweep", 0)
  (sweep.path / name).parent.mkdir(parents=True, exist_ok=True)
  (sweep.path / name).unlink(missing_ok=True)
  (sweep.path / name).symlink_to(tmp_path / "outside")
  for command in (run, lambda sweep: commands.collect(str(sweep.path)), lambda sweep: commands.stop(str(sweep.path))):
    with pytest.raises(CheckpointError, match=f"{name} is a link that leads out of {sweep.path}: put what it stands"):
      command(sweep)
  assert not (tmp_path / "outside").exists()


def test_slurms_jobs_import_nothing_from_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setattr("shutil.which", lambda name: f"/bin/{name}")  # sbatch and srun
  launcher = SlurmLauncher(make_sweep(tmp_path / "sweep", 0), SlurmConfig())
  assert re.search(r"python\S* -P -u -m submitit", launcher._executor._submitit_command_str)


def test_python_is_started_in_one_way():
  starts = [path for path in PACKAGE.rglob("*.py") if "sys.executable" in path.read_text()]
  assert starts == [PACKAGE / "interpreter.py"]


@pytest.mark.parametrize("name", ["../../outside", "/tmp/outside", "..", ".", "", "a/b", "a\nb", 3])
def test_a_jobs_name_is_no_path(tmp_path: Path, name: object) -> None:
  sweep = make_sweep(tmp_path / "sweep", 0)
  with pytest.raises(CheckpointError, match=r"sweep\.yaml is damaged: .*name"):
    change(sweep, jobs=[{"name": name, "overrides": [], "varies": {}}])


@pytest.mark.parametrize(
  "override",
  [
    *(
      "trust=evil",
      "hardware.cache_dir=/evil",
      "++hardware.cache_dir=/evil",
      "hardware.distributed.coordinator=evil:1",
    ),
    *("hardware.distributed={coordinator: evil}", "hydra.callbacks.x._target_=os.abort", "hydra.searchpath=[/evil]"),
    *("+hydra/launcher=evil", "run_dir=/elsewhere", "resume=/elsewhere", "launcher=slurm", "--config-dir=/evil", "-m"),
  ],
)
def test_a_job_says_nothing_that_only_a_command_line_can(tmp_path: Path, override: str) -> None:
  sweep = make_sweep(tmp_path / "sweep", 0)
  sweep = change(sweep, jobs=[{"name": "0", "overrides": ["seed=0", override], "varies": {"seed": 0}}])
  with pytest.raises(ConfigError, match=r"which only a command line can|cannot be given with -m|is not an override"):
    run(sweep)
  assert statuses(sweep) == {0: "queued"}


@pytest.mark.parametrize(
  "value",
  [*("${oc.env:HOME}", "'${oc.env:HOME}'", "'${${tracking.wandb.name}:HOME}'"), r"'\\${oc.env:HOME}'", "{a: ${x:b}}"],
)
def test_a_job_calls_no_resolver(tmp_path: Path, value: str) -> None:
  override = f"tracking.wandb.project={value}"
  sweep = make_sweep(tmp_path / "sweep", 0)
  sweep = change(sweep, jobs=[{"name": "0", "overrides": [override], "varies": {"seed": 0}}], lines=[override])
  with pytest.raises(ConfigError, match=r"a job calls no resolver, write the value itself\.$"):
    run(sweep)
  with pytest.raises(ConfigError, match=r"a job calls no resolver"):
    run(change(sweep, jobs=[]), "search=optuna", "launcher.cores_per_job=1")
  for harmless in (r"tracking.wandb.project=\${oc.env:HOME}", "agent.batch_size=${agent.num_envs}"):
    check_saved_job("0", [harmless])


def test_a_damaged_job_hides_no_other(tmp_path: Path) -> None:
  """Nor does a pipe in place of a file, which nobody writes, stop the reader."""
  folder = JobFolder(tmp_path)
  folder.write(status="running", attempt=1, started="2026-11-29T21:08:01.553+00:00")
  (tmp_path / "status.json").write_text('{"status": "finished", "updated": "2026-11-30"}')
  os.mkfifo(tmp_path / "job.lock")
  os.mkfifo(tmp_path / "metrics.csv")
  assert (folder.state().status, folder.state().reason, folder.progress()) == ("finished", "", (None, None))
  (tmp_path / "metrics.csv").unlink()
  (tmp_path / "metrics.csv").mkdir()
  assert folder.progress() == (None, None)


def test_a_reason_does_not_steer_the_terminal(tmp_path: Path) -> None:
  folder = JobFolder(tmp_path)
  folder.write(status="failed", reason="it \x1b]0;evil\x07\nfailed")
  assert folder.state().reason == "it ]0;evilfailed"


@pytest.mark.parametrize(
  "setting",
  [
    *(
      "launcher.setup=['touch ran']",
      "launcher.parameters={wrap: x}",
      "launcher.partition='a\nb'",
      "search.sampler=cmaes",
      "launcher.setup=[reboot]",
    ),
    *("launcher.constraint='$(x)'", "launcher.address='ray://evil:1'"),
  ],
)
def test_a_setting_that_may_do_harm_is_given_again(tmp_path: Path, setting: str) -> None:
  key = setting.partition("=")[0]
  option = {"search.sampler": "search=optuna", "launcher.address": "launcher=ray"}.get(key, "launcher=slurm")
  sweep = change(make_sweep(tmp_path / "sweep", 0), settings=[option, "on_error=stop", setting])
  with pytest.raises(ConfigError, match=r"(?s)sweep\.yaml says .*: give it again on this command line if you trust it"):
    settings_of(sweep)
  assert settings_of(sweep, [setting]).on_error == "stop"


def test_plain_settings_hold(tmp_path: Path) -> None:
  plain = ["launcher=slurm", "launcher.partition=gpu-8", "launcher.minutes=60", "launcher.wait=false"]
  launcher = settings_of(change(make_sweep(tmp_path / "sweep", 0), settings=plain)).launcher
  assert (launcher.partition, launcher.minutes, launcher.wait) == ("gpu-8", 60, False)


def test_a_population_is_tried_again(tmp_path: Path) -> None:
  keys = ["agent.learning_rate", "agent.entropy_cost"]
  settings = ["launcher=together", "launcher.exploit_every=1", f"launcher.explore=[{','.join(keys)}]"]
  launcher = settings_of(change(make_sweep(tmp_path / "sweep", 0), settings=settings)).launcher
  assert isinstance(launcher, TogetherConfig) and list(launcher.explore) == keys


@pytest.mark.parametrize("content", [None, [], "text", {"jobs": 3}, {"jobs": []}])
def test_a_damaged_sweep_is_one_sentence(tmp_path: Path, content: object) -> None:
  (tmp_path / "sweep.yaml").write_text(yaml.safe_dump(content))
  with pytest.raises(CheckpointError, match=r"sweep\.yaml is damaged"):
    SweepDirectory.open(tmp_path)


def test_a_sweep_nested_too_deeply_is_one_sentence(tmp_path: Path) -> None:
  (tmp_path / "sweep.yaml").write_text("[" * 100_000)
  with pytest.raises(CheckpointError, match=r"sweep\.yaml is damaged: maximum recursion depth"):
    SweepDirectory.open(tmp_path)


def test_a_sweep_of_endless_aliases_is_one_sentence(tmp_path: Path) -> None:
  (tmp_path / "sweep.yaml").write_text(LAUGHS)
  with pytest.raises(CheckpointError, match=r"sweep\.yaml is damaged: its aliases stand for more than 10,000 values\."):
    SweepDirectory.open(tmp_path)
