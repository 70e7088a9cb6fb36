"""The base of all tasks: a pure `reset` and `step` of one environment, and the parts of a step."""

import abc
import copy
import functools
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Self, TypeVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from ml_collections import ConfigDict

from playground.envs.options import auto_impl, uses_vision
from playground.errors import ConfigError, PlaygroundError
from playground.mdp.traced import traced_settings
from playground.physics.backend import DERIVED_FIELDS, Physics, PhysicsData, mjx
from playground.physics.warp_kernels import quiet_warp
from playground.settings import Section, config_dict
from playground.text import first_line, line_of

Observation = jax.Array | dict[str, jax.Array]
PIXELS = "pixels/"  # prefix of image groups of an observation: [height, width, channels] uint8
T = TypeVar("T", bound=jax.Array | np.ndarray | int | tuple[int, ...])
EnvT = TypeVar("EnvT", bound="Env")


def observation_groups(obs: T | Mapping[str, T]) -> Mapping[str, T]:
  """Returns an observation, or its sizes, by group: one vector is the group "state"."""
  return obs if isinstance(obs, Mapping) else {"state": obs}


class State(struct.PyTreeNode):
  """The state of an environment between two control steps.

  Attributes:
    data: simulator state.
    obs: observation, one vector or a dict of vectors ("state" for the actor, "privileged_state" for the critic) and
      images (`pixels/<camera>`).
    reward: scalar reward of the step just taken.
    done: scalar 0/1 float, the episode ended in this step.
    metrics: scalars logged each step; the key set is the same at reset and step.
    info: the other entries of the state (random key, command, histories); the key set is fixed after reset.
  """

  data: PhysicsData
  obs: Observation
  reward: jax.Array
  done: jax.Array
  metrics: dict[str, jax.Array]
  info: dict[str, Any]


