"""Tasks as gymnasium environments: `import playground.adapters.gym`, then `gymnasium.make("playground/<Task>")`.

One environment runs on C MuJoCo, a batch (`gymnasium.make_vec`) on MJX; `physics=` chooses otherwise.
"""

import atexit
import importlib
import os
import weakref
from collections.abc import Mapping
from typing import Any

import jax
import mujoco
import numpy as np

from playground import registry
from playground.adapters.episodes import Arrays, Episodes, load_task, need_shape
from playground.envs.base import PIXELS, Env, State
from playground.envs.wrappers import PRESERVE_INFO, where_done, wrap_for_evaluation
from playground.errors import ConfigError, PlaygroundError, lookup
from playground.extras import install_command
from playground.mdp.managers import ACTOR
from playground.pytree import PyTree
from playground.rendering.gl import NO_GL_REMEDY, find_gl
from playground.rendering.video import choose_camera
from playground.settings import Section

try:
  import gymnasium
  from gymnasium.spaces import Box, Dict, Space
  from gymnasium.vector import AutoresetMode
  from gymnasium.vector.utils import batch_space
except ImportError:
  raise ConfigError(f"playground.adapters.gym needs gymnasium: {install_command('gym')}.") from None

Info = dict[str, Any]  # gymnasium's type

NAMESPACE = "playground"
_HEIGHT, _WIDTH = 480, 640
_SEEDS = 2**31 - 1


class GymEnv(gymnasium.Env[PyTree, np.ndarray]):
  """One environment. Observations, rewards and ends of episodes are the task's, its metrics are the `info`."""

  metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012  # gymnasium's own declaration

  def __init__(
    self,
    task: str,
    overrides: Section | None = None,
    physics: str = "c",
    entry: str | None = None,
    render_mode: str | None = None,
  ):
    """Builds a task.

    Args:
      task: its name.
      overrides: values of its config by dotted key.
      physics: `c` or `mjx`, see `load_task`.
      entry: the observation group to return, such as `state`; None returns all.
      render_mode: `rgb_array` or None.

    Raises:
      UnknownNameError: no such task, key, physics, entry or render mode.
      ConfigError: as `load_task`.
    """
    if render_mode is not None:
      lookup({"rgb_array": None}, render_mode, "render_mode")
    self._episodes = Episodes(task, overrides, physics)
    env = self._episodes.env
    self._entry = entry
    self.observation_space = observation_space(env, entry)
    self.action_space = Box(-1.0, 1.0, (env.action_size,))
    self.render_mode = render_mode
    self.metadata = self.metadata | {"render_fps": round(1 / (env.dt * env.action_repeat))}
    self._renderer: mujoco.Renderer | None = None

  def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[PyTree, Info]:
    super().reset(seed=seed)
    moment = self._episodes.reset(int(self.np_random.integers(_SEEDS)))
    return _entry(moment.obs, self._entry), moment.metrics

  def step(self, action: np.ndarray) -> tuple[PyTree, float, bool, bool, Info]:
    moment = self._episodes.step(action)
    return _entry(moment.obs, self._entry), moment.reward, moment.terminated, moment.truncated, moment.metrics

  def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
    """Renders the current state, an image [height, width, 3] uint8, in the render mode `rgb_array`.

    Raises:
      PlaygroundError: no OpenGL works on this machine.
    """
    state, model = self._episodes.state, self._episodes.env.mj_model
    if self.render_mode is None or state is None:
      return None
    if self._renderer is None:
      model.vis.global_.offheight, model.vis.global_.offwidth = _HEIGHT, _WIDTH
      self._renderer = _open_renderer(model)
      atexit.register(_close, weakref.ref(self))  # before modules are torn down, after which OpenGL fails
    data = mujoco.MjData(model)
    for name in ("qpos", "mocap_pos", "mocap_quat"):
      getattr(data, name)[:] = getattr(state.data, name)[0]
    mujoco.mj_forward(model, data)
    self._renderer.update_scene(data, choose_camera(model))
    return self._renderer.render()

  def close(self) -> None:
    if self._renderer is not None:
      self._renderer.close()
      self._renderer = None


