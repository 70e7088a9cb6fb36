"""`playground-run`: what it hands to training, what it only shows, and what it says when it cannot."""

import signal
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import pytest
import yaml

from playground.cli.run import main
from playground.config import RunConfig, compose, to_yaml
from playground.errors import HardwareError
from playground.physics import warp_kernels
from playground.sweep.folder import SweepDirectory
from playground.sweep.worker import COMMAND
from tests.command import Command, caller


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[RunConfig]:
  """What training is called with; nothing is trained. Runs in an empty folder."""
  configs: list[RunConfig] = []

  def train(config: RunConfig) -> int:
    configs.append(config)
    if config.seed == 99:
      raise HardwareError("hardware.devices=9: this machine has\n1.")
    if config.seed == 98:
      raise RuntimeError("a bug")
    return 143 if config.seed == 97 else 0

  module = types.ModuleType("playground.runs.train")
  module.train = train  # pyright: ignore[reportAttributeAccessIssue]
  monkeypatch.setitem(sys.modules, "playground.runs.train", module)
  monkeypatch.chdir(tmp_path)
  return configs


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Command:
  return caller(monkeypatch, "playground-run", main)


def test_trains_the_default_run_and_describes_it_in_ten_lines(
  command: Command, trained: list[RunConfig], capsys: pytest.CaptureFixture[str]
):
  assert command() == 0
  (config,) = trained
  assert config.resolved == compose().resolved
  out = capsys.readouterr().out
  assert out.count("\n") <= 10 and "Training CartpoleBalance with ppo" in out and "6,000,000 steps" in out
  assert command("--verbose", "agent.num_envs=128") == 0
  out = capsys.readouterr().out
  assert "num_timesteps: 6000000" in out and "changed    agent.num_envs=128" in out
  assert command("env=Go1JoystickFlatTerrain", "env.rewards.joint_power_l1.weight=-1") == 0
  assert "changed    env.rewards.joint_power_l1.weight=-1" in capsys.readouterr().out
  speed = "env.events.push.params.velocity=[0,1]"
  assert command("env=Go1JoystickFlatTerrain", speed) == 0
  assert "no effect  The event push is off: env.events.push.enabled=true turns it on." in capsys.readouterr().out
  assert command("env=Go1JoystickFlatTerrain", speed, "env.events.push.enabled=true") == 0
  assert "no effect" not in capsys.readouterr().out
  assert command("experiment=go1_joystick_chain") == 0
  assert "slow_turns (100,000,000 steps), fast_turns" in capsys.readouterr().out


def test_prestarts_warps_compiler_for_the_task(
  command: Command, trained: list[RunConfig], monkeypatch: pytest.MonkeyPatch
):
  asked: list[Any] = []
  monkeypatch.setattr(warp_kernels, "prestart", lambda *chosen: asked.append((*chosen, len(trained))))
  assert command("env=PandaPickCube", "hardware=cpu") == 0
  assert asked == [("warp", "cpu", 0)]  # before training begins


def test_leaves_nothing_of_hydras_behind(command: Command, trained: list[RunConfig], tmp_path: Path):
  assert command("env=CartpoleSwingup", "agent.num_timesteps=1e6", "tuned=null") == 0
  assert trained[0].agent.num_timesteps == 1_000_000
  assert trained[0].choices["tuned"] is None
  assert list(tmp_path.iterdir()) == []


