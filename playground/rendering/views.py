"""Writes a contact sheet: images of a task's camera at the start of episodes, each on its own randomised model."""

import math
from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np

from playground.envs.base import PIXELS, Env, newest_image
from playground.envs.wrappers import Vectorize
from playground.errors import ConfigError
from playground.files import need_file, replacing
from playground.randomization import Randomizer
from playground.rendering.video import camera_names

_GAP = 2  # pixels between two views


def save_views(env: Env, events: Mapping[str, object], path: str | Path, count: int = 16, seed: int = 0) -> Path:
  """Writes `count` views as one image, and returns its path.

  Args:
    env: a task with images in its observation.
    events: `env.events`, see `Randomizer`.
    path: the .png to write.
    count: number of views, all rendered at once.
    seed: of episodes and models.

  Raises:
    ConfigError: the task has no images, no views, or the file is no writable .png.
  """
  import matplotlib.image

  path = Path(path).expanduser()
  need_file(path, ".png", f"--views={path}")
  if count < 1:
    raise ConfigError(f"--num-views={count} must be above 0.")
  sizes = env.observation_size
  if not isinstance(sizes, Mapping) or not any(key.startswith(PIXELS) for key in sizes):
    have = ", ".join(camera_names(env.mj_model)) or "none"
    raise ConfigError(f"The task has no images: add env.vision.enable=true env.vision.camera=<name>, of {have}.")
  reset_key, model_key = jax.random.split(jax.random.PRNGKey(seed))
  model = Randomizer(env.mj_model, events, impl=env.impl).sample_batch(jax.random.split(model_key, count))
  state = jax.jit(Vectorize(env).reset)(jax.random.split(reset_key, count), model)
  page = sheet(np.asarray(newest_image(env, state.obs)))
  path.parent.mkdir(parents=True, exist_ok=True)
  with replacing(path) as temporary:
    matplotlib.image.imsave(temporary, page)
  return path


def sheet(images: np.ndarray) -> np.ndarray:
  """Arranges images [N, H, W, 1 or 3] uint8 in rows of one image [..., 3]."""
  count, height, width, _ = images.shape
  columns = math.ceil(math.sqrt(count))
  rows = math.ceil(count / columns)
  page = np.full((rows, height + _GAP, columns, width + _GAP, 3), 255, np.uint8)
  for i, image in enumerate(images):
    page[i // columns, :height, i % columns, :width] = image
  return page.reshape(rows * (height + _GAP), columns * (width + _GAP), 3)
