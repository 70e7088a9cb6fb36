"""Base of the DM Control Suite's tasks: the model beside the module, motors driven directly, endless episodes."""

import abc
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from playground.envs.base import Env, State
from playground.errors import ConfigError, UnknownNameError, nearest
from playground.mdp.context import StepContext
from playground.mdp.managers import RewardManager, TerminationManager
from playground.mdp.terms import registered
from playground.mdp.tolerance import tolerance
from playground.physics.backend import DERIVED_FIELDS, PhysicsData, compile_spec, mjx
from playground.text import format_value

Terms = dict[str, jax.Array]


class SuiteTask(Env):
  """A task of the suite (paper, Appendix A): the action is `ctrl`.

  A domain defines initial states, observations and rewards. The terms of `env.rewards` are added to
  that reward, those of `env.terminations` end an episode; they read `c.data`, `c.action` and `c.env.mj_model`.

  Attributes:
    domain: name of the MJCF beside the module.
    body, site, geom: ids by name: `data.xpos[self.body["torso"]]`.
  """

  domain: ClassVar[str]
  episode_info = ("last_act", "last_last_act")
  managers = ("rewards",)
  robot = None

  def __init__(self, config: Any):
    """Compiles the scene and binds the terms. `config`: the task's, e.g. `configs/env/WalkerStand.yaml`."""
    for name, entry in (config.get("events") or {}).items():
      if entry is not None and entry.get("mode") != "startup":
        mode = format_value(entry.get("mode"))
        raise ConfigError(f"env.events.{name}.mode={mode}: DM Control's tasks take only events of mode startup.")
    self.rewards, self.terminations = RewardManager(config.rewards), TerminationManager(config.terminations)
    added = [*self.rewards.terms, *self.terminations.terms]
    if self.rewards.terms or any(not term.func.__module__.startswith("playground.") for term in added):
      self.derived = DERIVED_FIELDS  # which a term may read
    super().__init__(config, compile_spec(self.scene(config)))
    model = self.mj_model
    self.body = {model.body(i).name: i for i in range(model.nbody)}
    self.site = {model.site(i).name: i for i in range(model.nsite)}
    self.geom = {model.geom(i).name: i for i in range(model.ngeom)}

  @classmethod
  def settings_of(cls, config: Any) -> dict[str, np.ndarray]:
    known = registered("rewards")
    for name, entry in (config.get("rewards") or {}).items():
      if hasattr(entry, "get") and not entry.get("func") and name not in known:
        fixed = "the reward of DM Control's tasks is fixed, and a term that is added to it names its function"
        raise UnknownNameError(f"env.rewards.{name} has no func: {fixed}.{nearest(name, known)}")
    return super().settings_of(config)

  def scene(self, config: Any) -> mujoco.MjSpec:
    """Returns the scene to compile: the domain's MJCF, changed by the config."""
    del config
    return mujoco.MjSpec.from_file(str(Path(__file__).with_name(f"{self.domain}.xml")))

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    """State fields at the start of an episode that are not the model's, by name ("qpos", ...), from one random key."""
    return {}

  def parts(self, data: PhysicsData) -> dict[str, jax.Array]:
    """The parts of the observation by name, in their order; by default `qpos` and `qvel`."""
    return {"position": data.qpos, "velocity": data.qvel}

  @abc.abstractmethod
  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    """The reward in [0, 1] and the terms it is made of, which are logged as `reward/<name>`."""

  def observe(self, data: PhysicsData) -> jax.Array:
    """The observation, one vector."""
    return jnp.concatenate([part.ravel() for part in self.parts(data).values()])

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    sizes: dict[str, int] = {}
    jax.eval_shape(lambda: sizes.update({name: part.size for name, part in self.parts(self.physics.make()).items()}))
    return {"state": sizes}

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

  def draw_joints(self, key: jax.Array, joints: slice = slice(None)) -> jax.Array:
    """Draws positions of joints, uniform in their ranges; `joints` are their ids."""
    low, high = self.mj_model.jnt_range[joints].T
    return jax.random.uniform(key, low.shape, minval=low, maxval=high)

  def draw_planar_pose(self, angle_key: jax.Array, joints_key: jax.Array) -> jax.Array:
    """Draws `qpos` of a planar model (two slides, a hinge, then joints): at the origin, turned and bent at random."""
    return jnp.concatenate([jnp.zeros(2), draw_angle(angle_key, (1,)), self.draw_joints(joints_key, slice(3, None))])

  def settle(self, data: PhysicsData, model: mjx.Model) -> PhysicsData:
    """Lets the initial state come to rest, where a task needs that."""
    return data

  def action_to_ctrl(self, state: State, action: jax.Array) -> jax.Array:
    return action

  def post_step(self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array) -> State:
    reward, terms = self.reward(data, action)
    c = StepContext(self, data, info, action)  # pyright: ignore[reportArgumentType]  # it has the parts that terms read
    more, reasons = self.rewards.compute(c), self.terminations.compute(c)
    metrics = {f"reward/{name}": value for name, value in (terms | more).items()}
    metrics |= {f"termination/{name}": value.astype(jnp.float32) for name, value in reasons.items()}
    done, ended = self.terminations.end(c)
    after = {**info, "last_act": action, "last_last_act": info["last_act"]} if self.rewards.terms else dict(info)
    reward = sum(more.values(), reward)
    return State(data, self.observe(data), reward, done, metrics, after | ended)


def draw_angle(key: jax.Array, shape: tuple[int, ...] = ()) -> jax.Array:
  """Draws angles anywhere on the circle, rad."""
  return jax.random.uniform(key, shape, minval=-jnp.pi, maxval=jnp.pi)


def reach_speed(speed: jax.Array, goal: float, margin: float, value_at_margin: float) -> jax.Array:
  """1 from the speed `goal` m/s on, falling linearly to `value_at_margin` at `margin` m/s below it."""
  return tolerance(speed, (goal, math.inf), margin=margin, sigmoid="linear", value_at_margin=value_at_margin)


def small_control(action: jax.Array) -> jax.Array:
  """1 for no action, 0.8 where all are at (or beyond) full scale."""
  return (4 + tolerance(action, margin=1, sigmoid="quadratic", value_at_margin=0).mean()) / 5