class Env(abc.ABC):
  """A task. Everything is for one environment; callers vmap (`playground.envs.wrappers`).

  A step is: `pre_step` (events that act on the physics, such as pushes), `action_to_ctrl`, the physics, `post_step`.
  `post_step` computes observation, reward, termination and the next `info` from the new physics. It runs no physics, so
  it can run on recorded data.
  """

  spec: mujoco.MjSpec | None = None  # the composed scene, if the task keeps it: videos may change its geoms
  # How an episode's values of a metric become one number for the log: `sum` (unless named here), `mean`, `max` or
  # `last`. A success in any step is a `max`, one that must hold at the end a `last`, an error in metres a `mean`.
  summaries: ClassVar[Mapping[str, str]] = {}
  # Fields of the physics that terms read, besides the simulator's state; the others are not stored.
  derived: tuple[str, ...] = DERIVED_FIELDS
  # Entries of `info` that belong to an episode: `AutoReset` sets them back to their values after reset. The others
  # (random key, command, gait, times of pushes) outlast an auto-reset.
  episode_info: ClassVar[tuple[str, ...]] = ()
  # Whether a class adds its `summaries` and `episode_info` to those of its base classes; else it replaces them.
  adds: ClassVar[bool] = True
  # Names of the managers, which are those of their sections: numbers there may be arguments of compiled programs.
  managers: ClassVar[tuple[str, ...]] = ()
  # A class that annotates keys of the config with their limits (`reach: Positive`), which `registry.build` checks.
  keys: ClassVar[type] = object
  # Whether `redraw(info, key, model)` draws entries of `info` where an auto-reset starts from a stored state.
  redraws: bool = False
  # Whether the config describes all of the task; if not, the task cannot be pickled.
  as_configured: bool = True

  def __init_subclass__(cls, **kwargs: Any):
    super().__init_subclass__(**kwargs)
    if cls.adds:
      above = [base for base in cls.__bases__ if issubclass(base, Env)]
      own = vars(cls)
      cls.summaries = {k: v for base in above[::-1] for k, v in base.summaries.items()} | own.get("summaries", {})
      info = [name for base in above for name in base.episode_info]
      cls.episode_info = tuple(dict.fromkeys((*info, *own.get("episode_info", ()))))

  def __init__(self, config: Any, mj_model: mujoco.MjModel):
    """Sets the time step and puts the model on the device.

    `config` is the task's ConfigDict: `ctrl_dt` and `sim_dt`, s, and `playground.envs.options.EnvConfig`.
    """
    self.config = config
    self.dt: float = config.ctrl_dt
    self.sim_dt: float = config.sim_dt
    self.n_substeps = round(self.dt / self.sim_dt)
    if self.n_substeps < 1 or abs(self.n_substeps * self.sim_dt - self.dt) > 1e-6 * self.dt:
      raise ConfigError(f"env.ctrl_dt={self.dt} must be a whole multiple of env.sim_dt={self.sim_dt}.")
    self.episode_length: int = config.episode_length
    self.action_repeat: int = config.action_repeat
    if self.action_repeat > self.episode_length:
      longer = f"env.action_repeat={self.action_repeat} is longer than an episode"
      raise ConfigError(f"{longer}: env.episode_length={self.episode_length}.")
    mj_model.opt.timestep = self.sim_dt
    self.mj_model = mj_model
    self.impl = choose_impl(config.impl, config.cuda_impl, uses_vision(config))
    buffers = {name: config[name] for name in ("naconmax_per_env", "naccdmax_per_env", "njmax")}
    self.physics = Physics(mj_model, impl=self.impl, derived=self.derived, **buffers)

  @abc.abstractmethod
  def reset(self, rng: jax.Array, model: mjx.Model | None = None) -> State:
    """Starts an episode from one random key, on `model` if given (a randomised one), else on the task's own."""

  @abc.abstractmethod
  def action_to_ctrl(self, state: State, action: jax.Array) -> jax.Array:
    """Returns the actuators' `ctrl` (shape [nu]) for an action (shape [action_size])."""

  @abc.abstractmethod
  def post_step(self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array) -> State:
    """Returns the state after a step, from the physics after it, the info before it and the action that was applied."""

  def pre_step(self, state: State) -> State:
    """Applies events to the physics before the step (pushes); by default none."""
    return state

  def step(self, state: State, action: jax.Array, model: mjx.Model | None = None) -> State:
    """Advances one control step of `dt` seconds."""
    state = self.pre_step(state)
    ctrl = self.checked_ctrl("action_to_ctrl", self.action_to_ctrl(state, action))
    data = self.physics.step(self.model_of(state.info, model), state.data, ctrl, self.n_substeps)
    return self.post_step(data, state.info, action)

  def checked_ctrl(self, method: str, ctrl: jax.Array) -> jax.Array:
    """Returns the `ctrl` that a method of the task returned; raises ConfigError if its shape is not [nu]."""
    if (shape := jnp.shape(ctrl)) != (self.mj_model.nu,):
      returned = f"{type(self).__name__}.{method} returns shape {list(shape)}"
      raise ConfigError(f"{returned}, and the model has {self.mj_model.nu} actuators.")
    return ctrl

  def model_of(self, info: Mapping[str, Any], model: mjx.Model | None) -> mjx.Model:
    """Returns the model that a step simulates: `model` if given (a randomised one), else the task's own."""
    return self.mjx_model if model is None else model

  @classmethod
  def settings_of(cls, config: Any) -> dict[str, np.ndarray]:
    """Returns the numbers of a config of this task that compiled programs take as arguments.

    By dotted key, float32 arrays of shape [] or [numbers]. Tasks whose configs differ in nothing else have the same
    programs. Raises ConfigError where one is invalid.
    """
    return traced_settings(config, cls.managers)

  def with_settings(self, values: Mapping[str, jax.Array]) -> Self:
    """Returns the same task with other values of settings (`settings_of`)."""
    if not values:
      return self
    other = copy.copy(self)
    other.as_configured = False
    vars(other).pop("jitted", None)  # has the values of this task
    for name in self.managers:
      setattr(other, name, getattr(self, name).with_settings(values))
    return other

  def __reduce__(self) -> tuple[Callable[..., "Env"], tuple[type["Env"], Section]]:
    """Pickles the class and the config, from which unpickling builds the task again.

    Raises:
      ConfigError: the task has another physics or other settings than its config.
    """
    if not self.as_configured:
      raise ConfigError("Only a task as its config describes it can be pickled: pickle it before it is changed.")
    return _build, (type(self), self.config.to_dict())  # a pickled ConfigDict would sort its keys

  def __copy__(self) -> Self:
    """Copies the attributes, without what `__reduce__` does."""
    other = object.__new__(type(self))
    vars(other).update(vars(self))
    return other

  def __deepcopy__(self, memo: dict[int, object]) -> Self:
    """Copies the task with its models and the order of its keys; the spec copies itself, for Python cannot."""
    other = copy.copy(self)
    memo[id(self)] = other
    if isinstance(self.config, ConfigDict):
      memo[id(self.config)] = config_dict(self.config)
    if self.spec is not None:
      memo[id(self.spec)] = self.spec.copy()
    vars(other).pop("jitted", None)  # is of this task
    vars(other).update(copy.deepcopy(vars(other), memo))
    return other

  @property
  def mjx_model(self) -> mjx.Model:
    """The model on the device, before any randomisation."""
    return self.physics.model

  @property
  def action_size(self) -> int:
    return self.mj_model.nu

  @property
  def observation_size(self) -> int | dict[str, tuple[int, ...]]:
    """Length of the observation vector, or the shape of each entry of a dict observation."""
    still = _without_dynamics(self)
    obs = jax.eval_shape(still.reset, jax.random.PRNGKey(0)).obs
    return {k: v.shape for k, v in obs.items()} if isinstance(obs, Mapping) else obs.shape[-1]

  def trace(self) -> State:
    """Returns shapes and types of an episode's first state, and runs the task's Python up to the second one.

    Raises:
      ConfigError: an observation, metric or entry of `info` of the second state has another shape or type; or an error
        of a term, or of the code of a task of another package.
    """
    still = _without_dynamics(self)
    try:
      first = jax.eval_shape(still.reset, jax.random.PRNGKey(0))
      second = jax.eval_shape(still.step, first, jax.ShapeDtypeStruct((self.action_size,), jnp.float32))
    except PlaygroundError:
      raise
    except Exception as error:
      if (module := type(self).__module__).startswith("playground."):
        raise
      why = f"{line_of(error, module)}{type(error).__name__}: {first_line(error)}"
      raise ConfigError(f"env.task={module}:{type(self).__name__}: {why}") from error
    old, new = (
      {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in jax.tree.leaves_with_path(parts)}
      for parts in ({"obs": state.obs, "metrics": state.metrics, "info": state.info} for state in (first, second))
    )
    describe = lambda leaf: f"{leaf.dtype}{list(leaf.shape)}" if leaf is not None else "missing"
    for name in {**old, **new}:
      if (was := describe(old.get(name))) != (then := describe(new.get(name))):
        where = f"{type(self).__name__}: {name} of the state is {was} at the start of an episode"
        raise ConfigError(f"{where}, and {then} after a step: make them the same.")
    return first

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    """The terms of each observation group, in order: name to length. A flat observation is the group "state".

    The term `state` of another group stands for the whole of the group `state`.
    """
    return {}

  @functools.cached_property
  def jitted(self) -> tuple[Callable[..., State], Callable[..., State]]:
    """`reset(key, fields, settings)` and `step(state, action, fields, settings)`.

    `fields` are randomised model fields and `settings` values for `with_settings`, each by name, {} for none. Jitted
    inside of maps and scans, so the task's Python is traced once for all batch sizes.
    """
    model: Callable[..., Any] = lambda fields: self.mjx_model.tree_replace(fields) if fields else None
    reset = lambda key, fields, settings: self.with_settings(settings).reset(key, model(fields))
    step = lambda state, action, fields, settings: self.with_settings(settings).step(state, action, model(fields))
    return jax.jit(reset), jax.jit(step)

  @property
  def unwrapped(self) -> "Env":
    return self


