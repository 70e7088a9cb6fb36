"""Wrappers that make a batch of one task: vectorise, guard the numbers, limit episodes, reset.

Each wrapper takes and returns batches of `State` (leading axis N). A randomised model travels as an argument: a dict
from field name ("geom_friction", dotted for nested ones) to values with leading axis N, or None for the task's own.
"""

import copy
import operator
from collections.abc import Callable, Mapping
from typing import Any, Self, cast

import jax
import jax.numpy as jnp

from playground.envs.base import Env, State
from playground.errors import lookup
from playground.mdp.managers import TIME_OUT
from playground.physics.backend import STATE_FIELDS, WORLDS, BufferUse, mjx

ModelFields = Mapping[str, jax.Array]
Info = dict[str, Any]
# `info` keys that wrappers own; a fresh reset of a task never touches them.
EPISODE_KEYS = ("steps", "truncation", "episode_done", "episode_metrics")
PREFIX = "AutoResetWrapper_"
PRESERVE_INFO = PREFIX + "preserve_info"  # entries in it survive a full reset (the level of a curriculum)
FINAL_OBS = "final_obs"
MAX_VALUE = 1e10  # MuJoCo's own limit for positions and velocities (mjMAXVAL)
MAX_VELOCITY = 1e3  # m/s, rad/s: no robot moves so, and one such state among millions ruins a critic and its optimiser


def where_done(done: jax.Array, new: Any, old: Any) -> Any:
  """Selects the leaves of `new` where `done` (shape [N], 0/1 or bool), else those of `old`; leaves have leading N."""
  mask = done.astype(bool)
  return jax.tree.map(lambda n, o: jnp.where(mask.reshape(mask.shape + (1,) * (n.ndim - 1)), n, o), new, old)


class Wrapper:
  """Passes every call to the environment that it wraps."""

  def __init__(self, env: Any):
    self.env = env

  def with_settings(self, values: Mapping[str, jax.Array]) -> Self:
    """Returns the same with other values of the task's settings."""
    other = copy.copy(self)
    other.env = self.env.with_settings(values)
    return other

  def __getattr__(self, name: str) -> Any:
    if name.startswith("__"):
      raise AttributeError(name)
    if hasattr(type(self), name):  # a property of the wrapper that failed: raises its error
      return object.__getattribute__(self, name)
    return getattr(self.env, name)


class Vectorize(Wrapper):
  """Runs N copies of a task: `reset(keys [N])`, `step(state, actions [N, action_size])`, each on its own model.

  `fields` are the randomised model fields that apply if a call passes no `model`.
  """

  def __init__(self, env: Env, fields: ModelFields | None = None):
    super().__init__(env)
    self._reset_one, self._step_one = env.jitted
    self._fields = fields or {}
    self._settings: Mapping[str, jax.Array] = {}
    # On MJX's own backend nothing depends on the batch's size, and one trace serves all sizes.
    self._axis = WORLDS if env.impl == "warp" else None

  def with_settings(self, values: Mapping[str, jax.Array]) -> Self:
    other = copy.copy(self)
    other._settings = values
    return other

  def reset(self, rng: jax.Array, model: ModelFields | None = None) -> State:
    reset = jax.vmap(self._reset_one, (0, 0, None), axis_name=self._axis)
    return reset(rng, dict(model or self._fields), dict(self._settings))

  def step(self, state: State, action: jax.Array, model: ModelFields | None = None) -> State:
    step = jax.vmap(self._step_one, (0, 0, 0, None), axis_name=self._axis)
    return step(state, action, dict(model or self._fields), dict(self._settings))

  def redraw(self, info: Info, keys: jax.Array, model: ModelFields | None = None) -> Info:
    """Returns `info` with the task's `redraw` for every environment."""

    def redraw(info: Info, key: jax.Array, fields: dict[str, jax.Array]) -> Info:
      return self.env.redraw(info, key, self.env.mjx_model.tree_replace(fields) if fields else None)

    return jax.vmap(redraw)(info, keys, dict(model or self._fields))


