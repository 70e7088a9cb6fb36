"""Collects experience: an actor steps a batch of environments for a fixed number of control steps."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from playground.envs.base import Observation, State
from playground.envs.wrappers import FINAL_OBS, AutoReset, ModelFields
from playground.learning.networks import Actor, Normalizer, normalize
from playground.pytree import PyTree


class Transitions(struct.PyTreeNode):
  """Steps of N environments.

  Attributes:
    obs: observations before the actions, not normalised, each [T, N, ...].
    raw_action: actions before squashing, [T, N, action_size].
    log_prob: their log-probability under the policy that took them, [T, N].
    reward: [T, N], unscaled.
    termination: 1 where the task ended the episode, [T, N].
    truncation: 1 where the time limit cut it, [T, N].
    final_value: the critic's value of an episode's last observation at the time limit, else 0, [T, N]; None without a
      critic.
  """

  obs: dict[str, jax.Array]
  raw_action: jax.Array
  log_prob: jax.Array
  reward: jax.Array
  termination: jax.Array
  truncation: jax.Array
  final_value: jax.Array | None = None


class Step(struct.PyTreeNode):
  """A step of one environment with its inputs, to replay it; every leaf [1, ...].

  Attributes:
    state: the environment before it.
    action: [1, action_size].
    model: its randomised model fields.
    after: the simulator's state after it, by field.
  """

  state: State
  action: jax.Array
  model: dict[str, jax.Array]
  after: dict[str, jax.Array]


class NonfiniteCapture(struct.PyTreeNode):
  """The first step of a run in which numbers of an environment were NaN, infinite or too large, for replay.

  Attributes:
    found: whether a step was captured, [1] bool (one for each device).
    bits: the `Step` as one row of 32-bit words, [1, words]: on a GPU separate arrays would cost every step one or two
      copies each.
  """

  found: jax.Array
  bits: jax.Array

  @classmethod
  def empty(cls, state: State, action_size: int, model: ModelFields) -> "NonfiniteCapture":
    bits = _to_bits(_example(state, action_size, model))
    return cls(jnp.zeros(1, bool), jnp.zeros_like(bits))

  def on_devices(self, count: int) -> "NonfiniteCapture":
    """Returns the capture (on the host) for another number of devices, a captured step first."""
    if len(self.found) == count:
      return self
    order = np.argsort(~self.found, kind="stable")[np.arange(count) % len(self.found)]
    return jax.tree.map(lambda x: x[order], self)

  def look(self, before: State, action: jax.Array, model: ModelFields, after: State) -> "NonfiniteCapture":
    """Captures the step from `before` to `after` of the first non-finite environment, if none was captured before."""
    bad = after.info["nonfinite"]
    which = jnp.argmax(bad)
    take = (bad[which] > 0) & ~self.found[0]
    rows = _to_bits(Step(before, action, dict(model), after.info["nonfinite_state"]))
    row = jax.lax.dynamic_slice_in_dim(rows, which, 1)
    return NonfiniteCapture(self.found | take, jnp.where(take, row, self.bits))

  def first(self, state: State, action_size: int, model: ModelFields) -> Step | None:
    """Returns the captured step on the host, or None; the arguments, or their shapes, give its structure."""
    found = np.flatnonzero(self.found)
    if not len(found):
      return None
    example = jax.eval_shape(lambda state, model: _example(state, action_size, model), state, dict(model))
    return _from_bits(np.asarray(self.bits[found[0]]), example)


def _example(state: State, action_size: int, model: ModelFields) -> Step:
  """Returns a step's structure, shapes and dtypes."""
  first = lambda tree: jax.tree.map(lambda x: x[:1], tree)
  return first(Step(state, jnp.zeros((1, action_size)), dict(model), state.info["nonfinite_state"]))


def _to_bits(tree: PyTree) -> jax.Array:
  """Concatenates the bits of the leaves, each [N, ...]: [N, words] uint32."""
  words = lambda x: jax.lax.bitcast_convert_type(x, jnp.uint32) if x.dtype.itemsize == 4 else x.astype(jnp.uint32)
  return jnp.concatenate([words(x).reshape(len(x), -1) for x in jax.tree.leaves(tree)], axis=1)


def _from_bits(row: np.ndarray, example: PyTree) -> PyTree:
  """Decodes one row, [words], to a structure with these shapes and dtypes."""
  leaves, structure = jax.tree.flatten(example)
  parts = np.split(row, np.cumsum([leaf.size for leaf in leaves])[:-1])
  read = lambda part, dtype: part.view(dtype) if dtype.itemsize == 4 else part.astype(dtype)
  values = [read(part, leaf.dtype).reshape(leaf.shape) for part, leaf in zip(parts, leaves, strict=True)]
  return jax.tree.unflatten(structure, values)


