"""Training at full speed: every seed its own beginning, and what comes before the clock."""

from types import SimpleNamespace
from typing import Any

import pytest

from playground.benchmark.measures import training
from playground.benchmark.worker import Rows
from playground.config import compose


@pytest.mark.parametrize(("agent", "before"), [("ppo", 1), ("sac", 1 + 64 // 16)])
def test_a_seed_begins_anew_and_warms_up_before_the_clock(monkeypatch: pytest.MonkeyPatch, agent: str, before: int):
  sizes = ["agent.num_envs=16", "agent.min_replay_size=64"] if agent == "sac" else []
  config = compose(["env=CartpoleBalance", f"agent={agent}", *sizes]).agent
  done: list[Any] = []

  def train(state: Any, model: Any, count: Any) -> tuple[Any, Any]:
    done.append(("train", state, model, int(count)))
    return state, {"nonfinite": 0}

  def timed(call: Any, steps: int, seconds: float) -> tuple[float, float]:
    done.append("clock")
    return 1.0, seconds

  program = SimpleNamespace(trace_s=1.0, compile_s=1.0, model="model 3", train=train)
  program.init = lambda key, model, policy, settings: f"{key} {model}"
  found = SimpleNamespace(
    trainer=SimpleNamespace(config=config, steps_per_update=1, settings={}),
    key=lambda seed: f"key {seed}",
    draw=lambda seed: (f"model {seed}", None),
  )
  monkeypatch.setattr(training.Subject, "build", lambda rows, *_: rows.update(conditions="") or found)
  monkeypatch.setattr(training, "compile_program", lambda *_: program)
  monkeypatch.setattr(training, "rate", timed)
  training.measure(Rows(), "CartpoleBalance", agent, [], seeds=[3, 4], seconds=1.0)
  assert done == [
    ("train", "key 3 model 3", "model 3", before), "clock",
    ("train", "key 4 model 4", "model 4", before), "clock",
  ]  # fmt: skip