class FiniteGuard(Wrapper):
  """Ends an episode whose numbers went NaN, infinite or too large, before they reach anything that learns.

  Too large is beyond `MAX_VALUE`, or `MAX_VELOCITY` in `qvel`: a diverging simulation holds finite values for some
  steps, which ruin observation statistics and the critic as surely as a NaN would.

  Such a step gives done = 1, reward 0, the previous observation, metrics 0 and the previous info; `info["nonfinite"]`
  is 1 for it, and `info["nonfinite_state"]` holds the simulator's state as it came out of the step.

  An episode whose reset gave such numbers observes zeros at first (`info["nonfinite_reset"]` is 1), and its first step
  counts as one of these.
  """

  def reset(self, rng: jax.Array, model: ModelFields | None = None) -> State:
    state = self.env.reset(rng, model)
    bad = ~_is_finite(state)
    info = {"nonfinite": jnp.zeros_like(state.done), "nonfinite_state": start_of(state), "nonfinite_reset": bad}
    obs = where_done(bad, jax.tree.map(jnp.zeros_like, state.obs), state.obs)
    return state.replace(obs=obs, info=state.info | info)

  def step(self, state: State, action: jax.Array, model: ModelFields | None = None) -> State:
    after = self.env.step(state, action, model)
    bad = ~_is_finite(after) | state.info["nonfinite_reset"]
    bad |= (state.info["nonfinite"] > 0) & (state.done > 0)  # a repeat of the action that gave such numbers
    zeros = jax.tree.map(jnp.zeros_like, (after.reward, after.metrics))
    reward, metrics = where_done(bad, zeros, (after.reward, after.metrics))
    obs, info = where_done(bad, (state.obs, state.info), (after.obs, after.info))
    if "rng" in info:  # or the next step would repeat the same draws
      info = info | {"rng": after.info["rng"]}
    return after.replace(
      obs=obs,
      reward=reward,
      metrics=metrics,
      done=jnp.where(bad, 1.0, after.done),
      info=info | {"nonfinite": bad.astype(after.done.dtype), "nonfinite_state": start_of(after)},
    )


def _is_finite(state: State) -> jax.Array:
  """Whether each environment's numbers are finite and within the guard's limits, [N]."""
  finite = jnp.ones_like(state.done, bool)
  for watched, limit in ((state.data.qvel, MAX_VELOCITY), ((state.data.qpos, state.reward, state.obs), MAX_VALUE)):
    for leaf in jax.tree.leaves(watched):
      if jnp.issubdtype(leaf.dtype, jnp.floating):
        finite &= (jnp.abs(leaf) <= limit).all(axis=tuple(range(1, leaf.ndim)))  # false for NaN, too
  return finite


# Reductions of the values of an episode: (so far, new, number including it) -> so far.
_SUMMARIES: dict[str, Callable[[jax.Array, jax.Array, jax.Array], jax.Array]] = {
  "sum": lambda old, new, n: old + new,
  "mean": lambda old, new, n: old + (new - old) / n,
  "max": lambda old, new, n: jnp.where(n > 1, jnp.maximum(old, new), new),
  "last": lambda old, new, n: new,
}


