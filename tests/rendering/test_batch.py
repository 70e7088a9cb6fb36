"""Images of a batch by MuJoCo-Warp, on the CPU: of a cart and its pole at several poses."""

import os
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.config import compose
from playground.envs.dm_control.cartpole import Cartpole
from playground.errors import ConfigError, UnknownNameError
from playground.physics.backend import mjx
from playground.rendering.batch import BatchRenderer, View

# Cart (m) and pole (rad): in the middle, to the right and leaning, to the left and leaning the other way.
POSES = jnp.array([[0.0, 0.0], [0.7, 0.4], [-0.7, -0.4]])
WIDTH, HEIGHT = 32, 24


@pytest.fixture(scope="module", autouse=True)
def compiled_fast() -> Iterator[None]:
  """Warp's compiler takes half as long for kernels that need not be fast."""
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr("warp.config.optimization_level", 0)
    yield


@cache
def task(impl: str = "warp") -> Cartpole:
  config = compose(["env=CartpoleBalance", "tuned=null", f"env.impl={impl}"])
  return Cartpole(config.env)


@cache
def renderer() -> BatchRenderer:
  return BatchRenderer(task().physics, View(("fixed", "lookatcart"), WIDTH, HEIGHT, ("rgb", "depth", "segmentation")))


def render(pose: jax.Array, fields: dict[str, jax.Array]) -> Any:
  env = task()
  return renderer().render(env.mjx_model.tree_replace(fields), env.physics.make(qpos=pose))  # pyright: ignore


@cache
def batched() -> Any:
  renderer()  # not while tracing
  return jax.jit(jax.vmap(render))


@cache
def images() -> Any:
  return jax.device_get(batched()(POSES, {})[0])


def columns_of(geom: str, which: int) -> np.ndarray:
  """The columns in which a geom is seen by the camera that does not move."""
  seen = images()["fixed"]["segmentation"][which] == task().mj_model.geom(geom).id
  return np.nonzero(seen.any(axis=0))[0]


def test_shapes_and_types() -> None:
  of = jax.tree.map(lambda x: (x.shape, x.dtype.name), images())
  size = (3, HEIGHT, WIDTH)
  assert set(of) == {"fixed", "lookatcart"}
  assert of["fixed"] == {"rgb": ((*size, 3), "uint8"), "depth": (size, "float32"), "segmentation": (size, "int32")}


def test_a_cart_is_seen_where_it_is() -> None:
  middle, right, left = (columns_of("cart", i).mean() for i in range(3))
  assert left < middle - 3 and right > middle + 3
  np.testing.assert_allclose(middle, (WIDTH - 1) / 2, atol=1)
  assert columns_of("pole_1", 1).mean() > right and columns_of("pole_1", 2).mean() < left  # it leans outwards
  seen = images()["fixed"]["rgb"]
  assert (seen[0] != seen[1]).any() and (seen[1] != seen[2]).any()


def test_depth_is_the_distance_along_the_optical_axis() -> None:
  fixed = jax.tree.map(lambda x: x[0], images()["fixed"])
  cart = task().mj_model.geom("cart")
  front = 4 - cart.size[1]  # the camera stands 4 m before the rails
  np.testing.assert_allclose(fixed["depth"][fixed["segmentation"] == cart.id], front, atol=0.02)
  assert (fixed["depth"][fixed["segmentation"] == -1] == 0).all()


def test_a_batch_is_what_its_environments_are_one_by_one_and_under_scan() -> None:
  def each(_: None, pose: jax.Array) -> tuple[None, Any]:
    return None, render(pose, {})[0]

  batch = images()
  one_by_one = jax.jit(lambda poses: jax.lax.scan(each, None, poses)[1])(POSES)
  jax.tree.map(np.testing.assert_array_equal, batch, jax.device_get(one_by_one))


def test_a_map_over_a_batch_is_a_larger_batch_with_what_each_map_is_over() -> None:
  wide = task().mjx_model.cam_fovy * jnp.array([1.0, 1.5])[:, None]
  over_lenses = jax.vmap(lambda pose, fovy: render(pose, {"cam_fovy": fovy})[0]["fixed"], (None, 0))
  seen = jax.device_get(jax.jit(jax.vmap(over_lenses, (0, None)))(POSES, wide))
  jax.tree.map(lambda x, y: np.testing.assert_array_equal(x[:, 0], y), seen, images()["fixed"])
  alone = jax.jit(lambda: render(POSES[1], {"cam_fovy": wide[1]})[0]["fixed"])()
  jax.tree.map(lambda x, y: np.testing.assert_array_equal(x[1, 1], y), seen, jax.device_get(alone))
  assert (seen["rgb"][1, 0] != seen["rgb"][1, 1]).any()


