"""The console scripts, before their commands are imported."""

import importlib
import sys
import tomllib
from pathlib import Path

import pytest

SCRIPTS = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]["scripts"]


@pytest.mark.parametrize("name", SCRIPTS)
def test_ctrl_c_while_a_command_is_imported(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
  module, _, function = SCRIPTS[name].partition(":")
  script = getattr(importlib.import_module(module), function)

  def interrupted(module: str) -> None:
    assert module.startswith("playground.cli.")
    raise KeyboardInterrupt

  monkeypatch.setattr(importlib, "import_module", interrupted)
  with pytest.raises(SystemExit) as exited:
    script()
  assert exited.value.code == 130


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_is_its_command(
  name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  module, _, function = SCRIPTS[name].partition(":")
  monkeypatch.setattr(sys, "argv", [name, "--version"])
  with pytest.raises(SystemExit) as exited:
    getattr(importlib.import_module(module), function)()
  assert not exited.value.code and capsys.readouterr().out.startswith("playground-run ")