def test_resumes(command: Command, trained: list[RunConfig], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
  run = tmp_path / "a run, 1"
  run.mkdir()
  (run / "config.yaml").write_text(to_yaml(compose(["env=CartpoleSwingup", "seed=5"])))
  assert command(f"resume='{run}'", "hardware=cpu") == 0
  assert (trained[0].seed, trained[0].resume, trained[0].hardware.platform) == (5, str(run), "cpu")
  capsys.readouterr()
  assert command(f"resume='{run}'", "--cfg", "job") == 0
  assert "seed: 5\n" in capsys.readouterr().out
  assert len(trained) == 1


@pytest.mark.parametrize(
  ("args", "shown"),
  [
    (["--cfg", "job"], ["num_envs: 256\n", "num_timesteps: 6000000\n"]),
    (["agent.num_timesteps=2e6", "--cfg", "job", "agent.num_envs=64"], ["num_envs: 64\n", "num_timesteps: 2000000\n"]),
    (["env=CartpoleBalance", "--cfg", "job", "--package", "agent"], ["num_envs: 2048\n"]),
    (["experiment=go1_joystick_chain", "--cfg", "job"], ["stages:\n    slow_turns:\n", "    rough:\n"]),
    (["--help"], ["experiment=go1_joystick", "ppo, ppo_paper", "init_from", "--cfg job", "56, such as "]),
    (["--help", "agent.learning_rate"], ["agent.learning_rate", "a number above 0"]),
    (["--help", "video", "env=CheetahRun"], ["video.visuals", "whether videos are recorded"]),
    (["--info", "searchpath"], ["configs"]),
    (["--info"], ["Config search path"]),
    (["-m", "seed=1,2", "--cfg", "job", "--package", "seed"], ["seed=1\n1\n---\n", "seed=2\n2\n"]),
  ],
)
def test_shows_and_does_not_train(
  command: Command, trained: list[RunConfig], capsys: pytest.CaptureFixture[str], args: list[str], shown: list[str]
):
  assert command(*args) == 0
  out = capsys.readouterr().out
  for text in shown:
    assert text in out
  assert trained == []


@pytest.mark.parametrize(
  ("args", "message"),
  [
    (["experiment=quickstar"], "error: experiment=quickstar does not exist: choose from"),
    (["agent.learning_rate=fast", "--cfg", "job"], "error: agent.learning_rate=fast has the wrong type"),
    (["agent.num_envs=1,2"], "add -m"),
    (["seed=99"], "error: hardware.devices=9: this machine has 1."),
    (["-m", "seed=1", "env=Gone"], "error: "),
    (["-m", "agent.num_envs=0"], "error: agent.num_envs=0 must be a whole number from 1 to"),
    (["-m", "sweep=dm_control_pop"], "error: sweep=dm_control_pop does not exist: choose from dm_control_ppo, "),
    (["-m", "seed=range(3,1)", "--cfg", "job"], "error: This sweep has no job: one of its keys has no value."),
    (["launcher=ray"], "launcher=ray is about a sweep: add -m"),
    (["-m", "agent.num_envs=128,7"], "error: Job experiment=quickstart agent.num_envs=7: agent.num_envs=7 does not"),
    (["-m", "agent.learning_rate=interval(0,1)"], "is a range to draw from: add search=optuna"),
    (["-m", "seed=1,2", "--cfg", "all"], "--cfg all shows one run: leave -m out"),
    (["-m", "sweep=dm_control_ppo", "--dry-run"], "error: --dry-run is no option"),
    (["--seed", "3"], "error: --seed is no option"),
    (["--resolve"], "error: --resolve goes with --cfg job"),
    (["--package", "agent"], "error: --package goes with --cfg job"),
    (["--package", "x", "--cfg", "job"], "error: --package x: the configuration has no such key."),
    (["--experimental-rerun", "x"], "error: --experimental-rerun is no option"),
    (["--config-dir", "x"], "error: --config-dir is no option"),
    (["--config-name", "x"], "error: --config-name is no option"),
    (["-sc", "x"], "error: --shell-completion takes install=<shell>"),
    (["--cfg", "x"], "error: argument --cfg/-c: invalid choice: 'x'"),
    (["--cfg"], "error: argument --cfg/-c: expected one argument"),
    (["-m", "seed=1,2", "sweep_dir=" + "a" * 300], "File name too long"),
    (["resume=" + "a" * 300 + "/run"], "File name too long"),
    (["hardware.kind=5"], "error: hardware.kind=5 has the wrong type: it must be text"),
    (["video.camera=5"], "error: video.camera=5 has the wrong type: it must be text"),
    (["agent.name=sac"], "error: agent.name=sac cannot be set: agent=<name> chooses it"),
    (["sweep=dm_control_ppo"], "add -m, as in `playground-run -m sweep=dm_control_ppo`."),
  ],
)
def test_errors_are_one_sentence_and_exit_2(
  command: Command, trained: list[RunConfig], capsys: pytest.CaptureFixture[str], args: list[str], message: str
):
  assert command(*args) == 2
  sentences = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
  assert len(sentences) == 1
  assert message in sentences[0]


def test_a_bug_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch, trained: list[RunConfig]):
  monkeypatch.setattr(sys, "argv", ["playground-run", "seed=98"])
  with pytest.raises(RuntimeError, match="a bug"):
    main()


