"""What an evaluation reports of the metrics of its episodes."""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.envs.base import State
from playground.envs.physics import PhysicsData, mjx
from playground.hardware.mesh import make_mesh
from playground.learning.evaluation import make_evaluator
from tests.dummy import PointTask


class Counting(PointTask):
  """Its metrics are the step's number"""

  summaries: ClassVar[Mapping[str, str]] = {"average": "mean", "highest": "max", "at_end": "last"}

  def reset(self, rng: jax.Array, model: mjx.Model | None = None) -> State:
    state = super().reset(rng, model)
    return state.replace(metrics=dict.fromkeys(("total", *self.summaries), jnp.zeros(())))

  def evaluate(self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array) -> State:
    state = super().evaluate(data, info, action)
    age = state.info["age"]
    values = {"total": age, "average": age, "highest": -age, "at_end": age}
    return state.replace(metrics=values, done=(age >= self.ends(info)).astype(jnp.float32))

  def ends(self, info: Mapping[str, Any]) -> jax.Array:
    """After how many steps an episode ends."""
    return 3 + info["rng"][0] % 5


@pytest.mark.parametrize("action_repeat", [1, 2])
def test_metrics_of_an_episode(action_repeat: int) -> None:
  env = Counting(episode_length=20, action_repeat=action_repeat)
  act = lambda policy, obs, key: jnp.zeros((len(obs["state"]), 2))
  evaluate = make_evaluator(env, act, 8, make_mesh(1), 1)
  key = jax.random.PRNGKey(0)
  scores, recording = evaluate(jnp.zeros(()), key, {})

  steps = []
  reset_key = jax.random.split(jax.random.fold_in(key, 0))[0]
  for env_key in jax.random.split(reset_key, 8):
    end = int(env.ends(env.reset(env_key).info))
    steps.append(-(-end // action_repeat))  # decisions
  ages = [np.arange(1, n + 1) * action_repeat for n in steps]
  assert len(set(steps)) > 1, "episodes of one length would show little"
  means = {
    "length": np.array(steps) * action_repeat,
    "total": [a.sum() for a in ages],
    "average": [a.mean() for a in ages],
    "highest": [-a[0] for a in ages],
    "at_end": [a[-1] for a in ages],
  }
  for name, values in means.items():
    np.testing.assert_allclose(scores[f"episode_{name}"], np.mean(values), rtol=1e-6, err_msg=name)
  assert recording["active"][:, 0].sum() == steps[0]