class Episode(Wrapper):
  """Ends episodes after `length` control steps and repeats each action.

  `info["episode_metrics"]` holds the episode's `sum_reward` and `length`, and the sum of each metric over policy steps,
  or the reduction that the task's `summaries` names. A non-finite step adds 0 to sums and is left out of the other
  reductions. A policy step's metrics are reduced over its repeats in the same way, up to the end of the episode.

  A time-out, by this limit or by a termination term with `time_out`, sets done = 1 and `info["truncation"]` = 1; a
  termination sets done = 1 and truncation 0. If an episode ends in one repeat of an action, it stays done and the later
  repeats add no reward.
  """

  def __init__(self, env: Any, length: int, action_repeat: int = 1):
    super().__init__(env)
    for name, kind in env.summaries.items():
      lookup(_SUMMARIES, kind, f"{type(env.unwrapped).__name__}.summaries[{name!r}]")
    self.length = length
    self.repeat = action_repeat

  def reset(self, rng: jax.Array, model: ModelFields | None = None) -> State:
    state = self.env.reset(rng, model)
    _lookup_own("summaries", self.env.unwrapped, state.metrics)
    zero = jnp.zeros_like(state.reward)
    sums = {"sum_reward": zero, "length": zero} | {name: zero for name in state.metrics}
    info = {"steps": zero, "truncation": zero, "episode_done": zero, "episode_metrics": sums}
    return state.replace(info=state.info | info)

  def step(self, state: State, action: jax.Array, model: ModelFields | None = None) -> State:
    def is_cut(state: State) -> jax.Array:
      return state.info.get(TIME_OUT, jnp.zeros_like(state.done)) * (1 - state.info["nonfinite"])

    def repeat(
      carry: tuple[State, jax.Array, jax.Array, jax.Array, dict[str, jax.Array], BufferUse | None], n: jax.Array
    ) -> tuple[Any, None]:
      state, reward, done, cut, metrics, used = carry
      state = self.env.step(state, action, model)
      cut = jnp.where(done > 0, cut, is_cut(state))
      used = None if used is None else used.join(state.data.buffers)
      metrics = {k: jnp.where(done > 0, old, reduce[k](old, state.metrics[k], n)) for k, old in metrics.items()}
      return (state, reward + state.reward * (1 - done), jnp.maximum(done, state.done), cut, metrics, used), None

    was_done = state.info["episode_done"]
    kinds = {k: kind for k, kind in self.env.summaries.items() if k in state.metrics}
    reduce = {k: _SUMMARIES[kinds.get(k, "sum")] for k in state.info["episode_metrics"]}
    if self.repeat == 1:
      after = self.env.step(state, action, model)
      reward, ended, cut = after.reward, after.done, is_cut(after)
    else:
      unused = jax.tree.map(jnp.zeros_like, state.data.buffers)
      none, zero = jax.tree.map(jnp.zeros_like, state.metrics), jnp.zeros_like(state.done)
      start = (state, jnp.zeros_like(state.reward), zero, zero, none, unused)
      (after, reward, ended, cut, metrics, used), _ = jax.lax.scan(repeat, start, jnp.arange(1, self.repeat + 1))
      after = after.replace(data=after.data.replace(buffers=used), metrics=metrics)

    steps = state.info["steps"] + self.repeat
    timed_out = steps >= self.length
    done = jnp.where(timed_out, 1.0, ended)
    sums = {k: jnp.where(was_done > 0, 0.0, v) for k, v in state.info["episode_metrics"].items()}
    values = {"sum_reward": reward, "length": jnp.full_like(reward, self.repeat)} | after.metrics
    count = sums["length"] / self.repeat + 1  # not of `steps`, which may begin at a random age
    totals = {k: reduce[k](old, values[k], count) for k, old in sums.items()}
    totals |= {k: jnp.where(after.info["nonfinite"] > 0, sums[k], totals[k]) for k in kinds}
    info = after.info | {
      "steps": steps,
      "truncation": jnp.where(timed_out, 1 - ended + cut, cut),
      "episode_done": done,
      "episode_metrics": totals,
    }
    return after.replace(reward=reward, done=done, info=info)