def test_exit_code_is_trainings(command: Command, trained: list[RunConfig]):
  assert command("seed=97") == 143


def test_multirun_shows_every_job(command: Command, trained: list[RunConfig], capsys: pytest.CaptureFixture[str]):
  assert command("-m", "tuned=null", "seed=1,2", "--cfg", "job") == 0
  jobs = list(yaml.safe_load_all(capsys.readouterr().out))
  assert [(job["name"], job["seed"]) for job in jobs] == [("quickstart", 1), ("quickstart", 2)]
  assert {job["choices"]["tuned"] for job in jobs} == {None}
  assert trained == []


def test_multirun_is_a_sweep(command: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
  swept: list[tuple[SweepDirectory, Any, Any]] = []
  monkeypatch.setattr("playground.sweep.runner.run_sweep", lambda *args: swept.append(args) or 3)
  monkeypatch.chdir(tmp_path)
  line = ["sweep=dm_control_ppo", "env=glob(Cartpole*Sparse)", "seed=range(2)", "debug=fast", "launcher.timeout=9"]
  assert command("-m", *line) == 3
  ((sweep, settings, job_command),) = swept
  assert job_command == COMMAND
  assert settings.launcher.timeout == 9
  assert [job.overrides[:2] for job in sweep.jobs[:2]] == [["agent=ppo", "env=CartpoleBalanceSparse"]] * 2
  assert [job.varies["seed"] for job in sweep.jobs] == [0, 1, 0, 1]
  assert sweep.path.parent == Path("results/sweeps/dm_control_ppo")
  assert command("-m", *line) == 3
  assert swept[1][0].path == sweep.path, "not finished, so it goes on"
  assert command("-m", *line, "hardware.cache_dir=fast", "hydra.verbose=true", "trust=[mine,theirs]") == 3
  own = [f"hardware.cache_dir='{tmp_path / 'fast'}'", "hydra.verbose=true"]  # jobs may start in another folder
  assert swept[2][0].path == sweep.path and swept[2][2] == (*COMMAND, "trust=[mine,theirs]", *own)
  assert not any(word in (sweep.path / "sweep.yaml").read_text() for word in ("cache", "hydra.", "mine"))
  assert command("-m", *line, "hardware.cache_dir=/a,/b") == 2


def test_a_mistake_is_reported_before_jax_is_imported():
  code = "import sys; from playground.cli.run import main\ntry: main()\nfinally: assert 'jax' not in sys.modules"
  done = subprocess.run([sys.executable, "-c", code, "env=Gone"], capture_output=True, text=True)
  assert done.returncode == 2
  assert done.stderr.startswith("error: env=Gone does not exist")
  assert done.stderr.count("\n") == 1


def test_a_crash_outside_python_prints_where():
  code = """import os, signal
from playground.cli import run
def crashes(_):
  os.kill(os.getpid(), signal.SIGSEGV)
run._main = crashes
run.main()"""
  done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
  assert done.returncode == -signal.SIGSEGV
  assert "Segmentation fault" in done.stderr and "in crashes" in done.stderr
