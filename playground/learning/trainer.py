"""Trains any algorithm: the training state, its sharding over devices, training steps, checkpoints."""

from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from playground.envs.base import Env, State
from playground.envs.wrappers import PRESERVE_INFO, ModelFields, wrap_for_training
from playground.errors import ConfigError
from playground.hardware.distributed import is_multiprocess
from playground.hardware.mesh import AXIS, device_memory, for_agents, gather_on_mesh, jit_on_mesh, put, take_agents
from playground.learning.algorithm import AlgorithmState, Metrics, Policy, build_algorithm, with_settings
from playground.learning.checkpoints import Checkpoint
from playground.learning.hyperparameters import AgentConfig
from playground.learning.replay import REPLAY_SPEC, Replay
from playground.learning.rollout import Environments, NonfiniteCapture
from playground.pytree import PyTree
from playground.settings import below


class TrainState(struct.PyTreeNode):
  """The complete training state: a run restored from it ends with the same parameters, bit for bit.

  `env_state`, `capture` and `replay` are divided over the devices; the rest is the same on all of them.

  Attributes:
    algorithm: the learned state, without its `replay`.
    replay: the replay buffer's content, or None.
    key: of the next training step.
    env_state: a batch.
    capture: the first non-finite step.
    settings: of `trainer_settings`; a checkpoint stores them as plain numbers.
    sums: of the metrics so far, [MAX_METRICS], where several calls of `train` make one row; else zeros. No checkpoint
      has them.
  """

  algorithm: AlgorithmState
  replay: Replay | None
  key: jax.Array
  env_state: State
  capture: NonfiniteCapture
  settings: dict[str, jax.Array]
  sums: jax.Array


MAX_METRICS = 1024  # numbers of a training step; its own number is known only when it has been traced
Settings = Mapping[str, PyTree]


def trainer_settings(config: AgentConfig, env: Settings) -> dict[str, PyTree]:
  """Returns the numbers that the programs of a trainer take as arguments, float32 arrays by key.

  Args:
    config: of the algorithm, `AgentConfig.traced`; their keys are `agent.<name>`.
    env: of the task (`Env.settings_of`); their keys become `env.<key>`.
  """
  agent = {f"agent.{name}": np.float32(getattr(config, name)) for name in config.traced}
  return agent | {f"env.{key}": value for key, value in env.items()}


