"""A task made of terms: the base of all tasks on legs, with hands and with arms."""

import abc
import inspect
from collections.abc import Callable, Mapping, Sequence
from types import CodeType, FunctionType
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from playground.envs.base import Env, State
from playground.errors import ConfigError
from playground.mdp.context import Robot, StepContext
from playground.mdp.managers import (
  CommandManager,
  EventManager,
  ObservationManager,
  RewardManager,
  TerminationManager,
  checked,
)
from playground.mdp.terms import bind
from playground.physics.backend import DERIVED_FIELDS, PhysicsData, compile_spec, mjx
from playground.randomization import Randomizer
from playground.text import first_line, format_value

_LAGS = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))  # their `act` follows `ctrl`
_MODEL_FIELDS = "model_fields"  # entry of `info`: fields of the model that events of mode reset draw


class InitialState(struct.PyTreeNode):
  """The simulator's state that an episode starts with; reset events replace parts of it.

  Attributes:
    qpos: shape [nq].
    qvel: shape [nv].
    ctrl: shape [nu]; None is where a position servo holds the joints, see `Task.rest_ctrl`.
    mocap_pos: m, shape [nmocap, 3]; None is the model's.
    mocap_quat: shape [nmocap, 4]; None is the model's.
  """

  qpos: jax.Array
  qvel: jax.Array
  ctrl: jax.Array | None = None
  mocap_pos: jax.Array | None = None
  mocap_quat: jax.Array | None = None


