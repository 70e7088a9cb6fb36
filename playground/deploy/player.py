"""Steps a task with a policy, and applies the user's commands and pushes."""

import copy
import time

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from playground.deploy.policy import ActingPolicy
from playground.envs.base import Env, State

STEP = 0.1  # m/s and rad/s of the command, for each press of a key
_COMMAND = "command"  # entry of `info`: the velocity command of a joystick
_TERM = "reward/"  # prefix of metrics that are reward terms


class Player:
  """Runs one environment with an exported policy.

  Attributes:
    env: the task.
    exported: the policy; it may be replaced at any time.
    state: the present state.
    previous_qpos: joint positions one policy step before `state`, [nq].
    command: forward m/s, left m/s, turn rad/s; with None, the task draws commands itself.
    manual_action: acts instead of the policy, in [-1, 1], [action_size]; None lets the policy act.
    action: the last action, [action_size].
    force: external forces and torques in the next policy steps, world frame, N and N m, [nbody, 6].
    takes_commands: whether the task follows a velocity command.
    period: seconds of one policy step.
    seconds: time in this episode, s.
    episode_return: sum of rewards in this episode.
    terms: each weighted reward term of the last policy step, by name.
  """

  def __init__(self, env: Env, exported: ActingPolicy, seed: int = 0):
    """Starts an episode."""
    self.env = env
    self.exported = exported
    self._seed(seed)
    self._reset = jax.jit(env.reset)
    self._step = jax.jit(self._driven_step)
    self.takes_commands = _COMMAND in jax.eval_shape(env.reset, self._key).info
    self.command: np.ndarray | None = None
    self.manual_action: np.ndarray | None = None
    self.force = np.zeros((env.mj_model.nbody, 6), np.float32)
    self.period = env.dt * env.action_repeat
    self.reset()

  def copy(self, seed: int) -> "Player":
    """Returns another environment with the same task, policy and compiled functions, in a separate episode."""
    other = copy.copy(self)
    other._seed(seed)
    other.reset()
    return other

  def reset(self) -> None:
    """Starts the next episode."""
    self._key, key = jax.random.split(self._key)
    self.state: State = self._reset(key)
    self._steps, self.episode_return = 0, 0.0
    self.action = np.zeros(self.env.action_size)
    self.terms = {name.removeprefix(_TERM): 0.0 for name in self.state.metrics if name.startswith(_TERM)}
    self.show_present()

  def policy_step(self) -> State:
    """Advances by one policy step; resets first if the episode has ended."""
    broken = not np.isfinite(self.state.data.qpos).all()
    if self.state.done or broken or self._steps >= self.env.episode_length:
      self.reset()
    self.show_present()
    self.action = self.exported.actions(self.state.obs) if self.manual_action is None else self.manual_action
    self.terms = dict.fromkeys(self.terms, 0.0)
    for _ in range(self.env.action_repeat):
      asked = np.zeros(3) if self.command is None else self.command
      self.state = self._step(self.state, self.action, self.force, asked, self.command is not None)
      self.episode_return += float(self.state.reward)
      for name in self.terms:
        self.terms[name] += float(self.state.metrics[_TERM + name])
      if self.state.done:
        break
    self._steps += self.env.action_repeat
    return self.state

  def show_present(self) -> None:
    """Starts the interpolation of poses at the present state."""
    self.previous_qpos = np.asarray(self.state.data.qpos)

  @property
  def seconds(self) -> float:
    return self._steps * self.env.dt

  @property
  def task_command(self) -> np.ndarray:
    """The present command of the task or of the user: forward m/s, left m/s, turn rad/s."""
    return np.asarray(self.state.info[_COMMAND]) if self.command is None else self.command

  def push(self, speed: float) -> None:
    """Adds `speed` in a random horizontal direction to the free body, m/s, else to the first joint, m/s or rad/s."""
    model = self.env.mj_model
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    angle = self._directions.uniform(0, 2 * np.pi)
    first = model.jnt_dofadr[free[0]] if len(free) else 0
    kick = [np.cos(angle), np.sin(angle)] if len(free) else [np.sign(np.cos(angle))]
    qvel = np.array(self.state.data.qvel)
    qvel[first : first + len(kick)] += speed * np.array(kick)
    self.state = self.state.replace(data=self.state.data.replace(qvel=jnp.asarray(qvel)))

  def set_joint(self, address: int, position: float) -> None:
    """Moves one hinge or slide joint, by its address in `qpos`, to a position in rad or m."""
    qpos = np.array(self.state.data.qpos)
    qpos[address] = position
    self.state = self.state.replace(data=self.state.data.replace(qpos=jnp.asarray(qpos)))
    self.show_present()

  def pause_until_due(self, began: float) -> None:
    """Sleeps for the rest of a policy step that began at `began` (`time.perf_counter()`)."""
    time.sleep(max(0.0, began + self.period - time.perf_counter()))

  def _seed(self, seed: int) -> None:
    self._key = jax.random.PRNGKey(seed)
    self._directions = np.random.default_rng(seed)

  def _driven_step(
    self, state: State, action: jax.Array, force: jax.Array, command: jax.Array, driven: jax.Array
  ) -> State:
    info = state.info
    if self.takes_commands:
      info = info | {_COMMAND: jnp.where(driven, command, info[_COMMAND])}
    data = state.data.replace(xfrc_applied=jnp.asarray(force))
    return self.env.step(state.replace(data=data, info=info), action)