def _close(env: "weakref.ref[GymEnv]") -> None:
  if (open_env := env()) is not None:
    open_env.close()


def _open_renderer(model: mujoco.MjModel) -> mujoco.Renderer:
  """Returns a renderer with the OpenGL backend that works here, as for videos of runs.

  MuJoCo chooses at import: GLFW, which needs a screen, unless MUJOCO_GL is set.
  """
  from mujoco.rendering.classic import gl_context

  backend = find_gl()
  if backend is None:
    raise PlaygroundError(f"render() draws nothing. {NO_GL_REMEDY}")
  os.environ.pop("PYOPENGL_PLATFORM", None)  # the backend sets its own value and refuses another
  library = backend if backend in ("egl", "osmesa", "cgl") else "glfw"
  chosen = gl_context.GLContext
  gl_context.GLContext = importlib.import_module(f"mujoco.{library}").GLContext
  try:
    return mujoco.Renderer(model, _HEIGHT, _WIDTH)
  finally:
    gl_context.GLContext = chosen


class GymVectorEnv(gymnasium.vector.VectorEnv[PyTree, np.ndarray, np.ndarray]):
  """A batch of environments in one program. An environment whose episode has ended resets itself.

  It resets in the next step, which ignores its action, or (`AutoresetMode.SAME_STEP`) in the step that ends it: `info`
  then has the episode's last observation and metrics under `final_obs` and `final_info`, as gymnasium's own have them.
  The level of a task's curriculum outlasts these resets, as in training; `reset` starts from the first one.
  """

  metadata = {"render_modes": []}  # noqa: RUF012

  def __init__(
    self,
    num_envs: int,
    task: str,
    overrides: Section | None = None,
    physics: str = "mjx",
    entry: str | None = None,
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    render_mode: None = None,
    max_episode_steps: None = None,
  ):
    """Builds a task; see `GymEnv` for arguments and errors.

    Raises:
      UnknownNameError: another autoreset mode than `NextStep` and `SameStep`.
      ConfigError: no environment, a render mode, or `max_episode_steps`.
    """
    if not isinstance(num_envs, int | np.integer) or num_envs < 1:
      raise ConfigError(f"num_envs={num_envs!r} must be a whole number, at least 1.")
    if max_episode_steps is not None:
      remedy = f"overrides={{'episode_length': {max_episode_steps}}} counts control steps"
      raise ConfigError(f"max_episode_steps={max_episode_steps}: a batch has the task's own limit; {remedy}.")
    if render_mode is not None:
      raise ConfigError(f"render_mode={render_mode!r}: a batch renders nothing, one environment (gymnasium.make) does.")
    modes = {mode.value: mode for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)}
    mode = lookup(modes, str(getattr(autoreset_mode, "value", autoreset_mode)), "autoreset_mode")
    self.metadata = self.metadata | {"autoreset_mode": mode}
    same_step = mode == AutoresetMode.SAME_STEP
    env = load_task(task, overrides, physics)
    self.num_envs, self._entry = num_envs, entry
    self.single_observation_space = observation_space(env, entry)
    self.single_action_space = Box(-1.0, 1.0, (env.action_size,))
    self.observation_space = batch_space(self.single_observation_space, num_envs)
    self.action_space = batch_space(self.single_action_space, num_envs)
    batch = wrap_for_evaluation(env)

    def start(key: jax.Array) -> State:
      return batch.reset(jax.random.split(key, num_envs))

    def advance(state: State, action: jax.Array, key: jax.Array) -> tuple[State, State]:
      """Returns the state after the auto-reset, and the outputs of the step itself."""
      after = batch.step(state, action)
      ended = after.done if same_step else state.done
      begun = jax.lax.cond(ended.any(), lambda: where_done(ended, start(key), after), lambda: after)
      if PRESERVE_INFO in after.info:  # not from a step that the environment ignores
        kept = after.info[PRESERVE_INFO]
        kept = kept if same_step else where_done(state.done, state.info[PRESERVE_INFO], kept)
        begun = begun.replace(info=begun.info | {PRESERVE_INFO: kept})
      return begun, (after if same_step else begun).replace(data=None)

    self._start, self._advance, self._where = jax.jit(start), jax.jit(advance), jax.jit(where_done)
    self._state: State | None = None

  def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[PyTree, Info]:
    """Starts the next episodes, of the environments in `options["reset_mask"]` (bool, [num_envs]) if that is there."""
    super().reset(seed=seed)
    state, mask = self._start(self._key()), (options or {}).get("reset_mask")
    if mask is not None and self._state is not None:
      mask = need_shape("reset_mask", np.asarray(mask, bool), (self.num_envs,))
      state = self._where(mask, state, self._state)
    self._state = state
    return self._seen(state)

  def step(self, actions: np.ndarray) -> tuple[PyTree, np.ndarray, np.ndarray, np.ndarray, Info]:
    assert self._state is not None, "reset before the first step"
    actions = need_shape("actions", np.asarray(actions, np.float32), self.action_space.shape or ())
    state, last = self._advance(self._state, actions, self._key())
    self._state, (obs, info) = state, self._seen(state)
    done, truncated = np.array(last.done) > 0, np.array(last.info["truncation"]) > 0
    if self.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP and done.any():
      info |= self._final(last, done)
    return obs, np.array(last.reward), done & ~truncated, truncated, info

  def _final(self, last: State, done: np.ndarray) -> Info:
    """Returns the entries of ended episodes: objects in `final_obs`, and a mask of them under `_<name>`."""
    obs, metrics = self._seen(last)
    final_obs = np.full(self.num_envs, None, object)
    for i in np.flatnonzero(done):
      final_obs[i] = jax.tree.map(lambda x, i=i: x[i], obs)
    final_info = {name: np.where(done, values, 0) for name, values in metrics.items()}
    final_info |= {f"_{name}": done.copy() for name in metrics}
    return {"final_obs": final_obs, "_final_obs": done.copy(), "final_info": final_info, "_final_info": done.copy()}

  def _key(self) -> jax.Array:
    return jax.random.PRNGKey(int(self.np_random.integers(_SEEDS)))

  def _seen(self, state: State) -> tuple[PyTree, Info]:
    obs, metrics = jax.tree.map(np.array, (state.obs, state.metrics))
    return _entry(obs, self._entry), metrics


