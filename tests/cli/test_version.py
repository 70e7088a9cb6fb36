"""`--version` of every command."""

from collections.abc import Callable

import pytest

from playground import __version__
from playground.cli import bench, main, run
from tests.command import caller


@pytest.mark.parametrize(
  ("program", "command"),
  [("playground-run", run.main), ("playground", main.main), ("playground-bench", bench.main)],
)
def test_prints_the_version_of_this_package(
  program: str,
  command: Callable[[], None],
  monkeypatch: pytest.MonkeyPatch,
  capsys: pytest.CaptureFixture[str],
) -> None:
  assert caller(monkeypatch, program, command)("--version") == 0
  assert capsys.readouterr().out == f"playground-run {__version__}\n"


@pytest.mark.parametrize("name", ["train", "bench", "list", "play"])
def test_every_subcommand_prints_it(
  name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  assert caller(monkeypatch, "playground", main.main)(name, "--version") == 0
  assert capsys.readouterr().out == f"playground-run {__version__}\n"
