"""Recorded rolls of Playground 0.2.0 as states of this package's tasks.

A file `tests/golden/<Task>.npz` holds T + 1 records of data, info, obs, ... and the T actions between them, from
`reset(PRNGKey(0))` on, with the randomness of noise and pushes switched off (its header lists the overrides).
"""

import functools
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import playground
from playground.envs.base import Env, State
from playground.envs.physics import STATE_FIELDS

GOLDEN = Path(__file__).parents[1] / "golden"
TASKS = sorted(path.stem for path in GOLDEN.glob("*.npz"))
_OVERRIDES = {"impl": "impl", "noise_config.level": "noise.level", "pert_config.enable": "pushes.enable"}
_UNREAD_INFO = {"Cartpole": ("info/rng", "info/time_out")}  # upstream carries them, nothing reads them


def load_task(name: str, overrides: Mapping[str, Any] | None = None) -> Any:
  """Builds a task (typed Any, since tests look into it); `{"reward.scales.energy": 0}` overrides its config."""
  return playground.load(name, overrides=overrides)


class Golden:
  """One recording, and the task, in parity mode, that should reproduce it.

  Attributes:
    env: the task.
    first: its own state after reset from PRNGKey(0).
    states: the recorded states, leading axis T + 1.
    actions: shape [T, action_size].
  """

  def __init__(self, name: str):
    with np.load(GOLDEN / f"{name}.npz") as file:
      self._arrays = {key: file[key] for key in file.files}
    header = json.loads(str(self._arrays.pop("header")))
    overrides = {_OVERRIDES[key]: value for key, value in header["overrides"].items()}
    self.name = name
    self.env: Env = load_task(name, {**overrides, "impl": "jax", "parity": True})
    self.actions = jnp.array(self._arrays.pop("action"))
    self.first: State = jax.jit(self.env.reset)(jax.random.PRNGKey(0))
    self.states: State = jax.tree_util.tree_map_with_path(self._recorded, self.first)

  def _recorded(self, path: tuple[Any, ...], ours: jax.Array) -> jax.Array:
    name = _name(path)
    if name in self._arrays:
      return jnp.array(self._arrays[name])
    # Recordings leave out state that is empty or all zero. Anything else that we have, upstream had.
    assert name.startswith("data/") and name.removeprefix("data/") in STATE_FIELDS, f"{name} was not recorded"
    return jnp.broadcast_to(ours, (len(self.actions) + 1, *ours.shape))

  def missing(self) -> list[str]:
    """What was recorded and the task does not have, except unread data and metrics that are zero throughout."""
    ours = {_name(path) for path, _ in jax.tree_util.tree_flatten_with_path(self.first)[0]}
    unread = {key for prefix, keys in _UNREAD_INFO.items() if self.name.startswith(prefix) for key in keys}
    return [
      name
      for name, values in self._arrays.items()
      if name not in ours | unread
      and not name.startswith("data/")
      and not (name.startswith("metrics/") and not values.any())
    ]


def _name(path: tuple[Any, ...]) -> str:
  return "/".join(str(getattr(key, "name", getattr(key, "key", key))) for key in path)


def pairs(actual: State, expected: State) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
  """The leaves of two states as (name, actual, expected), floats in double precision."""
  leaves = jax.tree_util.tree_flatten_with_path(actual)[0]
  for (path, a), b in zip(leaves, jax.tree.leaves(expected), strict=True):
    yield _name(path), np.asarray(a, np.float64), np.asarray(b, np.float64)


@functools.cache
def golden(name: str) -> Golden:
  """One recording, built and compiled once for all tests."""
  return Golden(name)
