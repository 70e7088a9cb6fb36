"""Runs whose physics outgrow Warp's buffers: counted, and said once."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from playground import registry
from playground.config import compose
from playground.envs.base import State
from playground.envs.wrappers import wrap_for_training
from playground.learning.rollout import episode_sums
from playground.physics.backend import BufferUse
from playground.runs.train import train
from tests.dummy import Point
from tests.runs.helpers import TASK

_NONE = jnp.zeros((), jnp.int32)


class Cramped(Point):
  """Its first step needs more than Warp's buffers hold, and every fourth one after it."""

  def reset(self, rng: jax.Array, model: Any = None) -> State:
    state = super().reset(rng)
    return state.replace(data=state.data.replace(buffers=BufferUse(_NONE, _NONE, _NONE)))

  def step(self, state: State, action: jax.Array, model: Any = None) -> State:
    lacks = (state.info["age"] % 4 == 0).astype(jnp.int32)
    after = super().step(state, action, model)
    return after.replace(data=after.data.replace(buffers=BufferUse(3 + lacks, 2 + lacks, lacks)))


@pytest.mark.parametrize(("repeat", "counted"), [(1, [3, 0, 0, 0, 3]), (2, [3, 0, 3, 0]), (4, [3, 3, 3])])
def test_overflows_in_any_repeat_of_an_action_count(repeat: int, counted: list[int]) -> None:
  env = wrap_for_training(Cramped(action_repeat=repeat))
  state, step = env.reset(jax.random.split(jax.random.PRNGKey(0), 3)), jax.jit(env.step)
  found = []
  for _ in counted:
    state = step(state, jnp.zeros((3, 2)))
    found.append(int(episode_sums(state)["overflows"]))
    assert int(state.data.buffers.constraints[0]) == 3 + (found[-1] > 0)
  assert found == counted


@pytest.mark.parametrize("repeat", [1, 4])
def test_a_run_counts_them_and_says_so_once(
  tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], repeat: int
) -> None:
  monkeypatch.setattr(registry, "load", lambda name, config=None: Cramped(action_repeat=repeat))
  run = tmp_path / "run"
  assert train(compose([*TASK, "agent.num_timesteps=3200", f"run_dir={run}"])) == 0
  table = pd.read_csv(run / "metrics.csv")
  counts = table["training/overflows"].to_numpy()
  assert (counts[1:] > 0).sum() > 1, "more than one row has them"
  said = capsys.readouterr().out
  assert said.count("needed more than Warp's buffers hold") == 1
  assert f"playground tune-buffers CartpoleBalance --run {run}" in said
  actions = int(np.diff(table["step"])[0]) // repeat
  assert f"{counts[1]:.0f} of {actions:,} " in said
