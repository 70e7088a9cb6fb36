"""A task without physics, so that trainers compile in seconds: move a point to the origin."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from playground.envs.base import Env, State
from playground.envs.wrappers import MAX_VELOCITY
from playground.hardware.mesh import make_mesh
from playground.learning.hyperparameters import (
  C51NetworkConfig,
  FastSACConfig,
  FastSACNetworkConfig,
  FastTD3Config,
  PPOConfig,
  REPPOConfig,
  REPPONetworkConfig,
  SACConfig,
)
from playground.learning.loop import Metrics
from playground.learning.networks import NetworkConfig, SoftNetworkConfig
from playground.learning.rollout import Step
from playground.learning.trainer import Trainer
from playground.physics.backend import STATE_FIELDS, PhysicsData, mjx


class NoPhysics:
  def without_dynamics(self) -> "NoPhysics":
    return self

  def compile_ahead(self) -> None:
    return None


class PointTask(Env):
  """Position [2] follows the action, reward is minus the distance.

  On demand NaN or absurd velocity in a step (`*_at`), and a first observation of NaN where the point starts to the
  left (`nan_reset`).
  """

  config: Any = None

  def __init__(
    self,
    episode_length: int = 20,
    action_repeat: int = 1,
    nan_at: int | None = None,
    fast_at: int | None = None,
    nan_reset: bool = False,
  ):  # pyright: ignore[reportMissingSuperCall]
    self.dt, self.episode_length, self.action_repeat, self.nan_at = 0.1, episode_length, action_repeat, nan_at
    self.fast_at, self.nan_reset, self.impl = fast_at, nan_reset, "jax"
    self.physics: Any = NoPhysics()

  @property
  def action_size(self) -> int:
    return 2

  @property
  def mjx_model(self) -> Any:
    return None

  def reset(self, rng: jax.Array, model: mjx.Model | None = None) -> State:
    rng, key = jax.random.split(rng)
    fields: dict[str, Any] = {name: jnp.zeros(0) for name in STATE_FIELDS}
    fields |= {"qpos": jax.random.uniform(key, (2,), minval=-1), "qvel": jnp.zeros(2)}
    data = PhysicsData(**fields)
    info = {"rng": rng, "age": jnp.zeros(()), "time": jnp.zeros(())}
    obs = self._obs(data)
    if self.nan_reset:
      obs = jax.tree.map(lambda x: jnp.where(data.qpos[0] < 0, jnp.nan, x), obs)
    return State(data, obs, jnp.zeros(()), jnp.zeros(()), {"distance": jnp.zeros(())}, info)

  def action_to_ctrl(self, state: State, action: jax.Array) -> jax.Array:
    return action

  def step(self, state: State, action: jax.Array, model: mjx.Model | None = None) -> State:
    state = self.pre_step(state)
    ctrl = self.action_to_ctrl(state, action)
    data = state.data.replace(qpos=state.data.qpos + 0.1 * ctrl, qvel=ctrl)
    return self.post_step(data, state.info, action)

  def post_step(self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array) -> State:
    age = info["age"] + 1
    if self.nan_at is not None:
      data = data.replace(qpos=jnp.where(age == self.nan_at, jnp.nan, data.qpos))
    if self.fast_at is not None:
      data = data.replace(qvel=jnp.where(age == self.fast_at, 2 * MAX_VELOCITY, data.qvel))
    distance = jnp.linalg.norm(data.qpos)
    done = (distance > 3).astype(jnp.float32)
    info = {**info, "age": age}
    return State(data, self._obs(data), -distance, done, {"distance": distance}, info)

  def _obs(self, data: PhysicsData) -> dict[str, jax.Array]:
    return {"state": data.qpos, "privileged_state": jnp.concatenate([data.qpos, data.qvel])}


class Point(PointTask):
  """As much of a task as a whole run needs: `registry.load` may return it."""

  mj_model: Any = None  # pyright: ignore[reportIncompatibleVariableOverride]
  impl = "jax"


SMALL_PPO = PPOConfig(
  num_timesteps=3200, num_evals=3, num_envs=16, num_eval_envs=16, unroll_length=5, batch_size=8, num_minibatches=4,
  num_updates_per_batch=2, learning_rate=3e-3, discounting=0.95, entropy_cost=1e-4, normalize_observations=True,
  network=NetworkConfig((16, 16), (16, 16), value_obs_key="privileged_state"),
)  # fmt: skip
SMALL_SAC = SACConfig(
  num_timesteps=3200, num_evals=3, num_envs=16, num_eval_envs=16, batch_size=32, grad_updates_per_step=2,
  min_replay_size=64, max_replay_size=500, learning_rate=3e-3, discounting=0.95, normalize_observations=True,
  network=SoftNetworkConfig((16, 16), q_network_layer_norm=True, value_obs_key="privileged_state"),
)  # fmt: skip
SMALL_REPPO = REPPOConfig(
  num_timesteps=3200, num_evals=3, num_envs=16, num_eval_envs=16, unroll_length=10, num_minibatches=4,
  num_updates_per_batch=2, learning_rate=3e-3, discounting=0.95, min_value=-30.0, max_value=10.0, num_bins=51,
  init_at_random_ep_len=False, network=REPPONetworkConfig((16, 16), 16, value_obs_key="privileged_state"),
)  # fmt: skip
SMALL_FAST_TD3 = FastTD3Config(
  num_timesteps=3200, num_evals=3, num_envs=16, num_eval_envs=16, batch_size=32, grad_updates_per_step=2,
  min_replay_size=64, max_replay_size=500, learning_rate=3e-3, discounting=0.95, min_value=-30.0, max_value=10.0,
  network=C51NetworkConfig((16, 16), (16, 16), value_obs_key="privileged_state"),
)  # fmt: skip
SMALL_FAST_SAC = FastSACConfig(
  num_timesteps=3200, num_evals=3, num_envs=16, num_eval_envs=16, batch_size=32, grad_updates_per_step=2,
  policy_frequency=2, min_replay_size=64, max_replay_size=500, learning_rate=3e-3, discounting=0.95, min_value=-30.0,
  max_value=10.0, network=FastSACNetworkConfig((16, 16), (16, 16), value_obs_key="privileged_state"),
)  # fmt: skip
SMALL = {
  "ppo": SMALL_PPO,
  "sac": SMALL_SAC,
  "reppo": SMALL_REPPO,
  "fast_td3": SMALL_FAST_TD3,
  "fast_sac": SMALL_FAST_SAC,
}

Config = PPOConfig | SACConfig | REPPOConfig | FastTD3Config | FastSACConfig


def point_trainer(config: Config, num_devices: int = 1, **events: Any) -> Trainer:
  """A trainer of the algorithm that a config is of, for the point."""
  return Trainer(PointTask(**events), config, make_mesh(num_devices))


class Recorder:
  """Callbacks that remember, and stop after a number of rows. All they are given has left the device."""

  def __init__(self, stop_after: int | None = None):
    self.rows: list[tuple[int, Metrics]] = []
    self.captured: list[Step | None] = []
    self.saved: list[tuple[int, Any]] = []
    self.stop_after = stop_after

  def on_metrics(self, step: int, metrics: Metrics, captured: Step | None, recording: Any) -> None:
    self._check_fetched((captured, recording))
    self.rows.append((step, {k: v for k, v in metrics.items() if not k.startswith("time/")}))
    self.captured.append(captured)

  def on_save(self, update: int, step: int, state: Any) -> None:
    self._check_fetched(state)
    self.saved.append((update, state))

  def should_stop(self) -> bool:
    return self.stop_after is not None and len(self.rows) >= self.stop_after

  @staticmethod
  def _check_fetched(tree: Any) -> None:
    """Callbacks run beside the training program, whose CUDA graphs another use of the device breaks."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
      assert isinstance(leaf, np.ndarray | np.generic), jax.tree_util.keystr(path)


def numbers(tree: Any) -> list[np.ndarray]:
  return [np.asarray(x) for x in jax.tree.leaves(tree)]


def check_resume(trainer: Any, run: Callable[..., Any], recorders: Sequence[Sequence[Recorder]], expected: Any) -> None:
  """Stops agents after their second save and goes on: their state is `expected`, their rows those of an uncut run.

  Args:
    trainer: of the agents.
    run: trains with recorders, from a state and update if given; returns the last state.
    recorders: of the uncut run, of the first part and of the second part.
    expected: the last state of the uncut run.
  """
  whole, first, second = recorders
  for recorder in first:
    recorder.stop_after = 2
  run(first)
  update, _ = first[0].saved[-1]
  trainer.settings = trainer.join([recorder.saved[-1][1].settings for recorder in first])
  state = trainer.place(trainer.join([recorder.saved[-1][1] for recorder in first]))
  for ours, theirs in zip(numbers(run(second, state, update)), numbers(expected), strict=True):
    np.testing.assert_array_equal(ours, theirs)
  for recorder, one, two in zip(whole, first, second, strict=True):
    assert recorder.rows == one.rows + two.rows
