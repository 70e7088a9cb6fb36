"""What an evaluation reports of the metrics of its episodes."""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.envs.base import State
from playground.hardware.mesh import make_mesh
from playground.learning.evaluation import make_evaluator
from playground.physics.backend import PhysicsData, mjx
from playground.runs.callbacks import episodes_of
from tests.dummy import PointTask


class Counting(PointTask):
  """Its metrics are the step's number"""

  summaries: ClassVar[Mapping[str, str]] = {"average": "mean", "highest": "max", "at_end": "last"}

  def reset(self, rng: jax.Array, model: mjx.Model | None = None) -> State:
    state = super().reset(rng, model)
    return state.replace(metrics=dict.fromkeys(("total", *self.summaries), jnp.zeros(())))

  def post_step(self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array) -> State:
    state = super().post_step(data, info, action)
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
  scores, recording = evaluate(jnp.zeros(()), key, {}, {})

  ends = []
  reset_key = jax.random.split(jax.random.fold_in(key, 0))[0]
  for env_key in jax.random.split(reset_key, 8):
    ends.append(int(env.ends(env.reset(env_key).info)))
  steps = -(-np.array(ends) // action_repeat)  # decisions
  ages = [np.arange(1, end + 1) for end in ends]  # a repeat after the end of an episode counts nowhere
  of_decision = [[a[i : i + action_repeat].mean() for i in range(0, len(a), action_repeat)] for a in ages]
  assert len(set(steps)) > 1, "episodes of one length would show little"
  means = {
    "length": steps * action_repeat,
    "total": [a.sum() for a in ages],
    "average": [np.mean(means) for means in of_decision],
    "highest": [-1.0],
    "at_end": ends,
  }
  for name, values in means.items():
    np.testing.assert_allclose(scores[f"episode_{name}"], np.mean(values), rtol=1e-6, err_msg=name)
  assert recording["active"][:, 0].sum() == steps[0]


def test_both_ways_to_act_run_side_by_side_from_the_same_states() -> None:
  env, key = PointTask(), jax.random.PRNGKey(1)
  stay = lambda policy, obs, key: jnp.zeros((len(obs["state"]), 2))
  home = lambda policy, obs, key: -obs["state"]
  both, recording = make_evaluator(env, stay, 8, make_mesh(1), 2, {"mode": home})(jnp.zeros(()), key, {}, {})
  for act, prefix in ((stay, ""), (home, "mode/")):
    alone, recorded = make_evaluator(env, act, 8, make_mesh(1), 2)(jnp.zeros(()), key, {}, {})
    of_it = {name.removeprefix(prefix): x for name, x in both.items() if ("mode/" in name) == bool(prefix)}
    assert set(of_it) == set(alone)
    for name, value in alone.items():
      np.testing.assert_array_equal(of_it[name], value, err_msg=name)
    if not prefix:
      assert jax.tree.all(jax.tree.map(lambda x, y: bool((x == y).all()), recorded, recording))
  assert both["mode/episode_reward"] > both["episode_reward"]


class Seeing(Counting):
  """Two frames of what it sees: one brighter, and then the number of the step."""

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    return {"pixels/eye": {"gray[-1]": 1, "gray[0]": 1}}

  def reset(self, rng: jax.Array, model: mjx.Model | None = None) -> State:
    return self._with_image(super().reset(rng, model), 0)

  def post_step(self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array) -> State:
    state = super().post_step(data, info, action)
    return self._with_image(state, state.info["age"])

  def _with_image(self, state: State, age: Any) -> State:
    frame = jnp.full((3, 2, 1), age).astype(jnp.uint8)
    own: Any = state.obs
    return state.replace(obs=own | {"pixels/eye": jnp.concatenate([frame + 100, frame], axis=-1)})


def test_what_is_seen_is_recorded() -> None:
  env = Seeing(episode_length=20)
  act = lambda policy, obs, key: jnp.zeros((len(obs["state"]), 2))
  _, recording = make_evaluator(env, act, 4, make_mesh(1), 2)(jnp.zeros(()), jax.random.PRNGKey(0), {}, {})
  tape = episodes_of(recording, 1)
  assert tape["seen"].shape == (len(tape["qpos"]), 3, 2, 1) and tape["seen"].dtype == np.uint8
  np.testing.assert_array_equal(tape["seen"][:, 0, 0, 0], np.arange(len(tape["qpos"])))
