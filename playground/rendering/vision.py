"""Adds camera images to the observation of any task."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from playground.envs.base import PIXELS, Env, State, observation_groups
from playground.envs.wrappers import Wrapper
from playground.errors import ConfigError, nearest
from playground.physics.backend import PhysicsData, mjx
from playground.pytree import PyTree
from playground.rendering.batch import BatchRenderer, View
from playground.rendering.video import camera_names
from playground.text import format_value

_CHANNELS = {"rgb": 3, "gray": 1, "depth": 1, "segmentation": 1}
_MAX_GEOMS = 255  # ids that fit in a byte, besides the value for no geom


class Vision(Wrapper):
  """Adds the observation group `pixels/<camera>`, uint8 [height, width, channels], to a task for one environment.

  The agent chooses the groups that it reads (`agent.network.policy_obs_key`). An image shows the state that its
  observation describes. With `frames` above 1, the last images of the episode are stacked, the newest last; the first
  observation repeats the first image. Brightness, a factor on all pixels, is drawn for every episode. An auto-reset
  restores the first observation with its brightness; the next step draws a new one.
  """

  jitted, observation_size, __copy__ = Env.jitted, Env.observation_size, Env.__copy__

  def __init__(self, env: Env):
    """Takes a task whose config has `vision`, see `VisionConfig` in `envs/options.py`.

    Raises:
      ConfigError: no camera, one that does not exist, or invalid settings.
    """
    super().__init__(env)
    config = env.config.vision
    cameras = camera_names(env.mj_model)
    if config.camera not in cameras:
      have = f"the task has {', '.join(cameras)}" if cameras else "the task has none"
      near = nearest(str(config.camera), cameras)
      raise ConfigError(f"env.vision.camera={format_value(config.camera)} is no camera of the model; {have}.{near}")
    brightness = tuple(config.brightness)
    if config.image == "segmentation" and env.mj_model.ngeom > _MAX_GEOMS:
      many = f"the model has {env.mj_model.ngeom} geoms, more than the {_MAX_GEOMS} that a byte tells apart"
      raise ConfigError(f"env.vision.image=segmentation: {many}.")
    if config.image == "segmentation" and brightness != (1, 1):
      raise ConfigError(f"env.vision.brightness={list(brightness)}: geoms have no brightness, leave it [1.0, 1.0].")
    self._image, self._camera, self._farthest = config.image, config.camera, config.farthest
    self._frames, self._brightness = config.frames, brightness
    size = {"width": config.width, "height": config.height}
    kind = "rgb" if self._image in ("rgb", "gray") else self._image
    visuals = {"shadows": config.shadows, "textures": config.textures}
    self._renderer = BatchRenderer(env.physics, View((config.camera,), kinds=(kind,), **size, **visuals))

  def __reduce__(self) -> tuple[type["Vision"], tuple[Env]]:
    """Pickles the task, see `Env.__reduce__`."""
    return Vision, (self.env,)

  @property
  def episode_info(self) -> tuple[str, ...]:
    return (*self.env.episode_info, "vision_first_step")

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    frame = {f"{self._image}[{age}]": _CHANNELS[self._image] for age in range(1 - self._frames, 1)}
    return self.env.observation_parts | {PIXELS + self._camera: frame}

  def reset(self, rng: jax.Array, model: mjx.Model | None = None) -> State:
    state = self.env.reset(rng, model)
    info = state.info
    if self._varies:
      key, draw = jax.random.split(jax.random.fold_in(rng, 1))  # does not change the draws of the task
      info = info | {"vision_rng": key, "brightness": self._draw(draw), "vision_first_step": jnp.ones((), bool)}
    frame, data = self._render(state.data, info, model)
    return self._with(state.replace(data=data, info=info), jnp.tile(frame, self._frames))

  def step(self, state: State, action: jax.Array, model: mjx.Model | None = None) -> State:
    if self._varies:
      key, draw = jax.random.split(state.info["vision_rng"])
      brightness = jnp.where(state.info["vision_first_step"], self._draw(draw), state.info["brightness"])
      info = {"vision_rng": key, "brightness": brightness, "vision_first_step": jnp.zeros((), bool)}
      state = state.replace(info=state.info | info)
    after = self.env.step(state, action, model)
    frame, data = self._render(after.data, after.info, model)
    frames = jnp.concatenate([state.obs[PIXELS + self._camera][..., frame.shape[-1] :], frame], axis=-1)
    return self._with(after.replace(data=data), frames)

  @property
  def _varies(self) -> bool:
    return self._brightness != (1, 1)

  def _draw(self, key: jax.Array) -> jax.Array:
    return jax.random.uniform(key, minval=self._brightness[0], maxval=self._brightness[1])

  def _render(
    self, data: PhysicsData, info: Mapping[str, PyTree], model: mjx.Model | None
  ) -> tuple[jax.Array, PhysicsData]:
    """Renders the current image, [height, width, channels] uint8; also returns the state to continue with."""
    shown: Any = self.env.model_of(info, model)
    images, data = self._renderer.render(shown, data)
    seen = images[self._camera]
    if self._image == "depth":
      frame = 255 * jnp.minimum(seen["depth"][..., None] / self._farthest, 1.0)
    elif self._image == "segmentation":
      frame = (seen["segmentation"][..., None] + 1).astype(jnp.uint8)
    elif self._image == "gray":
      frame = seen["rgb"].astype(jnp.float32).mean(axis=-1, keepdims=True)
    else:
      frame = seen["rgb"]
    if self._varies:
      frame = jnp.minimum(frame * info["brightness"], 255)
    return (frame if frame.dtype == jnp.uint8 else jnp.round(frame).astype(jnp.uint8)), data

  def _with(self, state: State, frames: jax.Array) -> State:
    """Returns the state with images in its observation."""
    return state.replace(obs={**observation_groups(state.obs), PIXELS + self._camera: frames})
