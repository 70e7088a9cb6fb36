"""What the DM Control Suite's tasks share: the model beside the module, motors driven directly, endless episodes."""

import abc
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from playground.envs.base import Env, State
from playground.envs.physics import DERIVED_FIELDS, PhysicsData, mjx
from playground.errors import ConfigError
from playground.mdp.context import StepContext
from playground.mdp.managers import RewardManager, TerminationManager
from playground.mdp.tolerance import tolerance

Terms = dict[str, jax.Array]


def load_spec(domain: str) -> mujoco.MjSpec:
  """The domain's MJCF, for a task to edit and compile."""
  return mujoco.MjSpec.from_file(str(Path(__file__).with_name(f"{domain}.xml")))


def move_speed(config: Any) -> float:
  """`env.move_speed` in m/s, of tasks where 0 means to stand.

  Raises:
    ConfigError: it is negative.
  """
  if config.move_speed < 0:
    raise ConfigError(f"env.move_speed={config.move_speed} must be at least 0 m/s (0: stand).")
  return config.move_speed


def small_control(action: jax.Array) -> jax.Array:
  """1 for no action, 0.8 where all are at (or beyond) full scale."""
  return (4 + tolerance(action, margin=1, sigmoid="quadratic", value_at_margin=0).mean()) / 5


class SuiteTask(Env):
  """A task of the suite (paper, Appendix A): the action is `ctrl`.

  A domain says how an episode starts, what is observed and what is rewarded. The terms of `env.rewards` are added to
  that reward, those of `env.terminations` end an episode; they read `c.data`, `c.action` and `c.env.mj_model`.
  """

  episode_info = ("last_act", "last_last_act")
  robot = None

  def __init__(self, config: Any, mj_model: mujoco.MjModel):
    """Binds the terms; raises ConfigError for an event of another mode than startup."""
    for name, entry in (config.get("events") or {}).items():
      if entry is not None and entry.get("mode") != "startup":
        raise ConfigError(f"env.events.{name}.mode={entry.get('mode')}: tasks of this suite have startup events only.")
    self.rewards, self.terminations = RewardManager(config.rewards), TerminationManager(config.terminations)
    added = [*self.rewards.terms, *self.terminations.terms]
    if self.rewards.terms or any(not term.func.__module__.startswith("playground.") for term in added):
      self.derived = DERIVED_FIELDS  # which a term may read
    super().__init__(config, mj_model)

  @abc.abstractmethod
  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    """State fields at the start of an episode, by name ("qpos", "qvel", "mocap_pos"), from one random key."""

  @abc.abstractmethod
  def observe(self, data: PhysicsData) -> jax.Array:
    """The observation, one vector."""

  @abc.abstractmethod
  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    """The reward in [0, 1] and the terms it is made of, which are logged as `reward/<name>`."""

  def reset(self, rng: jax.Array, model: mjx.Model | None = None) -> State:
    model = self.mjx_model if model is None else model
    data = self.settle(self.physics.forward(model, self.physics.make(**self.initial(rng))), model)
    nothing = jnp.zeros(self.action_size)
    state = self.post_step(data, {"last_act": nothing, "last_last_act": nothing} if self.rewards.terms else {}, nothing)
    zero = jnp.zeros(())
    return state.replace(reward=zero, done=zero, metrics={name: zero for name in state.metrics})

  def sensor(self, data: PhysicsData, name: str) -> jax.Array:
    """The reading of the model's sensor `name`, shape [dim]."""
    sensor = self.mj_model.sensor(name)
    return data.sensordata[sensor.adr[0] : sensor.adr[0] + sensor.dim[0]]

  def planar_pose(self, angle_key: jax.Array, joints_key: jax.Array) -> jax.Array:
    """`qpos` of a planar model (two slides, a hinge, then joints) at the origin, turned and bent at random."""
    low, high = self.mj_model.jnt_range[3:].T
    angle = jax.random.uniform(angle_key, (1,), minval=-jnp.pi, maxval=jnp.pi)
    joints = jax.random.uniform(joints_key, low.shape, minval=low, maxval=high)
    return jnp.concatenate([jnp.zeros(2), angle, joints])

  def settle(self, data: PhysicsData, model: mjx.Model) -> PhysicsData:
    """Lets the initial state come to rest, where a task needs that."""
    return data

  def action_to_ctrl(self, state: State, action: jax.Array) -> jax.Array:
    return action

  def post_step(self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array) -> State:
    reward, terms = self.reward(data, action)
    c = StepContext(self, data, info, action)  # pyright: ignore[reportArgumentType]  # it has the parts that terms read
    more, ended = self.rewards.compute(c), self.terminations.compute(c)
    metrics = {f"reward/{name}": value for name, value in (terms | more).items()}
    metrics |= {f"termination/{name}": value.astype(jnp.float32) for name, value in ended.items()}
    after = {**info, "last_act": action, "last_last_act": info["last_act"]} if self.rewards.terms else dict(info)
    reward = sum(more.values(), reward)
    return State(data, self.observe(data), reward, c.terminated.astype(jnp.float32), metrics, after)
