"""A policy that acts for as long as somebody watches: its task step by step, and what the watcher does to it."""

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from playground.deploy.policy import ExportedPolicy
from playground.envs.base import Env, State

_COMMAND = "command"  # entry of `info`: the velocity that a joystick asks for


class Player:
  """One environment under an exported policy.

  Attributes:
    state: the present state.
    command: forward m/s, left m/s, turn rad/s; None leaves it to the task, which draws one from time to time.
    force: forces and torques from outside in the next decisions, world frame, N and N m, [nbody, 6].
    takes_commands: whether the task is to follow a joystick.
    period: seconds of one decision.
    episode_return: sum of rewards in this episode.
  """

  def __init__(self, env: Env, exported: ExportedPolicy, seed: int = 0):
    """Starts an episode."""
    self._env = env
    self._exported = exported
    self._key = jax.random.PRNGKey(seed)
    self._reset = jax.jit(env.reset)
    self._step = jax.jit(self._driven_step)
    self.takes_commands = _COMMAND in jax.eval_shape(env.reset, self._key).info
    self.command: np.ndarray | None = None
    self.force = np.zeros((env.mj_model.nbody, 6), np.float32)
    self.period = env.dt * env.action_repeat
    self.reset()

  def reset(self) -> None:
    """Starts the next episode."""
    self._key, key = jax.random.split(self._key)
    self.state: State = self._reset(key)
    self._steps, self.episode_return = 0, 0.0

  def decide(self) -> State:
    """Lets the policy act once; an episode that has ended begins anew."""
    if self.state.done or self._steps >= self._env.episode_length:
      self.reset()
    entry = self._exported.contract["policy"]["entry"]
    obs: Any = self.state.obs
    action = self._exported.actions(np.asarray(obs[entry] if isinstance(obs, dict) else obs))
    for _ in range(self._env.action_repeat):
      asked = np.zeros(3) if self.command is None else self.command
      self.state = self._step(self.state, action, self.force, asked, self.command is not None)
      self.episode_return += float(self.state.reward)
    self._steps += self._env.action_repeat
    return self.state

  def pause_until_due(self, began: float, speed: float = 1.0) -> None:
    """Sleeps for what is left of a decision that began at `began` (`time.perf_counter()`), at `speed` times real."""
    time.sleep(max(0.0, began + self.period / speed - time.perf_counter()))

  def _driven_step(self, state: State, action: Any, force: Any, command: Any, driven: Any) -> State:
    info = state.info
    if self.takes_commands:
      info = info | {_COMMAND: jnp.where(driven, command, info[_COMMAND])}
    data = state.data.replace(xfrc_applied=jnp.asarray(force))
    return self._env.step(state.replace(data=data, info=info), action)
