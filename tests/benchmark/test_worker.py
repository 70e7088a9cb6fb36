"""The process of a measurement: what it starts ahead, and for which measurements."""

import json
import sys
from typing import Any

import pytest

from playground.benchmark import worker
from playground.benchmark.measures import runs, training
from playground.physics import warp_kernels


@pytest.mark.parametrize(("measure", "stands_by"), [("training", True), ("runs:startup", False)])
def test_training_prestarts_warps_compiler(monkeypatch: pytest.MonkeyPatch, measure: str, stands_by: bool) -> None:
  asked: list[Any] = []
  measured: list[dict[str, Any]] = []
  monkeypatch.setattr(warp_kernels, "prestart", lambda *chosen: asked.append(chosen))
  module, name = (training, "measure") if measure == "training" else (runs, "startup")
  monkeypatch.setattr(module, name, lambda _, **arguments: measured.append(arguments))
  arguments = {"task": "PandaPickCube", "agent": "ppo", "overrides": ["hardware=cpu"], "seeds": [1]}
  job = {"measure": measure, "arguments": arguments, "folder": "none", "cache": True, "shares": False}
  monkeypatch.setattr(sys, "argv", ["worker", json.dumps(job)])
  monkeypatch.setenv("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
  worker.main()
  assert measured == [arguments]
  assert asked == [("warp", "cpu")] * stands_by