class AutoReset(Wrapper):
  """Starts the next episode in the step that ends one: done = 1 comes with the next episode's first observation.

  By default an episode starts again from the environment's state of the last outer `reset`, of which the simulator's
  state, the observation and the entries `env.episode_info` of `info` are stored (not the derived fields, which the next
  step writes anyway); the other entries of `info` go on. With `full_reset` it starts from a new `reset`, `info`
  included, except the entries of `info["AutoResetWrapper_preserve_info"]`.

  With `keep_final_obs` `info["final_obs"]` is the observation that the step itself made: where done = 1 the last one of
  the episode, else `obs`.
  """

  def __init__(self, env: Any, full_reset: bool = False, keep_final_obs: bool = False):
    super().__init__(env)
    self.full_reset = full_reset
    self.keep_final_obs = keep_final_obs

  def reset(self, rng: jax.Array, model: ModelFields | None = None) -> State:
    keys = jax.vmap(jax.random.split)(rng)
    state = self.env.reset(keys[:, 0], model)
    _lookup_own("episode_info", self.env.unwrapped, state.info)
    own: Info = {PREFIX + "rng": keys[:, 1], PREFIX + "done_count": jnp.zeros(state.done.shape, jnp.int32)}
    if not self.full_reset:
      own[PREFIX + "first_data"] = start_of(state)
      own[PREFIX + "first_obs"] = state.obs
      own[PREFIX + "first_info"] = {k: state.info[k] for k in self.env.episode_info if k in state.info}
    final = {FINAL_OBS: state.obs} if self.keep_final_obs else {}
    return state.replace(info=state.info | own | final)

  def step(self, state: State, action: jax.Array, model: ModelFields | None = None) -> State:
    own = {k: v for k, v in state.info.items() if k.startswith(PREFIX) and k != PRESERVE_INFO}
    info = {k: v for k, v in state.info.items() if k not in own and k != FINAL_OBS}
    info["steps"] = jnp.where(state.done > 0, 0.0, info["steps"])
    after = self.env.step(state.replace(done=jnp.zeros_like(state.done), info=info), action, model)
    own[PREFIX + "done_count"] += after.done.astype(jnp.int32)
    own |= {FINAL_OBS: after.obs} if self.keep_final_obs else {}

    def new_keys() -> jax.Array:
      keys = jax.vmap(jax.random.split)(own[PREFIX + "rng"])
      own[PREFIX + "rng"] = keys[:, 0]
      return keys[:, 1]

    if self.full_reset:
      # A reset costs a forward pass over the whole batch: skip it in steps in which no environment is done.
      after = jax.lax.cond(after.done.any(), self._restart, lambda s, *_: s, after, new_keys(), model)
    else:
      data = after.data.replace(**where_done(after.done, own[PREFIX + "first_data"], start_of(after)))
      first = own[PREFIX + "first_info"]
      info = after.info | where_done(after.done, first, {name: after.info[name] for name in first})
      if self.env.unwrapped.redraws:
        keys = new_keys()
        redraw = lambda info: where_done(after.done, self.env.redraw(info, keys, model), info)
        info = jax.lax.cond(after.done.any(), redraw, lambda info: info, info)
      after = after.replace(data=data, obs=where_done(after.done, own[PREFIX + "first_obs"], after.obs), info=info)
    return after.replace(info=after.info | own)

  def _restart(self, after: State, keys: jax.Array, model: ModelFields | None) -> State:
    fresh = self.env.reset(keys, model)
    kept = {k: after.info[k] for k in (*EPISODE_KEYS, "nonfinite", "nonfinite_state", PRESERVE_INFO) if k in after.info}
    data, obs, info = where_done(after.done, (fresh.data, fresh.obs, fresh.info), (after.data, after.obs, after.info))
    return after.replace(data=data, obs=obs, info=info | kept)


def _lookup_own(attribute: str, env: Env, known: Mapping[str, Any]) -> None:
  """Raises UnknownNameError for a name that the task's own class adds and that does not exist.

  A base class, or a class of this package, may name what only some configurations have.
  """
  cls = type(env)
  for name in getattr(cls, attribute) if not cls.__module__.startswith("playground.") else ():
    if not any(name in getattr(base, attribute, ()) for base in cls.__bases__):
      lookup(known, name, f"{cls.__name__}.{attribute}")


def start_of(state: State) -> dict[str, jax.Array]:
  """The fields of the simulator's state that the next step depends on, by name."""
  return {name: getattr(state.data, name) for name in STATE_FIELDS}


def wrap_for_training(env: Env, *, full_reset: bool = False) -> AutoReset:
  """The stack that trainers step: a batch of guarded, limited, self-resetting episodes of one task."""
  return AutoReset(wrap_for_evaluation(env), full_reset)


def wrap_for_evaluation(env: Env) -> Episode:
  """Wraps as for training, but an episode that ends stays ended."""
  return Episode(FiniteGuard(Vectorize(env)), env.episode_length, env.action_repeat)


def wrap_for_brax_training(
  env: Env,
  episode_length: int = 1000,
  action_repeat: int = 1,
  randomization_fn: Callable[[mjx.Model], tuple[mjx.Model, mjx.Model]] | None = None,
  full_reset: bool = False,
) -> Wrapper:
  """Wraps a task for Brax's own trainers (`ppo.train(wrap_env_fn=wrap_for_brax_training)`).

  `randomization_fn` takes the device model and returns (model with a leading axis N on the randomised fields, tree of
  the same structure with 0 at those fields and None elsewhere), as `registry.get_domain_randomizer` gives it with its
  keys bound.
  """
  fields = None if randomization_fn is None else _batched_fields(*randomization_fn(env.mjx_model))
  return AutoReset(Episode(FiniteGuard(Vectorize(env, fields)), episode_length, action_repeat), full_reset)


def _batched_fields(model: mjx.Model, in_axes: mjx.Model) -> dict[str, jax.Array]:
  """The fields of `model` that `in_axes` marks with 0, by dotted name."""
  axes = jax.tree_util.tree_leaves_with_path(in_axes, is_leaf=lambda x: x is None)
  names = [".".join(cast(Any, key).name for key in path) for path, axis in axes if axis == 0]
  return {name: operator.attrgetter(name)(model) for name in names}