T = TypeVar("T")
EpisodeSums = dict[str, jax.Array]


def episode_sums(state: State) -> EpisodeSums:
  """Sums over the episodes that ended in this step: number, returns, lengths, metrics, and non-finite steps.

  On Warp it also counts environments that overflow its buffers, which drops contacts or constraints.
  """
  ended = state.info["episode_done"]
  sums = {f"episode_{name}": (ended * total).sum() for name, total in state.info["episode_metrics"].items()}
  sums |= {"episodes": ended.sum(), "nonfinite": state.info["nonfinite"].sum()}
  buffers = state.data.buffers
  return sums if buffers is None else sums | {"overflows": (buffers.overflow != 0).sum().astype(ended.dtype)}


class Environments(struct.PyTreeNode):
  """A device's share of the environments during one training step.

  Attributes:
    state: the current batch of states.
    capture: the first non-finite step.
    model: randomised model fields.
    sums: over the episodes that ended in this training step, see `episode_sums`; {} before its first step.
    env: the task.
  """

  state: State
  capture: NonfiniteCapture
  model: ModelFields
  sums: EpisodeSums
  env: AutoReset = struct.field(pytree_node=False)

  def step(self, action: jax.Array) -> tuple["Environments", Observation]:
    """Steps each environment once.

    Returns:
      The new environments, and the observation before the auto-reset: where an episode ended, its last.
    """
    after = AutoReset(self.env.env, self.env.full_reset, keep_final_obs=True).step(self.state, action, self.model)
    info = dict(after.info)
    final_obs = info.pop(FINAL_OBS)  # not carried to the next step
    after = after.replace(info=info)
    capture = self.capture.look(self.state, action, self.model, after)
    return self._after(after, capture, episode_sums(after)), final_obs

  def scan(
    self, step: Callable[["Environments", jax.Array], tuple["Environments", T]], keys: jax.Array
  ) -> tuple["Environments", T]:
    """Scans `step(envs, key)` over keys; returns the environments and the stacked outputs."""

    def body(
      carry: tuple[State, NonfiniteCapture], key: jax.Array
    ) -> tuple[tuple[State, NonfiniteCapture], tuple[T, EpisodeSums]]:
      envs, out = step(self.replace(state=carry[0], capture=carry[1], sums={}), key)
      return (envs.state, envs.capture), (out, envs.sums)

    (state, capture), (out, sums) = jax.lax.scan(body, (self.state, self.capture), keys)
    return self._after(state, capture, jax.tree.map(lambda x: x.sum(axis=0), sums)), out

  def _after(self, state: State, capture: NonfiniteCapture, sums: EpisodeSums) -> "Environments":
    sums = jax.tree.map(jnp.add, self.sums, sums) if self.sums else sums
    return self.replace(state=state, capture=capture, sums=sums)


def unroll(
  envs: Environments,
  networks: Actor,
  policy_params: PyTree,
  normalizer: Normalizer | None,
  key: jax.Array,
  length: int,
  value: Callable[[dict[str, jax.Array]], jax.Array] | None = None,
) -> tuple[Environments, Transitions]:
  """Steps the environments `length` times with sampled actions.

  With the critic's `value` of normalised observations, it evaluates the last observation of every episode that ends at
  the time limit, in steps where any does.
  """

  def step(envs: Environments, key: jax.Array) -> tuple[Environments, Transitions]:
    obs = networks.select(envs.state.obs)
    logits = networks.logits(policy_params, normalize(obs, normalizer))
    raw_action = networks.distribution.sample_no_postprocessing(logits, key)
    envs, final_obs = envs.step(networks.distribution.postprocess(raw_action))
    after, truncation = envs.state, envs.state.info["truncation"]
    final_value = None
    if value is not None:
      final = lambda obs, value=value: value(normalize(networks.select(obs), normalizer)) * truncation
      final_value = jax.lax.cond(truncation.any(), final, lambda _: jnp.zeros_like(truncation), final_obs)
    transitions = Transitions(
      obs=obs,
      raw_action=raw_action,
      log_prob=networks.distribution.log_prob(logits, raw_action),
      reward=after.reward,
      termination=after.done * (1 - truncation),
      truncation=truncation,
      final_value=final_value,
    )
    return envs, transitions

  return envs.scan(step, jax.random.split(key, length))


def side_by_side(x: jax.Array) -> jax.Array:
  """Reshapes stacked trajectories [K, T, N, ...] to [T, K * N, ...]."""
  return x.swapaxes(0, 1).reshape(x.shape[1], -1, *x.shape[3:])