class Task(Env):
  """A robot in a scene whose rewards, observations, terminations, commands and events are terms of its config.

  A subclass builds the scene, its robot (`make_robot`), and turns actions into `ctrl`. `first_info` and `next_info`
  return the entries of `info` of its own.

  Attributes:
    robot: the robot's constants.
    rewards, terminations, observations, commands, events: the managers of the config's terms.
  """

  context: ClassVar[type[StepContext]] = StepContext
  episode_info = ("last_act", "last_last_act", "observation_buffers")
  managers = ("rewards", "observations", "commands", "events")

  def __init__(self, config: Any, spec: mujoco.MjSpec):
    """Compiles the scene and binds the terms; raises ConfigError where a value is invalid or a name does not exist.

    `config` is that of `Env`, `observations` and `playground.envs.options.TermsConfig`.
    """
    self.spec = spec
    try:
      mj_model = compile_spec(spec)
    except ValueError as error:  # MuJoCo's: a mesh that is missing, a name that is there twice
      remedy = "; rename it in the robot's MJCF" * ("repeated name" in str(error))
      raise ConfigError(f"MuJoCo cannot compile the task's scene: {first_line(error)}{remedy}.") from None
    self.prepare_model(mj_model, config)
    self.rewards = RewardManager(config.rewards)
    self.terminations = TerminationManager(config.terminations)
    self.observations = ObservationManager(config)
    events = [term for term in bind("events", config.get("events")) if isinstance(term.func, type)]  # of intervals
    acting = [*bind("commands", config.get("commands")), *events]
    if any(not term.func.__module__.startswith("playground.") for term in (*self.terms(), *acting)):
      self.derived = DERIVED_FIELDS  # another package's term may read any of them
    else:
      read = set().union(*(_attributes_read(term.func) for term in self.terms()))
      self.derived = (*self.derived, *(name for name in DERIVED_FIELDS if name in read - {*self.derived}))
    super().__init__(config, mj_model)
    self.robot = self.make_robot(mj_model, config)
    self.commands = CommandManager(config.get("commands"), self)
    self.events = EventManager(config.get("events"), self)
    if isinstance(self.robot, Robot):
      for term in (*self.terms(), *self.events.groups["reset"]):
        self.robot.check_names(term.params, f"{term.key}.params")
    self._episode_models = Randomizer(mj_model, config.get("events"), "reset", self.impl)
    self.redraws = bool(self._episode_models.fields)
    self._reward_total: str = config.reward_total
    self._reward_clip = config.reward_clip and tuple(config.reward_clip)

  def terms(self) -> list[Any]:
    """All reward, termination and observation terms."""
    return [*self.rewards.terms, *self.terminations.terms, *self.observations.terms]

  def scales(self, scale: float | Sequence[float]) -> np.ndarray:
    """Returns `action_scale` for each action, or one for all; raises ConfigError for a list of another length."""
    if np.ndim(scale) and np.size(scale) != self.action_size:
      what = f"has {np.size(scale)} numbers, and this task {self.action_size} actions"
      raise ConfigError(f"env.action_scale={format_value(scale)} {what}.")
    return np.asarray(scale, np.float32)

  def prepare_model(self, mj_model: mujoco.MjModel, config: Any) -> None:
    """Changes the compiled model in place before it goes to the device."""

  @abc.abstractmethod
  def make_robot(self, mj_model: mujoco.MjModel, config: Any) -> Any:
    """Returns the robot's constants; terms read `c.robot`."""

  def initial_state(self, key: jax.Array, model: mjx.Model) -> InitialState:
    """Returns the state that reset events change: by default that of the robot's keyframe at rest."""
    return InitialState(self.robot.init_qpos, jnp.zeros(self.mj_model.nv))

  @abc.abstractmethod
  def rest_ctrl(self, initial: InitialState) -> jax.Array:
    """Returns the `ctrl` that an episode starts with where no reset event sets it."""

  def first_info(self, data: PhysicsData, key: jax.Array, model: mjx.Model) -> dict[str, Any]:
    """Returns the entries of `info` of the task itself at the start of an episode."""
    return {}

  def next_info(self, c: StepContext, key: jax.Array) -> dict[str, Any]:
    """Returns the entries of `info` that the task itself changes in a step."""
    return {}

  def measure(self, c: StepContext) -> dict[str, jax.Array]:
    """Returns metrics of how well the task is done, in units that people use."""
    return {}

  def start_physics(self, model: mjx.Model, initial: InitialState) -> PhysicsData:
    """Returns the physics of a start state, after a forward pass; actuators with a time constant have settled."""
    given = {name: value for name, value in vars(initial).items() if value is not None}
    start = {"ctrl": self.checked_ctrl("rest_ctrl", self.rest_ctrl(initial)), **given}
    lags = np.isin(self.mj_model.actuator_dyntype, _LAGS)
    if lags.any():
      start["act"] = jnp.zeros(self.mj_model.na).at[self.mj_model.actuator_actadr[lags]].set(start["ctrl"][lags])
    return self.physics.forward(model, self.physics.make(**start))

  def model_of(self, info: Mapping[str, Any], model: mjx.Model | None) -> mjx.Model:
    model = super().model_of(info, model)
    return model.tree_replace(info[_MODEL_FIELDS]) if self.redraws else model  # pyright: ignore[reportReturnType]

  def redraw(self, info: dict[str, Any], key: jax.Array, model: mjx.Model | None = None) -> dict[str, Any]:
    """Returns `info` with new draws of model fields, and with the entries that events compute from the model.

    `model` is that of the environment, which the draws change; None is the task's own.
    """
    if not self.redraws:
      return info
    fields = {_MODEL_FIELDS: self._episode_models.sample(key, super().model_of(info, model))}
    return info | fields | self.events.of_model(self.model_of(fields, model))

  def reset(self, rng: jax.Array, model: mjx.Model | None = None) -> State:
    rng, state_key, event_key, command_key, push_key, own_key, obs_key, model_key = jax.random.split(rng, 8)
    redrawn = self.redraw({}, model_key, model)
    model = self.model_of(redrawn, model)
    initial = self.events.start(event_key, self, self.initial_state(state_key, model))
    data = self.start_physics(model, initial)
    nothing = jnp.zeros(self.action_size)
    info: dict[str, Any] = {"rng": rng, "last_act": nothing, "last_last_act": nothing, **redrawn}
    info |= self.commands.reset(command_key) | self.events.reset(push_key, model) | self.terminations.start()
    info |= self.first_info(data, own_key, model)
    c = self.context(self, data, info | {"rng": obs_key}, nothing, dt=0.0)  # terms of the first step draw from `rng`
    obs, buffers = self.observations.compute(c, obs_key)
    info |= {"observation_buffers": buffers} if buffers else {}
    metrics = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(lambda: self._metrics(c, {})))
    metrics |= {f"reward/{term.name}": jnp.zeros(()) for term in self.rewards.terms}
    return State(data, obs, jnp.zeros(()), jnp.zeros(()), metrics, info)

  def pre_step(self, state: State) -> State:
    data, info = self.events.step(state.data, state.info)
    return state.replace(data=data, info=info)

  def post_step(self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array) -> State:
    rng, obs_key, command_key, own_key = jax.random.split(info["rng"], 4)
    c = self.context(self, data, info, action)
    rewards = self.rewards.compute(c)
    obs, buffers = self.observations.compute(c, obs_key, info.get("observation_buffers"))
    after = {**info, "rng": rng, "last_act": action, "last_last_act": info["last_act"]}
    own = checked(self.next_info(c, own_key), info, f"{type(self).__name__}.next_info", "first_info")
    after |= self.commands.step(c, command_key) | own
    after |= {"observation_buffers": buffers} if buffers else {}
    reward = self.clipped(self.total(rewards))
    done, ended = self.terminations.end(c)
    if self.events.groups["interval"]:  # whose forces, which add up, act in one step
      data = data.replace(xfrc_applied=jnp.zeros_like(data.xfrc_applied))
    return State(data, obs, reward, done, self._metrics(c, rewards), after | ended)

  def total(self, rewards: Mapping[str, jax.Array]) -> jax.Array:
    """Returns the reward of a step from its weighted terms, before `reward_clip`: dt * total.

    `reward_total: product` multiplies the sum of the terms of positive weight by exp(0.2 * the sum of the others).
    """
    add = lambda values: sum(values, jnp.zeros(()))
    if self._reward_total == "product":
      signed = lambda gain: add(rewards[t.name] for t in self.rewards.terms if (t.options.weight > 0) == gain)
      gains, costs = signed(True), signed(False)
      return gains * jnp.exp(0.2 * costs) * self.dt
    return add(rewards.values()) * self.dt

  def clipped(self, reward: jax.Array) -> jax.Array:
    """Returns a step's reward within `reward_clip`."""
    return jnp.clip(reward, *self._reward_clip) if self._reward_clip else reward

  def _metrics(self, c: StepContext, rewards: Mapping[str, jax.Array]) -> dict[str, jax.Array]:
    ended = {name: value.astype(jnp.float32) for name, value in self.terminations.compute(c).items()}
    metrics = {f"reward/{name}": value for name, value in rewards.items()}
    metrics |= {f"termination/{name}": value for name, value in ended.items()}
    failures = [ended[t.name] for t in self.terminations.terms if not (t.options.success or t.options.time_out)]
    measured = self.measure(c)
    for name, value in measured.items():
      if jnp.ndim(value):
        what = f"has shape {list(jnp.shape(value))}, and a metric is one number"
        raise ConfigError(f"{type(self).__name__}.measure: {name!r} {what}: add .sum() or .mean().")
    return metrics | {"fall": jnp.array(failures, jnp.float32).max(initial=0.0)} | measured

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    def first() -> StepContext:
      state = self.reset(jax.random.PRNGKey(0))
      return self.context(self, state.data, state.info, jnp.zeros(self.action_size))

    return self.observations.sizes(first)


def _attributes_read(func: Callable[..., Any]) -> set[str]:
  """Returns the names of attributes that a function reads, and the functions that it wraps or encloses."""
  func = inspect.unwrap(func)
  if not isinstance(func, FunctionType):
    return set()
  codes, names = [func.__code__], set[str]()
  for code in codes:
    names.update(code.co_names)
    codes += [part for part in code.co_consts if isinstance(part, CodeType)]
  enclosed = [cell.cell_contents for cell in func.__closure__ or ()]
  return names.union(*(_attributes_read(value) for value in enclosed if isinstance(value, FunctionType)))
