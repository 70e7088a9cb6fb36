"""What a camera's images become on their way into the observation, with a renderer that shows the position."""

from functools import partial
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ml_collections import ConfigDict

from playground import registry
from playground.config import compose
from playground.envs.base import choose_impl
from playground.envs.wrappers import wrap_for_evaluation, wrap_for_training
from playground.errors import ConfigError
from playground.rendering import vision
from tests.dummy import Point

LENGTH = 4
PIXELS = "pixels/eye"


class Shown:
  """Stands in for the renderer: the mean of colours is 100 times the environment's age (s); they differ."""

  def __init__(self, physics: Any, view: Any):
    self.view = view

  def render(self, model: Any, data: Any) -> tuple[Any, Any]:
    size = (self.view.height, self.view.width)
    red, green, blue = (jnp.full(size, jnp.round(part * 100 * data.time)) for part in (0.4, 0.6, 2.0))
    rgb = jnp.stack([red, green, blue], axis=-1).astype(jnp.uint8)
    geom = jnp.round(10 * data.time).astype(jnp.int32) - 1  # at first there is none
    return {"eye": {"rgb": rgb, "depth": jnp.full(size, data.time), "segmentation": jnp.full(size, geom)}}, data


class Aging(Point):
  """A point that knows the time: a step is 0.1 s."""

  def reset(self, rng: jax.Array, model: Any = None) -> Any:
    state = super().reset(rng)
    return state.replace(data=state.data.replace(time=jnp.zeros(())))

  def step(self, state: Any, action: jax.Array, model: Any = None) -> Any:
    after = super().step(state, action)
    return after.replace(data=after.data.replace(time=state.data.time + 0.1))


@pytest.fixture
def seeing(monkeypatch: pytest.MonkeyPatch) -> Any:
  monkeypatch.setattr(vision, "BatchRenderer", Shown)
  monkeypatch.setattr(vision, "camera_names", lambda model: ["eye", "side"])

  def make(**settings: Any) -> vision.Vision:
    env: Any = Aging(episode_length=LENGTH)
    env.mj_model = SimpleNamespace(ngeom=settings.pop("ngeom", 4))
    config = compose(["env=CartpoleBalance", "tuned=null"]).resolved["env"]["vision"]
    env.config = ConfigDict({"vision": config | {"camera": "eye", "width": 2, "height": 3} | settings})
    return vision.Vision(env)

  return make


def roll(env: Any, steps: int, wrap: Any = wrap_for_training, count: int = 2) -> list[Any]:
  """States from reset on, of several environments."""
  wrapped = wrap(env)
  states = [jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), count))]
  step = jax.jit(wrapped.step)
  for _ in range(steps):
    states.append(step(states[-1], jnp.zeros((count, 2))))
  return states


def values(state: Any) -> list[int]:
  """The channels of the first environment's first pixel."""
  return np.asarray(state.obs[PIXELS])[0, 0, 0].tolist()


def test_images_stand_beside_the_tasks_own_observation(seeing: Any) -> None:
  env = seeing(image="rgb", frames=2)
  assert env.observation_size == {"state": (2,), "privileged_state": (4,), PIXELS: (3, 2, 6)}
  assert env.observation_parts == {PIXELS: {"rgb[-1]": 3, "rgb[0]": 3}}
  states = roll(env, 1)
  assert states[0].obs[PIXELS].dtype == jnp.uint8
  assert values(states[1])[-3:] == [4, 6, 20]


def test_frames_are_of_this_episode_newest_last(seeing: Any) -> None:
  seen = [values(state) for state in roll(seeing(image="gray", frames=3), LENGTH + 2)]
  first = [[0, 0, 0], [0, 0, 10], [0, 10, 20], [10, 20, 30]]
  assert seen == [*first, *first[:3]]  # the step that ends an episode shows the next one's first image