class Trainer:
  """Trains one algorithm on one task over a mesh of devices.

  It may train several agents at once, which differ in seeds, models, initial policies and settings. Then
  everything that the attributes' functions take and return has an axis of agents in front, but for the number of
  training steps; `join` and `agent` put it there and take it away.

  Attributes:
    algorithm: the algorithm.
    env: the task as a batch with auto-reset.
    steps_per_update: environment steps of one training step, over all devices.
    settings: the values of the settings that the programs take as arguments, by name.
    init: (key, model fields, policy or None, settings) -> state of a new run.
    train: (state, model fields, number of training steps) -> (state, metrics); donates the state's buffers. `sums` of
      the metrics, put into the state, makes the next call's metrics those of both calls.
    reset: (state, key, model fields) -> state with all environments reset, except entries that outlast a full reset;
      donates the state's buffers.
    gather: (state) -> the part that a checkpoint holds, in full in each process.
  """

  def __init__(
    self,
    env: Env,
    config: AgentConfig,
    mesh: Mesh,
    network_precision: str | None = None,
    agents: Sequence[Settings] = (),
  ):
    """Builds the algorithm.

    Args:
      env: the task.
      config: hyperparameters.
      mesh: devices, one axis named "data".
      network_precision: matrix-product precision of the networks.
      agents: the settings of each of several agents (`trainer_settings`), in place of those of `config` and `env`.

    Raises:
      ConfigError: sizes that do not fit each other or do not divide over the devices, or networks that do not fit the
        task.
    """
    self.num_agents = len(agents)
    self.mesh = mesh = for_agents(mesh, len(agents)) if agents else mesh
    self.num_devices = mesh.shape[AXIS]  # of each agent
    self.algorithm = build_algorithm(env, config, network_precision)
    config.check(self.num_devices)
    self.config, self.env = config, wrap_for_training(env)
    own = trainer_settings(config, env.settings_of(env.config)) if not agents else {}
    self.settings: dict[str, PyTree] = self.join([*agents] or [own])
    self.act, self.networks = self.algorithm.act, self.algorithm.networks
    self.steps_per_update = config.steps_per_update * env.action_repeat
    self._buffer = self.algorithm.replay
    if is_multiprocess() and self._buffer and self._buffer.saved:
      raise ConfigError("agent.checkpoint_replay=true needs one process for all devices: set it to false.")
    specs: dict[str, PyTree] = {"algorithm": P(), "key": P(), "env_state": P(AXIS), "capture": P(AXIS)}
    specs |= {"settings": P(), "sums": P()}
    spec = self._spec = TrainState(**specs, replay=REPLAY_SPEC if self._buffer else None)
    self.init = jit_on_mesh(self._init, mesh, (P(), P(AXIS), P(), P()), spec)
    self.reset = jit_on_mesh(self._reset, mesh, (spec, P(), P(AXIS)), spec, donate_argnums=0)
    self.train = jit_on_mesh(self._train, mesh, (spec, P(AXIS), None), (spec, P()), donate_argnums=0)
    # The saved part of a state; whole on every device where no process sees all of them.
    self.gather = gather_on_mesh(self._saved, mesh, spec) if is_multiprocess() else self._saved

  def join(self, parts: Sequence[PyTree]) -> PyTree:
    """Stacks the trees of all agents into one; that of a single agent stays unchanged."""
    on_host = lambda x: isinstance(x, np.ndarray | np.generic)
    stack = lambda *x: np.stack(x) if on_host(x[0]) else jnp.stack(x)
    return jax.tree.map(stack, *parts) if self.num_agents else parts[0]

  def agent(self, tree: PyTree, index: int) -> PyTree:
    """Returns one agent's part of a tree on the host; on several devices each leaf would be a program of its own."""
    return jax.tree.map(lambda x: x[index], tree) if self.num_agents else tree

  def shapes(self, tree: PyTree) -> PyTree:
    """Returns shapes and dtypes of one agent's part of a tree."""
    start = 1 if self.num_agents else 0
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[start:], x.dtype), tree)

  def template(self, model: ModelFields) -> TrainState:
    """Returns one agent's structure, shapes and dtypes; `model` has those of all agents."""
    key = self.join([np.zeros(2, np.uint32)] * max(self.num_agents, 1))
    return self.shapes(jax.eval_shape(self.init, key, model, None, self.settings))

  def policy(self, state: TrainState) -> Policy:
    """Returns the policy, which can act and start a new run."""
    return self.algorithm.policy(state.algorithm)

  def policy_shape(self) -> Policy:
    """Returns a policy's structure, shapes and dtypes, to read one from a checkpoint; no environment is traced."""
    return jax.eval_shape(self.algorithm.new_policy, jax.random.PRNGKey(0))

  def place_policy(self, policy: Policy) -> Policy:
    """Puts a policy's host arrays on every device."""
    return put(policy, self.mesh, P())

  def notices(self) -> list[str]:
    """Returns notices for the user before the state is allocated.

    Raises:
      ConfigError: the state does not fit the devices.
    """
    buffer = self._buffer
    if buffer is None:
      return []
    each, limit = buffer.nbytes * max(self.num_agents, 1) / self.mesh.size, device_memory(self.mesh)
    size = f"{buffer.size:,} transitions of {buffer.width} numbers, {each / 1e9:.2f} GB on each device"
    if limit is not None and each > limit:
      raise ConfigError(f"agent.max_replay_size={buffer.max_size} is {size}, which has {limit / 1e9:.2f} GB: lower it.")
    return [f"Replay buffer: {size}."]

  # Checkpoints

  def split(self, state: TrainState) -> tuple[Policy, TrainState]:
    """Returns the items `policy` and `state` of a checkpoint, which together are all but the replay buffer's data."""
    rest = state.replace(algorithm=state.algorithm.replace(params=None, normalizer=None), settings={}, sums=None)
    return self.policy(state), self.without_data(rest)

  def experience(self, state: TrainState) -> np.ndarray | None:
    """Returns the data of a fetched state's replay buffer, None without; only the newest checkpoint has it."""
    if self._buffer is None or not self._buffer.saved or state.replay is None or state.replay.data is None:
      return None
    return np.asarray(state.replay.data)[: min(int(state.replay.inserted), self._buffer.slots)]

  def restore(self, checkpoint: Checkpoint, template: TrainState) -> tuple[TrainState, str]:
    """Reads a training state.

    Args:
      checkpoint: to read from.
      template: the state's structure, shapes and dtypes.

    Returns:
      The state, on the host, and a sentence for the user.

    Raises:
      CheckpointError: damaged, or made for other shapes.
    """
    policy, rest = self.split(template)
    leaves = {name: shape for name, shape, _ in checkpoint.meta["leaves"]["state"]}
    here = self.num_devices
    there = leaves.get(".capture.found", [here])[0]
    theirs = jax.tree.map(lambda x: jax.ShapeDtypeStruct((there, *x.shape[1:]), x.dtype), rest.capture)
    rest = checkpoint.restore("state", rest.replace(capture=theirs))
    policy = checkpoint.restore("policy", policy)
    replay, what = self._restore_replay(checkpoint, template, rest.replay)
    algorithm = rest.algorithm.replace(params=policy.params, normalizer=policy.normalizer)
    state = rest.replace(algorithm=algorithm, replay=replay, capture=rest.capture.on_devices(here))
    elsewhere = (
      f" It was written on {there} device{'s' * (there > 1)}: on {here}, all of it goes on, but random numbers and "
      "rounding differ from here on."
    )
    message = f"Resuming {what} of {checkpoint.path} ({checkpoint.step:,} steps).{elsewhere * (there != here)}"
    return state, message

  def place(self, state: TrainState) -> TrainState:
    """Puts a state's host arrays on the devices, each its share, with the trainer's settings."""
    sums = self.join([np.zeros(MAX_METRICS, np.float32)] * max(self.num_agents, 1))
    return put(state.replace(settings=self.settings, sums=sums), self.mesh, self._spec)

  def inherit(self, state: TrainState, parents: np.ndarray, settings: Settings) -> TrainState:
    """Returns a state of several agents in which each has the learned state of its parent.

    Args:
      state: of all agents.
      parents: index of the agent whose parameters, statistics and optimiser each agent gets, [agents]. Its
        environments, random key and replay buffer stay its own.
      settings: host arrays of all agents.
    """
    algorithm = take_agents(state.algorithm, parents, self.mesh, P())
    return state.replace(algorithm=algorithm, settings=put(dict(settings), self.mesh, P()))

  def _restore_replay(
    self, checkpoint: Checkpoint, template: TrainState, replay: Replay | None
  ) -> tuple[Replay | None, str]:
    """Returns the replay buffer, empty if the checkpoint has none, and the sentence for the user."""
    whole = "the whole training state"
    if self._buffer is None or template.replay is None or replay is None:
      return None, whole
    shape, dtype = template.replay.data.shape, template.replay.data.dtype
    data = np.zeros(shape, dtype)
    if checkpoint.has("replay"):
      held = min(int(replay.inserted), self._buffer.slots)
      data[:held] = checkpoint.restore("replay", jax.ShapeDtypeStruct((held, *shape[1:]), dtype))
      return Replay(data, replay.inserted), whole  # pyright: ignore[reportArgumentType]  # on the host
    refill = f"{self.config.prefill_updates * self.config.num_envs:,} transitions are collected before it learns on"
    if checkpoint.step + self.config.prefill_updates * self.steps_per_update >= self.config.num_timesteps:
      refill += ", and no steps are left then: it learns nothing more"
    empty = Replay(data, np.zeros_like(replay.inserted))  # pyright: ignore[reportArgumentType]
    return empty, f"the training state without its replay buffer ({refill})"

  def _saved(self, state: PyTree) -> PyTree:
    """Returns the saved part of a state, or of its specs."""
    return self.without_data(state) if self._buffer and not self._buffer.saved else state

  def without_data(self, state: PyTree) -> PyTree:
    """Returns a state, or its specs, without the replay buffer's data."""
    return state if state.replay is None else state.replace(replay=state.replay.replace(data=None))

  # On each device

  def _init(
    self, key: jax.Array, model: ModelFields, policy: Policy | None, settings: dict[str, jax.Array]
  ) -> TrainState:
    key, algorithm_key, env_key = jax.random.split(key, 3)
    algorithm = with_settings(self.algorithm, below("agent", settings)).init(algorithm_key, policy)
    env_state = self._reset_environments(env_key, model, settings)
    capture = NonfiniteCapture.empty(env_state, self.env.action_size, model)
    return _train_state(algorithm, key, env_state, capture, settings, jnp.zeros(MAX_METRICS))

  def _reset(self, state: TrainState, key: jax.Array, model: ModelFields) -> TrainState:
    fresh = self._reset_environments(key, model, state.settings)
    kept = {k: v for k, v in state.env_state.info.items() if k == PRESERVE_INFO}
    return state.replace(env_state=fresh.replace(info=fresh.info | kept))

  def _reset_environments(self, key: jax.Array, model: ModelFields, settings: dict[str, jax.Array]) -> State:
    """Resets this device's share of the environments, with keys that no other device has."""
    device = jax.lax.axis_index(AXIS)
    reset_keys = jax.random.split(jax.random.fold_in(key, device), self.config.num_envs // self.num_devices)
    state = self.env.with_settings(below("env", settings)).reset(reset_keys, model)
    if not self.config.random_episode_ages:
      return state
    age_key, steps = jax.random.fold_in(jax.random.split(key)[0], device), state.info["steps"]
    age = jax.random.randint(age_key, steps.shape, 0, self.env.episode_length).astype(steps.dtype)
    return state.replace(info=state.info | {"steps": age})

  def _train(self, state: TrainState, model: ModelFields, num_updates: jax.Array) -> tuple[TrainState, Metrics]:
    """`num_updates` training steps; the number is an argument, so any number of them is one compiled program."""
    train_step = jax.jit(self._train_step)  # so that asking for its shapes and calling it is one trace
    shapes = jax.eval_shape(train_step, state, model)[1]
    zeros, unravel = ravel_pytree(jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes))

    def body(_: int, carry: tuple[TrainState, jax.Array]) -> tuple[TrainState, jax.Array]:
      state, total = carry
      state, metrics = train_step(state, model)
      return state, total + ravel_pytree(metrics)[0]  # one vector: an addition each costs a kernel each

    state, total = jax.lax.fori_loop(0, num_updates, body, (state, state.sums[: zeros.size]))
    sums = jnp.zeros_like(state.sums)
    return state.replace(sums=sums), _means(unravel(total)) | {"sums": sums.at[: zeros.size].set(total)}

  def _train_step(self, state: TrainState, model: ModelFields) -> tuple[TrainState, Metrics]:
    key, shared = jax.random.split(state.key)
    env = self.env.with_settings(below("env", state.settings))
    envs = Environments(state.env_state, state.capture, model, {}, env)
    done = with_settings(self.algorithm, below("agent", state.settings)).train_step(
      state.algorithm.replace(replay=state.replay), envs, jax.random.fold_in(shared, jax.lax.axis_index(AXIS))
    )
    if not (isinstance(done, tuple) and len(done) == 3):
      raise ConfigError(f"{type(self.algorithm).__name__}.train_step must return state, environments and metrics.")
    algorithm, envs, metrics = done
    if wrong := {name: jnp.shape(value) for name, value in metrics.items() if jnp.ndim(value)}:
      raise ConfigError(f"{type(self.algorithm).__name__}.train_step: a metric is one number, not of shape {wrong}.")
    metrics = {"learned": jnp.ones(())} | metrics | jax.lax.psum(envs.sums, AXIS)
    return _train_state(algorithm, key, envs.state, envs.capture, state.settings, state.sums), metrics


def _train_state(
  algorithm: AlgorithmState,
  key: jax.Array,
  env_state: State,
  capture: NonfiniteCapture,
  settings: dict[str, jax.Array],
  sums: jax.Array,
) -> TrainState:
  return TrainState(algorithm.replace(replay=None), algorithm.replay, key, env_state, capture, settings, sums)


_COUNTS = ("episodes", "nonfinite", "gradient_steps", "nonfinite_updates", "overflows")


def _means(total: Metrics) -> Metrics:
  """Means over training steps that learned and, for what ended, over episodes; counts stay counts.

  A mean over nothing is NaN, which the log leaves out.
  """
  learned, means = total.pop("learned"), {}
  for name, value in total.items():
    if name.startswith("episode_"):
      means[{"episode_sum_reward": "episode_reward"}.get(name, name)] = value / total["episodes"]
    else:
      means[name] = value if name in _COUNTS else value / learned
  return means