def observation_space(env: Env, entry: str | None = None) -> Space[PyTree]:
  """Returns the space of a task's observation, or of one group of it: unbounded numbers, images in bytes.

  The only group of a flat observation is `state`.

  Raises:
    UnknownNameError: no such entry.
  """
  sizes = env.observation_size
  flat = not isinstance(sizes, Mapping)
  boxes: dict[str, Space[PyTree]] = {
    k: Box(0, 255, v, np.uint8) if k.startswith(PIXELS) else Box(-np.inf, np.inf, v)
    for k, v in ({ACTOR: (sizes,)} if flat else sizes).items()
  }
  if entry is not None:
    return lookup(boxes, entry, "entry")
  return boxes[ACTOR] if flat else Dict(boxes)


def _entry(obs: Arrays, entry: str | None) -> Arrays:
  return obs[entry] if entry is not None and isinstance(obs, dict) else obs


def register() -> None:
  """Registers tasks that are not registered yet as `playground/<Task>`; importing this module calls it."""
  for task in registry.names():
    if (name := f"{NAMESPACE}/{task}") not in gymnasium.registry:
      one, batch = f"{__name__}:GymEnv", f"{__name__}:GymVectorEnv"
      gymnasium.register(name, one, vector_entry_point=batch, kwargs={"task": task})


register()
