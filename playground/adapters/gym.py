"""Tasks as gymnasium environments: `import playground.adapters.gym`, then `gymnasium.make("playground/<Task>")`.

One environment runs on C MuJoCo, a batch (`gymnasium.make_vec`) on MJX; `physics=` chooses otherwise.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium
import jax
import mujoco
import numpy as np
from gymnasium.spaces import Box, Dict, Space
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from playground import registry
from playground.adapters.episodes import Arrays, Episodes, load_task
from playground.envs.base import PIXELS, Env, State
from playground.envs.wrappers import where_done, wrap_for_evaluation
from playground.mdp.lookup import lookup
from playground.rendering.video import choose_camera

NAMESPACE = "playground"
_HEIGHT, _WIDTH = 480, 640
_SEEDS = 2**31 - 1


class GymEnv(gymnasium.Env[Any, np.ndarray]):
  """One environment. Observations, rewards and ends of episodes are the task's, its metrics are the `info`."""

  metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012  # gymnasium's own declaration

  def __init__(
    self,
    task: str,
    overrides: Mapping[str, Any] | None = None,
    physics: str = "c",
    entry: str | None = None,
    render_mode: str | None = None,
  ):
    """Builds a task.

    Args:
      task: its name.
      overrides: values of its config by dotted key.
      physics: `c` or `mjx`, see `load_task`.
      entry: the one entry of a dict observation to give, such as `state`; None gives all.
      render_mode: `rgb_array` or None.

    Raises:
      UnknownNameError: no such task, key, physics or entry.
    """
    lookup({None: None, "rgb_array": None}, render_mode, "render_mode")  # pyright: ignore[reportArgumentType]
    self._episodes = Episodes(task, overrides, physics)
    env = self._episodes.env
    self._entry = entry
    self.observation_space = observation_space(env, entry)
    self.action_space = Box(-1.0, 1.0, (env.action_size,))
    self.render_mode = render_mode
    self.metadata = self.metadata | {"render_fps": round(1 / (env.dt * env.action_repeat))}
    self._renderer: mujoco.Renderer | None = None

  def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
    super().reset(seed=seed)
    moment = self._episodes.reset(int(self.np_random.integers(_SEEDS)))
    return _entry(moment.obs, self._entry), moment.metrics

  def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
    moment = self._episodes.step(action)
    return _entry(moment.obs, self._entry), moment.reward, moment.terminated, moment.truncated, moment.metrics

  def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
    """The present state as a picture, [height, width, 3] uint8, in the render mode `rgb_array`."""
    state, model = self._episodes.state, self._episodes.env.mj_model
    if self.render_mode is None or state is None:
      return None
    if self._renderer is None:
      model.vis.global_.offheight, model.vis.global_.offwidth = _HEIGHT, _WIDTH
      self._renderer = mujoco.Renderer(model, _HEIGHT, _WIDTH)
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


class GymVectorEnv(gymnasium.vector.VectorEnv[Any, np.ndarray, np.ndarray]):
  """A batch of environments in one program. An episode that has ended begins anew in the next step, freshly drawn."""

  metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": []}  # noqa: RUF012

  def __init__(
    self,
    num_envs: int,
    task: str,
    overrides: Mapping[str, Any] | None = None,
    physics: str = "mjx",
    entry: str | None = None,
  ):
    """Builds a task; see `GymEnv`."""
    env = load_task(task, overrides, physics)
    self.num_envs, self._entry = num_envs, entry
    self.single_observation_space = observation_space(env, entry)
    self.single_action_space = Box(-1.0, 1.0, (env.action_size,))
    self.observation_space = batch_space(self.single_observation_space, num_envs)
    self.action_space = batch_space(self.single_action_space, num_envs)
    batch = wrap_for_evaluation(env)

    def start(key: jax.Array) -> State:
      return batch.reset(jax.random.split(key, num_envs))

    def advance(state: State, action: jax.Array, key: jax.Array) -> State:
      after, ended = batch.step(state, action), state.done
      return jax.lax.cond(ended.any(), lambda: where_done(ended, start(key), after), lambda: after)

    self._start, self._advance = jax.jit(start), jax.jit(advance)
    self._state: State | None = None

  def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
    super().reset(seed=seed)
    state = self._state = self._start(self._key())
    return self._seen(state)

  def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
    assert self._state is not None, "reset before the first step"
    state = self._state = self._advance(self._state, np.asarray(actions, np.float32), self._key())
    obs, info = self._seen(state)
    done, truncated = np.array(state.done) > 0, np.array(state.info["truncation"]) > 0
    return obs, np.array(state.reward), done & ~truncated, truncated, info

  def _key(self) -> jax.Array:
    return jax.random.PRNGKey(int(self.np_random.integers(_SEEDS)))

  def _seen(self, state: State) -> tuple[Any, dict[str, Any]]:
    obs, metrics = jax.tree.map(np.array, (state.obs, state.metrics))
    return _entry(obs, self._entry), metrics


def observation_space(env: Env, entry: str | None = None) -> Space[Any]:
  """The space of a task's observation, or of one entry of it: unbounded numbers, pictures in bytes.

  Raises:
    UnknownNameError: no such entry.
  """
  sizes = env.observation_size
  if not isinstance(sizes, Mapping):
    return Box(-np.inf, np.inf, (sizes,))
  boxes: dict[str, Space[Any]] = {
    k: Box(0, 255, v, np.uint8) if k.startswith(PIXELS) else Box(-np.inf, np.inf, v) for k, v in sizes.items()
  }
  return Dict(boxes) if entry is None else lookup(boxes, entry, "entry")


def _entry(obs: Arrays, entry: str | None) -> Arrays:
  return obs[entry] if entry is not None and isinstance(obs, dict) else obs


def register() -> None:
  """Registers every task that is not yet, as `playground/<Task>`; importing this module has done it once."""
  for task in registry.names():
    if (name := f"{NAMESPACE}/{task}") not in gymnasium.registry:
      one, batch = f"{__name__}:GymEnv", f"{__name__}:GymVectorEnv"
      gymnasium.register(name, one, vector_entry_point=batch, kwargs={"task": task})


register()
