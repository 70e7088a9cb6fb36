"""Puts observations together: their parts, the noise on them, and what they keep of the steps before."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from playground.errors import ConfigError
from playground.mdp.lookup import lookup
from playground.mdp.noise import add_noise
from playground.mdp.observations import OBSERVATIONS

ACTOR = "state"  # the observation of what the robot's own sensors tell: noisy; the others are exact

Parts = Mapping[str, Callable[[Any], jax.Array]]  # part by name, a function of the present moment

# Parts that a robot computes from another: they carry its noise.
_COMPUTED_FROM = {"target_error": "joint_pos"}


class Observer:
  """Concatenates the parts that `env.obs` lists, each list one entry of the observation.

  `state` is with noise. There a part may be `<name>_history`: the last `env.history.<name>` values of the part `name`,
  newest first; and with `env.frames` above 1 all of it is that of the last steps, newest first. What came before an
  episode's first observation is 0. The past is read out of the last observation: it begins anew with every episode,
  also where wrappers restart one, and nothing is stored twice.

  Attributes:
    looks_back: whether an observation needs the last one.
  """

  def __init__(self, config: Any, parity: bool, functions: Parts = OBSERVATIONS):
    """Binds the parts that the task's config names.

    Args:
      config: the task's ConfigDict. It has `obs` and `noise`; it may have `parity_obs`, `obs_scales` (factors on
        parts), `history` and `frames`.
      parity: whether the slips of Playground 0.2.0 in `parity_obs` and `noise.parity_shared` count.
      functions: the parts to choose from, by name: functions of the present moment.

    Raises:
      UnknownNameError: a part that does not exist.
      ConfigError: a number of steps below 1.
    """
    slips = dict(config.get("parity_obs", {}))
    for name, other in slips.items():
      lookup(functions, name if other is None else other, "env.parity_obs")
    slips = slips if parity else {}
    self._parts = {**functions, **{name: functions[other] for name, other in slips.items() if other}}
    scales, history = config.get("obs_scales", {}), config.get("history", {})
    for key, names in (("obs_scales", scales), ("history", history)):
      for name in names:
        lookup(self._parts, name, f"env.{key}")
    self._factors = {name: np.asarray(scales[name]) for name in scales}
    self._steps = {name: int(history[name]) for name in history}
    self._frames: int = config.get("frames", 1)
    for key, steps in {"frames": self._frames, **{f"history.{name}": n for name, n in self._steps.items()}}.items():
      if steps < 1:
        raise ConfigError(f"env.{key}={steps} must be a number of steps, 1 or more.")
    self.looks_back = max(self._frames, *self._steps.values(), 1) > 1
    groups = sorted(config.obs, key=lambda group: (group != ACTOR, group))
    left_out = {name for name, other in slips.items() if other is None}
    listed = {group: tuple(part for part in config.obs[group] if part not in left_out) for group in groups}
    self._groups = {group: parts for group, parts in listed.items() if parts}
    of_state = {**self._parts, **{f"{name}_history": None for name in self._steps}}
    for group, parts in self._groups.items():
      for part in parts:
        lookup(of_state if group == ACTOR else {ACTOR: None, **self._parts}, part, f"env.obs.{group}")
    self._bind_noise(config.noise, parity)

  def _bind_noise(self, noise: Any, parity: bool) -> None:
    amplitudes = {name: noise.level * np.asarray(noise.scales[name]) for name in noise.scales}
    for name in amplitudes:
      lookup(self._parts, name, "env.noise.scales")
    sensed = {*self._groups[ACTOR], *(_COMPUTED_FROM.get(name, name) for name in self._steps)}
    self._noise = {name: amplitudes[name] for name in self._parts if name in amplitudes and name in sensed}
    shared = tuple(noise.get("parity_shared", ()))
    self._shared = shared if parity else ()
    self._noise_in_histories: bool = noise.get("in_histories", True)

  def parts(self, first: Callable[[jax.Array], Any]) -> dict[str, dict[str, int]]:
    """`sizes` of the moment that `first` makes of a random key, which is only traced."""
    found: dict[str, dict[str, int]] = {}
    jax.eval_shape(lambda rng: found.update(self.sizes(first(rng))), jax.random.PRNGKey(0))
    return found

  def sizes(self, now: Any) -> dict[str, dict[str, int]]:
    """Returns the length of each part, by observation; of frames the newest, with the others' under `past_frames`."""
    names = {part for parts in self._groups.values() for part in parts} - {ACTOR}
    sizes = {}
    for name in names:
      base = name.removesuffix("_history")
      sizes[name] = self._part(now, base).size * (1 if name == base else self._steps[base])
    parts = {part: sizes[part] for part in self._groups[ACTOR]}
    frame = sum(parts.values())
    past = {"past_frames": (self._frames - 1) * frame} if self._frames > 1 else {}
    sizes[ACTOR] = self._frames * frame
    return {
      group: {part: sizes[part] for part in parts} | (past if group == ACTOR else {})
      for group, parts in self._groups.items()
    }

  def observe(self, now: Any, rng: jax.Array, last: Any = None) -> tuple[jax.Array, Any]:
    """Observes the present.

    Args:
      now: the present moment.
      rng: random key of the noise.
      last: the observation of the step before; None at the start of an episode.

    Returns:
      The next random key, and the observation: one vector where there is only `state`.
    """
    clean = {name: self._part(now, name) for name in self._noise}
    rng, noisy = add_noise(rng, clean, self._noise, self._shared)
    last = last[ACTOR] if isinstance(last, dict) else last
    frame: list[jax.Array] = []
    for part in self._groups[ACTOR]:
      name = part.removesuffix("_history")
      if name == part:
        frame.append(noisy[part] if part in noisy else self._part(now, part))
        continue
      value, source = self._part(now, name), _COMPUTED_FROM.get(name, name)
      if source in noisy and self._noise_in_histories:
        value += noisy[source] - clean[source]
      frame.append(_with_past(value, self._steps[name], last, start=sum(piece.size for piece in frame)))
    obs = {ACTOR: _with_past(jnp.concatenate(frame), self._frames, last, start=0)}
    for group, parts in self._groups.items():
      if group != ACTOR:
        obs[group] = jnp.concatenate([obs[part] if part in obs else self._part(now, part) for part in parts])
    return rng, obs[ACTOR] if len(obs) == 1 else obs

  def skip(self, rng: jax.Array) -> jax.Array:
    """The random key that `observe` returns, without observing: for what is drawn after it and must be known before."""
    for _ in self._noise:
      rng, _ = jax.random.split(rng)
    return rng

  def _part(self, now: Any, name: str) -> jax.Array:
    value = self._parts[name](now)
    return value * self._factors[name] if name in self._factors else value


def _with_past(newest: jax.Array, steps: int, last: jax.Array | None, start: int) -> jax.Array:
  """`newest` and the `steps` - 1 values before it, the first of which `last` holds from `start` on."""
  size = (steps - 1) * newest.size
  if size == 0:
    return newest
  return jnp.concatenate([newest, jnp.zeros(size) if last is None else last[start : start + size]])
