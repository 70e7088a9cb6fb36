"""The console scripts, before their commands are imported."""

import importlib
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from playground.cli import scripts

SCRIPTS = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]["scripts"]


@pytest.mark.parametrize("in_c", [False, True])
@pytest.mark.parametrize("name", SCRIPTS)
def test_ctrl_c_while_a_command_is_imported(name: str, in_c: bool, monkeypatch: pytest.MonkeyPatch) -> None:
  module, _, function = SCRIPTS[name].partition(":")
  script = getattr(importlib.import_module(module), function)

  def interrupted(module: str) -> None:
    assert module.startswith("playground.cli.")
    if in_c:
      raise ImportError("initialization failed") from KeyboardInterrupt()
    raise KeyboardInterrupt

  monkeypatch.setattr(importlib, "import_module", interrupted)
  with pytest.raises(SystemExit) as exited:
    script()
  assert exited.value.code == 130


@pytest.mark.parametrize("closed", ["<&- >&-", "2>&-", "<&- >&- 2>&-"])
def test_standard_streams_may_be_closed(closed: str) -> None:
  script = Path(sys.executable).with_name("playground-run")
  assert subprocess.run(f"{script} --version {closed}", shell=True, check=False).returncode == 0


def test_any_other_error_of_an_import_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setattr(importlib, "import_module", lambda module: (_ for _ in ()).throw(ImportError(module)))
  with pytest.raises(ImportError):
    scripts.run()


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_is_its_command(
  name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  module, _, function = SCRIPTS[name].partition(":")
  monkeypatch.setattr(sys, "argv", [name, "--version"])
  with pytest.raises(SystemExit) as exited:
    getattr(importlib.import_module(module), function)()
  assert not exited.value.code and capsys.readouterr().out.startswith("playground-run ")
