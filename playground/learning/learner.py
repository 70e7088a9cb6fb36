"""What the algorithms share: the training state, its division over devices, and the loop of training steps."""

import abc
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from playground.envs.base import Env, Observation, State
from playground.envs.wrappers import PRESERVE_INFO, ModelFields, wrap_for_training
from playground.hardware.distributed import several
from playground.hardware.mesh import AXIS, gather_on_mesh, jit_on_mesh, put
from playground.learning.checkpoints import Checkpoint
from playground.learning.networks import Actor, Normalizer
from playground.learning.rollout import NonfiniteCapture

Metrics = dict[str, jax.Array]


class Policy(struct.PyTreeNode):
  """What acting needs (the critics come along for runs that start from it)."""

  params: Any
  normalizer: Normalizer


class TrainState(struct.PyTreeNode):
  """Everything training goes on from: a run restored from it ends with the same parameters, bit for bit.

  `env_state` and `capture` are divided over the devices; the rest is the same on all of them.
  """

  params: Any
  opt_state: optax.OptState
  normalizer: Normalizer
  key: jax.Array
  env_state: State
  capture: NonfiniteCapture


SPEC: dict[str, Any] = dict(
  params=P(), opt_state=P(), normalizer=P(), key=P(), env_state=P(AXIS), capture=P(AXIS)
)  # of the fields of TrainState


