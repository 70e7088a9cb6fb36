"""Somebody else's files run no code: what they name is refused before it is imported."""

import json
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from playground import registry, trust
from playground.cli.main import main
from playground.cli.run import main as run_main
from playground.config import compose, from_saved
from playground.errors import ConfigError
from playground.mdp.managers import CommandManager
from tests.command import caller
from tests.deploy.untrained import UntrainedRun
from tests.runs.helpers import make_run

EVIL = """
from pathlib import Path
Path(__file__).with_name("imported").touch()
from playground.envs.dm_control.cartpole import Cartpole
class Task(Cartpole): pass
"""
AWK = {"task": "subprocess:Popen", "args": ["awk", 'BEGIN { system("touch ran") }']}
Refused = Callable[..., str]


@pytest.fixture
def evil(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
  """A module `evil.tasks` that can be imported; the path exists once it has been."""
  package = tmp_path / "site" / "evil"
  package.mkdir(parents=True)
  (package / "__init__.py").touch()
  (package / "tasks.py").write_text(EVIL)
  monkeypatch.syspath_prepend(package.parent)
  monkeypatch.setattr(trust, "_named", set())
  yield package / "imported"
  for name in [name for name in sys.modules if name.partition(".")[0] == "evil"]:
    del sys.modules[name]


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
  """A run's directory with its exported policy."""
  path = tmp_path_factory.mktemp("trust") / "run"
  UntrainedRun(path, "CartpoleBalance", "debug=fast", "env.episode_length=40").save(100)
  with pytest.MonkeyPatch.context() as patched:
    assert caller(patched, "playground", main)("export", str(path)) == 0
  return path


@pytest.fixture
def run(original: Path, tmp_path: Path) -> Path:
  """The same, to be changed."""
  return shutil.copytree(original, tmp_path / "run", symlinks=True)


def change(file: Path, **env: Any) -> None:
  """Changes the env section that a file holds."""
  content = yaml.safe_load(file.read_text())
  content["env"] |= env
  file.write_text(yaml.safe_dump(content))


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Refused:
  """Calls a command, which must end with exit code 2 and one sentence; returns that."""

  def call(program: str, *args: str) -> str:
    capsys.readouterr()
    assert caller(monkeypatch, program, main if program == "playground" else run_main)(*args) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: ")
    return lines[0]

  return call


def test_a_module_that_is_not_trusted_is_not_imported(evil: Path):
  with pytest.raises(ConfigError, match=r"env\.task=evil\.tasks:Task is refused: .* add trust=evil \(--trust evil"):
    registry.task_class("evil.tasks:Task")
  assert not evil.exists() and "evil" not in sys.modules
  trust.trust("evil.other", "evil.tas")
  with pytest.raises(ConfigError, match="is refused"):
    registry.task_class("evil.tasks:Task")
  trust.trust("evil")
  assert registry.task_class("evil.tasks:Task").__name__ == "Task"  # pyright: ignore[reportFunctionMemberAccess]
  assert evil.exists()


@pytest.mark.parametrize(
  "spec",
  [
    *("subprocess:Popen", "playground.rendering.gl:subprocess", "playground.sweep.mps:Path", "os:system"),
    *("playground_evil:Task", ".playground:Task", "playground..errors:nearest", "playground.rendering.gl:os.system"),
    *("playground.rendering.gl:__builtins__", "playground/envs:Task", "", ":", "playground:", None, 3),
    # Of this package, and with arguments that `params` of a command could set:
    *("playground.benchmark.measures.runs:run_training", "playground.benchmark.peer:check_peer"),
    *("playground.files:write_text", "playground.cli.sweep:retry", "playground.trust:trust"),
  ],
)
def test_what_is_never_trusted(spec: Any):
  with pytest.raises(ConfigError, match=r"^key=.* (is refused|is not of the form)"):
    trust.trusted_object("key", spec)


def test_a_command_calls_no_other_function_of_this_package(tmp_path: Path):
  program = tmp_path / "program"
  program.write_text(f"#!/bin/sh\ntouch {tmp_path / 'ran'}\n")
  program.chmod(0o755)
  params = {"peer": "playground020", "python": str(program), "path": "", "menagerie": ""}
  trust.trust("playground")  # changes nothing: only tasks and terms may be named
  with pytest.raises(ConfigError, match=r"commands\.x\.func=.* is refused: of playground, .* only name"):
    CommandManager({"x": {"func": "playground.benchmark.peer:check_peer", "params": params}}, None)
  assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("name", ["", "a b", "a-b", "a:b", ".", None, 3])
def test_what_no_package_is_called(name: Any):
  with pytest.raises(ConfigError, match=r"^trust=.* is not the name of a package"):
    trust.trust(name)


def test_the_command_line_follows_the_rule(evil: Path, tmp_path: Path, refused: Refused):
  args = ["env=CartpoleBalance", "debug=fast", "hardware=cpu", f"run_dir={tmp_path / 'new'}"]
  assert "env.task=evil.tasks:Task is refused" in refused("playground-run", *args, "env.task=evil.tasks:Task")
  assert "subprocess:Popen is refused" in refused("playground-run", *args, "env.task=subprocess:Popen")
  assert not evil.exists()
  assert "trust=a,b: write trust=[a,b]" in refused("playground-run", *args, "trust=a,b")
  assert "trust=a:b is not the name" in refused("playground-run", *args, "trust='a:b'")
  sub = refused("playground-run", *args, "env.task=subprocess:Popen", "trust=subprocess")
  assert "env.task=subprocess:Popen is no task" in sub
  assert "trust=evil" in refused("playground", "show", "CartpoleBalance", "env.task=evil.tasks:Task")


def test_the_user_may_trust_a_package(evil: Path, monkeypatch: pytest.MonkeyPatch):
  command = caller(monkeypatch, "playground", main)
  assert command("show", "CartpoleBalance", "env.task=evil.tasks:Task", "--trust", "evil") == 0
  assert evil.exists()


def test_a_run_of_somebody_else(evil: Path, run: Path, refused: Refused, monkeypatch: pytest.MonkeyPatch):
  config = yaml.safe_load((run / "config.yaml").read_text())
  np.savez(
    run / "dump.npz", action=0, config=json.dumps({**config, "env": {**config["env"], "task": "evil.tasks:Task"}})
  )
  change(run / "config.yaml", task="evil.tasks:Task")
  for command in ("eval", "export", "play"):
    assert "env.task=evil.tasks:Task is refused" in refused("playground", command, str(run))
  assert "is refused" in refused("playground", "replay", str(run / "dump.npz"))
  assert "is refused" in refused("playground-run", f"resume={run}")
  assert not evil.exists()
  assert caller(monkeypatch, "playground", main)("eval", str(run), "--episodes", "1", "--trust", "evil") == 0


def test_a_policy_of_somebody_else(evil: Path, run: Path, refused: Refused, monkeypatch: pytest.MonkeyPatch):
  policy = run / "export" / "policy.onnx"
  change(policy.with_suffix(".yaml"), task="evil.tasks:Task")
  assert "env.task=evil.tasks:Task is refused" in refused("playground", "play", str(policy))
  monkeypatch.chdir(run)
  change(policy.with_suffix(".yaml"), **AWK)
  assert "env.task=subprocess:Popen is refused" in refused("playground", "play", str(policy))
  assert not evil.exists() and not (run / "ran").exists()


def test_what_a_saved_configuration_cannot_set(original: Path, tmp_path: Path):
  resolved = yaml.safe_load((original / "config.yaml").read_text())
  resolved["hardware"] |= {"cache_dir": "/evil"}
  resolved["hardware"]["distributed"] |= {"coordinator": "evil:1", "timeout": 5.0}
  found = from_saved(resolved).hardware
  assert (found.cache_dir, found.distributed.coordinator, found.distributed.timeout) == (None, None, 5.0)
  saved = tmp_path / "config.yaml"
  saved.write_text(yaml.safe_dump(resolved))
  found = compose([f"resume={tmp_path}", "hardware.distributed.process_id=1"]).hardware
  assert (found.cache_dir, found.distributed.coordinator) == (None, None)
  assert compose([f"resume={tmp_path}", "hardware.cache_dir=/mine"]).hardware.cache_dir == "/mine"
  resolved["hardware"]["xla_flags"] = "--xla_gpu_cuda_data_dir=/evil"
  saved.write_text(yaml.safe_dump(resolved))
  with pytest.raises(ConfigError, match="xla_flags=--xla_gpu_cuda_data_dir=/evil is refused"):
    compose([f"resume={tmp_path}"])


def test_a_saved_configuration_asks_for_nothing(original: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
  monkeypatch.setenv("SECRET", "secret")
  resolved = yaml.safe_load((original / "config.yaml").read_text())
  resolved["tracking"]["wandb"]["project"] = "${oc.env:SECRET}"
  (tmp_path / "config.yaml").write_text(yaml.safe_dump(resolved))
  run = compose([f"resume={tmp_path}", "tracking.wandb.name=x"])
  assert (run.tracking.wandb.project, run.tracking.wandb.name) == ("${oc.env:SECRET}", "x")
  env = {**resolved["env"], "impl": "${oc.env:SECRET}"}
  with pytest.raises(ConfigError, match=r"env\.impl=\$\{oc\.env:SECRET\} is unknown"):
    registry.load("CartpoleBalance", config=env)


@pytest.mark.parametrize("flags", ["--xla_gpu_deterministic_ops=true --xla_gpu_autotune_level=0", "--xla_foo", ""])
def test_flags_that_are_allowed(flags: str):
  assert compose(["env=CartpoleBalance", f"hardware.xla_flags='{flags}'"]).hardware.xla_flags == flags


@pytest.mark.parametrize(
  "flag",
  [
    *("--xla_dump_to=/tmp/x", "--xla_gpu_cuda_data_dir=1", "--xla_backend_extra_options=xla_foo", "/tmp/flags"),
    *("--xla_foo=bar", "--flagfile=1", "'--xla_foo=true'", "--xla_gpu_kernel_cache_file=1"),
  ],
)
def test_flags_that_are_refused(flag: str):
  with pytest.raises(ConfigError, match="is refused: they must be switches and numbers"):
    compose(["env=CartpoleBalance", f'hardware.xla_flags="--xla_ok=true {flag}"'])


def test_a_saved_chains_stage_is_no_path(tmp_path: Path) -> None:
  chain = compose(["experiment=hopper_hop_chain"]).resolved
  stages = {"1": {"num_timesteps": 1, "overrides": []}, "x/../../mine": {"num_timesteps": 1, "overrides": []}}
  path = make_run(tmp_path / "theirs", {**chain, "curriculum": {**chain["curriculum"], "stages": stages}}).path
  with pytest.raises(ConfigError, match=r"stages\.x/\.\./\.\./mine: a stage's name is that of a folder"):
    compose([f"resume={path}"])
