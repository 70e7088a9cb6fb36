"""Calls a command of ours as the shell would, in this process."""

import sys
from collections.abc import Callable

import pytest

Command = Callable[..., int]


def caller(monkeypatch: pytest.MonkeyPatch, program: str, main: Callable[[], None]) -> Command:
  """A function that runs `program` with the arguments it is given and returns the exit code."""

  def call(*args: str) -> int:
    monkeypatch.setattr(sys, "argv", [program, *args])
    with pytest.raises(SystemExit) as exit_:
      main()
    assert isinstance(exit_.value.code, int)
    return exit_.value.code

  return call
