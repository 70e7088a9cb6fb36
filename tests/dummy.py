"""A task without physics, so that trainers compile in seconds: move a point to the origin."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from playground.envs.base import Env, State
from playground.envs.physics import STATE_FIELDS, PhysicsData, mjx


class PointTask(Env):
  """Position [2] follows the action; reward is minus the distance; NaN on demand (`nan_at` steps)."""

  def __init__(self, episode_length: int = 20, action_repeat: int = 1, nan_at: int | None = None):  # pyright: ignore[reportMissingSuperCall]
    self.dt, self.episode_length, self.action_repeat, self.nan_at = 0.1, episode_length, action_repeat, nan_at

  @property
  def action_size(self) -> int:
    return 2

  @property
  def mjx_model(self) -> Any:
    return None

  def reset(self, rng: jax.Array, model: mjx.Model | None = None) -> State:
    rng, key = jax.random.split(rng)
    fields = {name: jnp.zeros(0) for name in STATE_FIELDS}
    data = PhysicsData(**fields | {"qpos": jax.random.uniform(key, (2,), minval=-1), "qvel": jnp.zeros(2)})
    info = {"rng": rng, "age": jnp.zeros(()), "time": jnp.zeros(())}
    return State(data, self._obs(data), jnp.zeros(()), jnp.zeros(()), {"distance": jnp.zeros(())}, info)

  def control(self, state: State, action: jax.Array) -> jax.Array:
    return action

  def step(self, state: State, action: jax.Array, model: mjx.Model | None = None) -> State:
    ctrl = self.control(state, action)
    data = state.data.replace(qpos=state.data.qpos + 0.1 * ctrl, qvel=ctrl)
    return self.evaluate(data, state.info, action)

  def evaluate(self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array) -> State:
    age = info["age"] + 1
    if self.nan_at is not None:
      data = data.replace(qpos=jnp.where(age == self.nan_at, jnp.nan, data.qpos))
    distance = jnp.linalg.norm(data.qpos)
    done = (distance > 3).astype(jnp.float32)
    info = {**info, "age": age}
    return State(data, self._obs(data), -distance, done, {"distance": distance}, info)

  def _obs(self, data: PhysicsData) -> dict[str, jax.Array]:
    return {"state": data.qpos, "privileged_state": jnp.concatenate([data.qpos, data.qvel])}


SMALL: dict[str, Any] = dict(
  num_timesteps=3200, num_evals=3, num_envs=16, num_eval_envs=16, unroll_length=5, batch_size=8, num_minibatches=4,
  num_updates_per_batch=2, learning_rate=1e-3, discounting=0.95, normalize_observations=True,
)  # fmt: skip


def numbers(tree: Any) -> list[np.ndarray]:
  return [np.asarray(x) for x in jax.tree.leaves(tree)]
