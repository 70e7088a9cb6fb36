"""A policy that acts for as long as somebody watches: its task step by step, and what the watcher does to it."""

import time

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from playground.deploy.policy import ActingPolicy
from playground.envs.base import Env, State

STEP = 0.1  # m/s and rad/s of the command, for each press of a key
_COMMAND = "command"  # entry of `info`: the velocity that a joystick asks for
_TERM = "reward/"  # what metrics begin with that are terms of the reward


class Player:
  """One environment under an exported policy.

  Attributes:
    env: the task.
    exported: the policy; another may take its place at any time.
    state: the present state.
    command: forward m/s, left m/s, turn rad/s; None leaves it to the task, which draws one from time to time.
    force: forces and torques from outside in the next decisions, world frame, N and N m, [nbody, 6].
    takes_commands: whether the task is to follow a joystick.
    period: seconds of one decision.
    seconds: since this episode began.
    episode_return: sum of rewards in this episode.
    term_sums: the same of each weighted term of the reward, by name.
  """

  def __init__(self, env: Env, exported: ActingPolicy, seed: int = 0):
    """Starts an episode."""
    self.env = env
    self.exported = exported
    self._key = jax.random.PRNGKey(seed)
    self._directions = np.random.default_rng(seed)
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
    self.term_sums = {name.removeprefix(_TERM): 0.0 for name in self.state.metrics if name.startswith(_TERM)}

  def decide(self) -> State:
    """Lets the policy act once; an episode that has ended begins anew."""
    broken = not np.isfinite(self.state.data.qpos).all()
    if self.state.done or broken or self._steps >= self.env.episode_length:
      self.reset()
    action = self.exported.actions(self.state.obs)
    for _ in range(self.env.action_repeat):
      asked = np.zeros(3) if self.command is None else self.command
      self.state = self._step(self.state, action, self.force, asked, self.command is not None)
      self.episode_return += float(self.state.reward)
      for name in self.term_sums:
        self.term_sums[name] += float(self.state.metrics[_TERM + name])
    self._steps += self.env.action_repeat
    return self.state

  @property
  def seconds(self) -> float:
    return self._steps * self.env.dt

  @property
  def task_command(self) -> np.ndarray:
    """What the joystick asks for now, whoever moves it."""
    return np.asarray(self.state.info[_COMMAND]) if self.command is None else self.command

  def push(self, speed: float) -> None:
    """Gives what moves freely (else the first joint) `speed` m/s (rad/s) more, in any horizontal direction."""
    model = self.env.mj_model
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    angle = self._directions.uniform(0, 2 * np.pi)
    first = model.jnt_dofadr[free[0]] if len(free) else 0
    kick = [np.cos(angle), np.sin(angle)] if len(free) else [np.sign(np.cos(angle))]
    qvel = np.array(self.state.data.qvel)
    qvel[first : first + len(kick)] += speed * np.array(kick)
    self.state = self.state.replace(data=self.state.data.replace(qvel=jnp.asarray(qvel)))

  def pause_until_due(self, began: float) -> None:
    """Sleeps for what is left of a decision that began at `began` (`time.perf_counter()`)."""
    time.sleep(max(0.0, began + self.period - time.perf_counter()))

  def _driven_step(
    self, state: State, action: jax.Array, force: jax.Array, command: jax.Array, driven: jax.Array
  ) -> State:
    info = state.info
    if self.takes_commands:
      info = info | {_COMMAND: jnp.where(driven, command, info[_COMMAND])}
    data = state.data.replace(xfrc_applied=jnp.asarray(force))
    return self.env.step(state.replace(data=data, info=info), action)
