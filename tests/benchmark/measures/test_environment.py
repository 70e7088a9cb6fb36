"""Environment steps alone: how many control steps a call is, and what it counts for."""

from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import pytest

from playground.benchmark.measures import environment
from playground.benchmark.worker import Rows


class Steps(NamedTuple):
  done: jax.Array


def test_every_environment_and_every_repeat_of_an_action_counts(monkeypatch: pytest.MonkeyPatch):
  env = SimpleNamespace(action_size=1, action_repeat=3, reset=lambda keys, model: Steps(jnp.zeros(len(keys))))
  env.step = lambda state, action, model: Steps(state.done + 1)
  trainer = SimpleNamespace(env=env, config=SimpleNamespace(num_envs=4))
  found = SimpleNamespace(trainer=trainer, model={}, key=jax.random.PRNGKey)
  counted: dict[str, Any] = {}

  def rate(call: Any, steps: int, seconds: float) -> tuple[float, float]:
    before = call(1) + 0  # the next call takes the buffer over
    counted.update(steps=steps, taken=(call(2) - before).tolist())
    return 1.0, seconds

  monkeypatch.setattr(environment.Subject, "build", lambda *_: found)
  monkeypatch.setattr(environment, "rate", rate)
  environment.measure(Rows(), "A", "ppo", [], seconds=1.0)
  assert counted == {"steps": 4 * environment.LENGTH * 3, "taken": [2.0 * environment.LENGTH] * 4}
