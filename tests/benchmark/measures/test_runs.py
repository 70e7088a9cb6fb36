"""From the command to the first update: the same command twice, with a cache that is its own."""

import contextlib
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from playground.benchmark.measures import runs
from playground.benchmark.worker import Rows
from playground.config import compose


def test_cold_and_warm_share_a_new_cache_and_nothing_else(monkeypatch: pytest.MonkeyPatch):
  given: list[dict[str, str]] = []

  def run(command: list[str], env: dict[str, str], **_: Any) -> Any:
    words = dict(text.split("=", 1) for text in command if "=" in text and " " not in text)
    words["caches of the user"] = " ".join(sorted(set(env) & set(runs._CACHES)))
    given.append(words)
    folder = Path(words["run_dir"])
    folder.mkdir(parents=True)
    timings = {"trace_s": 1.0, "compile_s": 2.0, "start_to_first_update_s": 3.0}
    manifest = {"impl": "jax", "num_devices": 1, "matmul_precision": "highest", "network_precision": "highest"}
    (folder / "manifest.json").write_text(json.dumps({**manifest, "timings": timings}))
    return contextlib.nullcontext(SimpleNamespace(returncode=0, communicate=lambda: ("", "")))

  settings: list[str] = []
  monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "/somewhere")
  monkeypatch.setattr(runs.signal, "signal", lambda *_: None)
  monkeypatch.setattr(runs.subprocess, "Popen", run)
  monkeypatch.setattr(Rows, "emit", lambda *_, setting: settings.append(setting))
  runs.startup(Rows(), "CartpoleBalance", "ppo", ["agent.num_envs=64"], seconds=1.0)
  cold, warm = given
  assert settings == ["agent.num_envs=64 cold"] * 3 + ["agent.num_envs=64 warm"] * 3
  assert cold["caches of the user"] == "" and cold["hardware.cache_dir"] == warm["hardware.cache_dir"]
  assert cold["run_dir"] != warm["run_dir"] and cold["env"] == "CartpoleBalance" and cold["agent.num_envs"] == "64"
  assert not Path(cold["hardware.cache_dir"]).parent.exists(), "it leaves nothing behind"


def test_one_update_is_the_first_that_learns():
  ppo = compose(["env=CartpoleBalance", "agent=ppo"])
  sac = compose(["env=CartpoleBalance", "agent=sac", "agent.num_envs=16", "agent.min_replay_size=64"])
  assert runs._one_update(ppo) == ppo.agent.batch_size * ppo.agent.num_minibatches * ppo.agent.unroll_length
  assert runs._one_update(sac) == (64 // 16 + 1) * 16