def _without_dynamics(env: EnvT) -> EnvT:
  """Returns the same task where nothing moves."""
  other = copy.copy(env)
  other.physics = env.physics.without_dynamics()
  return other


def _build(cls: Callable[[ConfigDict], Env], config: Section) -> Env:
  """Builds the task that a pickle describes."""
  return cls(config_dict(config))


def newest_image(env: Env, obs: Observation) -> jax.Array | None:
  """The newest frame of an observation's first camera, [..., H, W, 1 or 3] uint8; None without images."""
  cameras = sorted(key for key in obs if key.startswith(PIXELS)) if isinstance(obs, Mapping) else []
  if not cameras:
    return None
  images = obs[cameras[0]]
  frames = len(env.observation_parts.get(cameras[0], {})) or 1
  return images[..., -(images.shape[-1] // frames) :]


def choose_impl(impl: str, cuda_impl: str, renders: bool = False) -> str:
  """Resolves `impl: auto`; `renders` is whether the task uses vision, which only Warp renders. Raises ConfigError."""
  if impl == "auto":
    impl = auto_impl(cuda_impl, renders, jax.default_backend() == "gpu")
  if impl not in ("jax", "warp"):
    raise ConfigError(f"env.impl={impl!r} must be one of auto, jax, warp.")
  if renders and impl != "warp":
    raise ConfigError(f"env.impl={impl} renders no images, which env.vision.enable=true asks for: leave it auto.")
  if impl == "warp":
    instead = "leave env.vision.enable=false" if renders else "set env.impl=jax"
    try:
      warp = quiet_warp()
    except ImportError:
      remedy = f"pip install 'mujoco-mjx[warp]', or {instead}"
      raise ConfigError(f"env.impl=warp needs MuJoCo-Warp, which is not installed: {remedy}.") from None
    backend = jax.default_backend()
    if backend != "cpu" and not (backend == "gpu" and warp.is_cuda_available()):
      raise ConfigError(f"env.impl=warp runs on CPUs and NVIDIA GPUs and finds none beside JAX's {backend}: {instead}.")
  return impl