class Learner(abc.ABC):
  """An algorithm for one task, as the loop wants it: functions jitted over a mesh of devices.

  Attributes:
    steps_per_update: control steps of one training step, over all devices.
    init: (key, model fields) -> state.
    train: (state, model fields, number of training steps) -> (state, metrics); takes the state's buffers over.
    reset: (state, key, model fields) -> state with freshly reset environments, but for what outlasts a full reset;
      takes the state's buffers over.
    copy: (state) -> state in buffers of its own.
  """

  def __init__(self, env: Env, config: Any, mesh: Mesh, networks: Actor, steps_per_update: int, spec: Any):
    """Takes the task and its networks.

    Args:
      env: the task.
      config: hyperparameters, checked.
      mesh: devices, one axis named "data".
      networks: the algorithm's networks.
      steps_per_update: see above.
      spec: a training state of PartitionSpecs, how it is divided over the mesh.
    """
    self.config = config
    self.mesh = mesh
    self.env = wrap_for_training(env)
    self.networks: Any = networks
    self.steps_per_update = steps_per_update
    self._spec = spec
    self.init = jit_on_mesh(self._init, mesh, (P(), P(AXIS)), spec)
    self.reset = jit_on_mesh(self._reset, mesh, (spec, P(), P(AXIS)), spec, donate_argnums=0)
    self.train = jit_on_mesh(self._train, mesh, (spec, P(AXIS), P()), (spec, P()), donate_argnums=0)
    self.copy = self._make_copy()

  @abc.abstractmethod
  def _init(self, key: jax.Array, model: ModelFields) -> Any:
    """The state of a new run."""

  @abc.abstractmethod
  def _training_step(self, state: Any, model: ModelFields) -> tuple[Any, Metrics]:
    """Collects and learns once.

    Returns:
      The state after it and float32 scalars, the same on all devices: sums over what ended (`episodes`, `episode_*`),
      counts (`nonfinite`, `gradient_steps`, and `nonfinite_updates`, those of them that were left out), and means.
      `learned` is 1, or 0 where there was nothing to learn from yet; the means are 0 then.
    """

  def notices(self) -> list[str]:
    """What a user should know before the state is allocated.

    Raises:
      ConfigError: it does not fit the devices.
    """
    return []

  def policy(self, state: Any) -> Policy:
    """Normaliser and networks: what acting needs, and what a new run can start from."""
    return Policy(state.params, state.normalizer)

  def policy_shape(self) -> Policy:
    """Structure, shapes and dtypes of a policy, to read one from a checkpoint; no environment is traced."""
    make = lambda: Policy(self.networks.init(jax.random.PRNGKey(0)), self.networks.init_normalizer())
    return jax.eval_shape(make)

  def act(self, policy: Policy, obs: Observation, key: jax.Array, deterministic: bool | None = None) -> jax.Array:
    """Actions in [-1, 1], [..., action_size]; deterministic as `deterministic_eval` says if not given."""
    normalizer = policy.normalizer if self.config.normalize_observations else None
    deterministic = self.config.deterministic_eval if deterministic is None else deterministic
    return self.networks.act(policy.params.policy, normalizer, obs, key, deterministic)

  def split(self, state: Any) -> tuple[Policy, Any]:
    """Divides a state into what acting needs and the rest; `join` puts it together again."""
    return self.policy(state), state.replace(params=None, normalizer=None)

  def join(self, policy: Policy, rest: Any) -> Any:
    return rest.replace(params=policy.params, normalizer=policy.normalizer)

  def experience(self, state: Any) -> np.ndarray | None:
    """What was collected and will be trained on again, on the host; large, so only the newest checkpoint has it."""
    return None

  def restore(self, checkpoint: Checkpoint, template: Any) -> tuple[Any, str]:
    """Reads a training state.

    Args:
      checkpoint: where from.
      template: the state's structure, shapes and dtypes.

    Returns:
      The state, on the devices, and a sentence for the user on what it is.

    Raises:
      CheckpointError: damaged, or made for other shapes.
    """
    state, elsewhere = self.read(checkpoint, template)
    what = f"the whole training state of {checkpoint.path} ({checkpoint.step:,} steps)"
    return self.place(state), f"Resuming {what}.{elsewhere}"

  def read(self, checkpoint: Checkpoint, template: Any) -> tuple[Any, str]:
    """A checkpoint's state on the host, for these devices, and what to say if it was written on others."""
    policy, rest = self.split(template)
    leaves = {name: shape for name, shape, _ in checkpoint.meta["leaves"]["state"]}
    there, here = leaves.get(".capture.found", [self.mesh.size])[0], self.mesh.size
    theirs = jax.tree.map(lambda x: jax.ShapeDtypeStruct((there, *x.shape[1:]), x.dtype), rest.capture)
    rest = checkpoint.restore("state", rest.replace(capture=theirs))
    state = self.join(checkpoint.restore("policy", policy), rest.replace(capture=rest.capture.on_devices(here)))
    elsewhere = (
      f" It was written on {there} device{'s' * (there > 1)}: on {here}, all of it goes on, but random numbers and "
      "rounding differ from here on."
    )
    return state, elsewhere * (there != here)

  def place(self, state: Any) -> Any:
    """Puts a state's host arrays on the devices, each its share."""
    return put(state, self.mesh, self._spec)

  def with_policy(self, state: Any, policy: Policy) -> Any:
    """A state that acts with `policy` (host arrays), all else unchanged."""
    return self.join(self.place_policy(policy), state)

  def place_policy(self, policy: Policy) -> Policy:
    """Puts a policy's host arrays on every device."""
    return put(policy, self.mesh, P())

  def _make_copy(self, keep: Callable[[Any], Any] = lambda state: state) -> Any:
    """`copy`, of what `keep` leaves of a state; whole on every device where no process can see all of them."""
    copy = lambda state: jax.tree.map(jnp.copy, keep(state))
    if several():
      return gather_on_mesh(copy, self.mesh, self._spec)
    return jit_on_mesh(copy, self.mesh, (self._spec,), keep(self._spec))

  def _reset(self, state: Any, key: jax.Array, model: ModelFields) -> Any:
    fresh = self._fresh(key, model)
    kept = {k: v for k, v in state.env_state.info.items() if k == PRESERVE_INFO}
    return state.replace(env_state=fresh.replace(info=fresh.info | kept))

  def _fresh(self, key: jax.Array, model: ModelFields) -> State:
    """Freshly reset environments: this device's share, with keys no other device has."""
    key = jax.random.fold_in(key, jax.lax.axis_index(AXIS))
    return self.env.reset(jax.random.split(key, self.config.num_envs // self.mesh.size), model)

  def _train(self, state: Any, model: ModelFields, num_updates: jax.Array) -> tuple[Any, Metrics]:
    """`num_updates` training steps; the number is an argument, so any number of them is one compiled program."""
    training_step = jax.jit(self._training_step)  # so that asking for its shapes and calling it is one trace
    shapes = jax.eval_shape(training_step, state, model)[1]
    total, unravel = ravel_pytree(jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes))

    def body(_: int, carry: tuple[Any, jax.Array]) -> tuple[Any, jax.Array]:
      state, total = carry
      state, metrics = training_step(state, model)
      return state, total + ravel_pytree(metrics)[0]  # one vector: an addition each costs a kernel each

    state, total = jax.lax.fori_loop(0, num_updates, body, (state, total))
    return state, report(unravel(total))


_COUNTS = ("episodes", "nonfinite", "gradient_steps", "nonfinite_updates", "overflows")


def report(total: Metrics) -> Metrics:
  """Means over training steps that learned and, for what ended, over episodes; counts stay counts.

  A mean over nothing is NaN, which the log leaves out.
  """
  learned, report = total.pop("learned"), {}
  for name, value in total.items():
    if name.startswith("episode_"):
      report[{"episode_sum_reward": "episode_reward"}.get(name, name)] = value / total["episodes"]
    else:
      report[name] = value if name in _COUNTS else value / learned
  return report
