"""Tasks as dm_env environments, for agents written against that interface."""

from collections.abc import Mapping

import numpy as np

from playground.adapters.episodes import Episodes, Moment
from playground.envs.base import PIXELS
from playground.errors import ConfigError
from playground.extras import install_command
from playground.pytree import PyTree
from playground.settings import Section

try:
  import dm_env
  from dm_env import specs
except ImportError:
  raise ConfigError(f"playground.adapters.dm needs dm-env: {install_command('gym')}.") from None


class DmEnv(dm_env.Environment):
  """One environment. Dict observations stay dicts; the discount is 0 at a termination, 1 at the time limit."""

  def __init__(self, task: str, overrides: Section | None = None, physics: str = "c", seed: int = 0):
    """Builds a task; `physics` is `c` or `mjx`, see `playground.adapters.episodes.load_task`."""
    self._episodes = Episodes(task, overrides, physics)
    self._random = np.random.default_rng(seed)
    self._running = False

  def reset(self) -> dm_env.TimeStep:
    self._running = True
    return dm_env.restart(self._episodes.reset(int(self._random.integers(2**31 - 1))).obs)

  def step(self, action: np.ndarray) -> dm_env.TimeStep:
    if not self._running:
      return self.reset()
    moment = self._episodes.step(action)
    self._running = not (moment.terminated or moment.truncated)
    return _time_step(moment)

  def observation_spec(self) -> PyTree:
    sizes = self._episodes.env.observation_size
    if not isinstance(sizes, Mapping):
      return specs.Array((sizes,), np.float32, "observation")
    return {name: _spec(name, shape) for name, shape in sizes.items()}

  def action_spec(self) -> specs.BoundedArray:  # pyright: ignore[reportIncompatibleMethodOverride]
    return specs.BoundedArray((self._episodes.env.action_size,), np.float32, -1.0, 1.0, "action")

  def reward_spec(self) -> specs.Array:
    return specs.Array((), float, "reward")


def _spec(name: str, shape: tuple[int, ...]) -> specs.Array:
  """Returns the spec of one observation group; images are bytes."""
  if name.startswith(PIXELS):
    return specs.BoundedArray(shape, np.uint8, 0, 255, name)
  return specs.Array(shape, np.float32, name)


def _time_step(moment: Moment) -> dm_env.TimeStep:
  if moment.terminated:
    return dm_env.termination(moment.reward, moment.obs)
  return (dm_env.truncation if moment.truncated else dm_env.transition)(moment.reward, moment.obs)