def test_each_environment_has_its_own_lens_light_and_colour() -> None:
  model = task().mjx_model
  pose = jnp.broadcast_to(POSES[0], (3, 2))
  wide = model.cam_fovy * jnp.array([1.0, 1.5, 1.0])[:, None]
  dark = model.light_diffuse * jnp.array([1.0, 1.0, 0.0])[:, None, None]
  seen = jax.device_get(batched()(pose, {"cam_fovy": wide, "light_diffuse": dark})[0])["fixed"]
  cart = task().mj_model.geom("cart").id
  areas = (seen["segmentation"] == cart).sum(axis=(1, 2))
  assert areas[1] < 0.7 * areas[0] and areas[2] == areas[0]
  assert seen["rgb"][2].mean() < seen["rgb"][0].mean()
  np.testing.assert_array_equal(seen["segmentation"][0], images()["fixed"]["segmentation"][0])


SHARES = """
import jax, numpy as np
from jax.sharding import PartitionSpec as P
from playground.hardware.mesh import AXIS, jit_on_mesh, make_mesh
from tests.rendering.test_batch import POSES, render, renderer

renderer()
see = jax.vmap(lambda pose: render(pose, {})[0])
poses = jax.numpy.concatenate([POSES, -2 * POSES[1:], POSES[:1] + 0.3])
on_two = jit_on_mesh(see, make_mesh(2), (P(AXIS),), P(AXIS))
for _ in range(10):  # which of them is first is a matter of luck
  apart = on_two(poses)
  jax.tree.map(np.testing.assert_array_equal, jax.device_get(apart), jax.device_get(jax.jit(see)(poses)))
print(sorted(len(x.sharding.device_set) for x in jax.tree.leaves(apart))[0], [key[0] for key in renderer()._contexts])
"""


@pytest.mark.slow
def test_each_device_renders_its_share() -> None:
  root = str(Path(__file__).parents[2])
  env = os.environ | {"JAX_NUM_CPU_DEVICES": "2", "JAX_PLATFORMS": "cpu", "PYTHONPATH": root}
  done = subprocess.run([sys.executable, "-c", SHARES], env=env, capture_output=True, text=True, cwd=root)
  assert done.returncode == 0, done.stderr[-2000:]
  assert done.stdout.splitlines()[-1] == "2 [1, 3, 1, 6]"  # two contexts of 3 on two devices, one of 6 on one


@pytest.mark.slow  # three renderers of their own
def test_shadows_and_textures_are_chosen() -> None:
  looks = [{}, {"shadows": True}, {"textures": True}]
  renderers = [BatchRenderer(task().physics, View(("fixed",), WIDTH, HEIGHT, **look)) for look in looks]
  data = task().physics.make(qpos=POSES[1])
  plain, shadows, textures = (
    np.asarray(jax.jit(lambda r=r: r.render(task().mjx_model, data)[0]["fixed"]["rgb"])(), int) for r in renderers
  )
  assert (shadows <= plain).all() and (shadows < plain).any() and (textures != plain).any()


def test_the_state_goes_on_unchanged() -> None:
  data = batched()(POSES, {})[1]
  np.testing.assert_array_equal(data.qpos, POSES)
  np.testing.assert_array_equal(data.time, 0)


def test_what_renders_next_waits_for_this(monkeypatch: pytest.MonkeyPatch) -> None:
  draw = mjx.render

  def marked(*args: Any) -> Any:
    rgb, depth, data = draw(*args)
    return rgb, depth, data.tree_replace({"_impl._jax_token": jnp.ones_like(data._impl._jax_token)})

  monkeypatch.setattr(mjx, "render", marked)
  small, env = BatchRenderer(task().physics, View(("fixed",), 4, 4)), task()
  assert jax.jit(lambda: small.render(env.mjx_model, env.physics.make())[1].time)() > 0, "nothing depends on the token"


@pytest.mark.parametrize(
  ("view", "message"),
  [
    (View(("fixd",)), "Camera 'fixd' does not exist; the model has fixed, lookatcart. Did you mean 'fixed'"),
    (View(("fixed",), kinds=("deph",)), "Kind 'deph' is unknown.*Did you mean 'depth'"),
  ],
)
def test_unknown_names(view: View, message: str) -> None:
  with pytest.raises(UnknownNameError, match=message):
    BatchRenderer(task().physics, view)


def test_jax_renders_nothing() -> None:
  with pytest.raises(ConfigError, match=r"env.impl=jax cannot render"):
    BatchRenderer(task("jax").physics, View(("fixed",)))