def test_brightness_is_drawn_for_every_episode_and_kept_in_it(seeing: Any) -> None:
  states = roll(seeing(image="gray", brightness=[0.5, 0.9]), 2 * LENGTH)
  drawn = np.array([state.info["brightness"] for state in states])
  assert ((drawn >= 0.5) & (drawn <= 0.9)).all() and (drawn[:, 0] != drawn[:, 1]).all()
  first, second = drawn[1 : LENGTH + 1], drawn[LENGTH + 1 :]
  assert (first == first[0]).all() and (second == second[0]).all() and (first[0] != second[0]).all()
  np.testing.assert_array_equal(values(states[3]), np.round(30 * first[0, 0]))


def test_depth_is_white_from_the_farthest_on(seeing: Any) -> None:
  seen = [values(state)[0] for state in roll(seeing(image="depth", farthest=0.2), 3, wrap_for_evaluation)]
  assert seen == [0, 128, 255, 255]


def test_geoms_are_counted_from_1(seeing: Any) -> None:
  seen = [values(state)[0] for state in roll(seeing(image="segmentation"), 3, wrap_for_evaluation)]
  assert seen == [0, 1, 2, 3]


@pytest.mark.parametrize(
  ("settings", "message"),
  [
    ({"image": "segmentation", "ngeom": 256}, "the model has 256 geoms, more than the 255 that a byte tells apart"),
    ({"image": "segmentation", "brightness": [0.5, 1.0]}, r"brightness=\[0.5, 1.0\]: geoms have no brightness"),
    ({"camera": "eyes"}, r"env.vision.camera=eyes is no camera .* the task has eye, side.*Did you mean 'eye'"),
    ({"camera": None}, r"env.vision.camera=null is no camera of the model; the task has eye, side"),
  ],
)
def test_settings_that_cannot_be(seeing: Any, settings: dict[str, Any], message: str) -> None:
  with pytest.raises(ConfigError, match=message):
    seeing(**settings)


def test_only_warp_renders() -> None:
  assert choose_impl("auto", "jax", renders=True) == "warp"
  load = partial(registry.load, "CartpoleBalance")
  with pytest.raises(ConfigError, match=r"env.impl=jax renders no images.*leave it auto"):
    load(overrides={"vision.enable": True, "vision.camera": "fixed", "impl": "jax"})


def test_a_machine_without_warp_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setitem(__import__("sys").modules, "warp", None)
  with pytest.raises(ConfigError, match=r"needs MuJoCo-Warp, which is not installed: .* env.vision.enable=false"):
    choose_impl("auto", "jax", renders=True)


def test_a_machine_that_warp_does_not_run_on_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
  for backend in ("tpu", "gpu"):  # a GPU that JAX sees and CUDA does not: another maker's, or a driver too old
    monkeypatch.setattr(jax, "default_backend", lambda backend=backend: backend)
    with pytest.raises(ConfigError, match=rf"finds none beside JAX's {backend}: leave env.vision.enable=false"):
      choose_impl("auto", "jax", renders=True)


def test_the_settings_are_there_for_every_task() -> None:
  given = ["env.vision.enable=true", "env.vision.camera=track", "env.vision.frames=2"]
  assert compose(["env=Go1JoystickFlatTerrain", *given]).env.vision.frames == 2
  with pytest.raises(ConfigError, match=r"env.vision.image=grey is unknown.*Did you mean 'gray'"):
    compose(["env=Go1JoystickFlatTerrain", "env.vision.image=grey"])
  with pytest.raises(ConfigError, match=r"env.vision.frames=0 must be a whole number from 1"):
    compose(["env=Go1JoystickFlatTerrain", "env.vision.frames=0"])
  for blind in ("env=Go1JoystickFlatTerrain", "env=CartpoleBalanceVision env.vision.enable=false"):
    compose(blind.split())
    with pytest.raises(ConfigError, match=r"env.vision.camera: this task has no images. Add env.vision.enable=true"):
      compose([*blind.split(), "env.vision.camera=track"])
