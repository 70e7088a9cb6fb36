"""Renders images of a batch of environments on their device, with MuJoCo-Warp's ray caster.

`BatchRenderer.render` is written for one environment and is jitted, mapped and scanned over like any other function.
MuJoCo-Warp's renderer needs a context for each batch size: `render` makes one when it is traced for a batch of a new
size, so that training, evaluation and a single image each have their own.
"""

import dataclasses
import operator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from playground.errors import ConfigError, UnknownNameError, nearest
from playground.physics.backend import Physics, PhysicsData, mjx
from playground.pytree import PyTree
from playground.rendering.video import camera_names

Images = dict[str, jax.Array]
Context = Any  # of MuJoCo-Warp, which has no public type for it
Rendered = tuple[dict[str, Images], jax.Array]  # images by camera, and a zero that depends on them
_KINDS = ("rgb", "depth", "segmentation")


@dataclasses.dataclass(frozen=True)
class View:
  """Settings of the images, the same for every environment.

  Attributes:
    cameras: names of the model's cameras.
    width: of each image, pixels.
    height: of each image, pixels.
    kinds: any of `rgb`, `depth` and `segmentation`.
    shadows: whether lights with `castshadow` cast shadows.
    textures: whether materials show textures or only colours.
  """

  cameras: tuple[str, ...]
  width: int = 64
  height: int = 64
  kinds: tuple[str, ...] = ("rgb",)
  shadows: bool = False
  textures: bool = False


class BatchRenderer:
  """Renders the environments of one task."""

  def __init__(self, physics: Physics, view: View):
    """Checks the view; buffers of a batch are made when `render` is traced.

    Args:
      physics: of the task, on Warp.
      view: settings of the images.

    Raises:
      ConfigError: a backend without rendering, or nothing to render.
      UnknownNameError: a camera or kind that does not exist.
    """
    if physics.impl != "warp":
      raise ConfigError(f"env.impl={physics.impl} cannot render images of a batch: set env.impl=warp.")
    names = camera_names(physics.mj_model)
    for camera in view.cameras:
      if camera not in names:
        have = ", ".join(names) or "none"
        raise UnknownNameError(f"Camera {camera!r} does not exist; the model has {have}.{nearest(camera, names)}")
    for kind in view.kinds:
      if kind not in _KINDS:
        raise UnknownNameError(f"Kind {kind!r} is unknown: choose from {', '.join(_KINDS)}.{nearest(kind, _KINDS)}")
    if not view.cameras or not view.kinds:
      raise ConfigError("Nothing to render: name a camera and a kind of image.")
    self.view = view
    self._physics = physics
    self._contexts: dict[tuple[object, ...], list[Context]] = {}

  def render(self, model: mjx.Model, data: PhysicsData) -> tuple[dict[str, Images], PhysicsData]:
    """Renders the current state of one environment.

    Args:
      model: the device model, randomised or not.
      data: simulator state.

    Returns:
      For each camera its images by kind: `rgb` [H, W, 3] uint8, `depth` [H, W] float32, metres along the optical
      axis and 0 for nothing, `segmentation` [H, W] int32, the geom's id and -1 for nothing; and the state to
      continue with. Two renderings write into the same buffers of the context: the next rendering must use that state,
      so that the compiler knows their order.
    """
    # Rays are computed once for all environments, unless the field of view is randomised.
    task = self._physics.model
    lenses = model.cam_fovy is not task.cam_fovy or model.cam_intrinsic is not task.cam_intrinsic
    shared = jax.tree.map(lambda _: False, model)
    batch = jax.tree.map(lambda x: x[None], data)
    images, token = jax.tree.map(lambda x: x[0], self._draw(lenses, shared, model, batch))
    return images, data.replace(time=data.time + token)

  def _draw(self, lenses: bool, own: mjx.Model, model: mjx.Model, data: PhysicsData) -> Rendered:
    """Returns the result of `_render` for a batch [N] of states; `own` marks the model fields with a batch axis."""

    @jax.custom_batching.custom_vmap
    def draw(model: mjx.Model, data: PhysicsData) -> Rendered:
      axes = jax.tree.map(lambda is_own: 0 if is_own else None, own)
      contexts = self._contexts_of(len(data.time), lenses)
      branches = [jax.vmap(partial(self._render, context), (axes, 0)) for context in contexts]
      return jax.lax.switch(_place(), branches, model, data) if len(branches) > 1 else branches[0](model, data)

    @draw.def_vmap
    def widen(count: int, mapped: PyTree, model: mjx.Model, data: PhysicsData) -> Rendered:
      # A map over a batch is a larger batch: fields shared by both stay shared.
      size = data.time.shape[-1]

      def merge(x: jax.Array, is_mapped: bool, is_own: bool) -> jax.Array:
        if not is_mapped and not is_own:
          return x
        each = x if is_mapped else x[None]
        each = each if is_own else each[:, None]
        return jnp.broadcast_to(each, (count, size, *each.shape[2:])).reshape(count * size, *each.shape[2:])

      fields = jax.tree.map(merge, model, mapped[0], own)
      states = jax.tree.map(lambda x, is_mapped: merge(x, is_mapped, True), data, mapped[1])
      wide = self._draw(lenses, jax.tree.map(operator.or_, mapped[0], own), fields, states)
      split = jax.tree.map(lambda x: x.reshape(count, size, *x.shape[1:]), wide)
      return split, jax.tree.map(lambda _: True, split)

    return draw(model, data)

  def _render(self, context: Context, model: mjx.Model, data: PhysicsData) -> Rendered:
    """Returns the images, and a zero that depends on them."""
    handle = context.pytree()
    full = mjx.refit_bvh(model, self._physics.present(model, data), handle)
    seg: Any = None
    if "segmentation" in self.view.kinds:
      rgb, depth, seg, full = mjx.render_with_segmentation(model, full, handle)
    else:
      rgb, depth, full = mjx.render(model, full, handle)
    unpack = {
      "rgb": lambda place: _bytes(rgb[place]),
      "depth": lambda place: depth[place],
      "segmentation": lambda place: seg[place, 0],
    }
    width, height = self.view.width, self.view.height
    images = {}
    for i, camera in enumerate(self.view.cameras):
      place = slice(i * width * height, (i + 1) * width * height)
      flat = {kind: unpack[kind](place) for kind in self.view.kinds}
      images[camera] = {kind: x.reshape(height, width, *x.shape[1:]) for kind, x in flat.items()}
    token: Any = full._impl._jax_token  # pyright: ignore[reportOptionalMemberAccess]
    return images, token.sum().astype(data.time.dtype)

  def _contexts_of(self, size: int, lenses: bool) -> list[Context]:
    """Returns the renderer's buffers for a batch, on every device of the function being traced.

    One context has the buffers of all GPUs. Warp has a single CPU device: where JAX divides the CPU into several
    devices, which render concurrently, each needs a context.
    """
    devices, view = _devices(), self.view
    key = (size, lenses, *devices)
    if key not in self._contexts:
      make = partial(
        mjx.create_render_context,
        self._physics.mj_model,
        size,
        cam_res=(view.width, view.height),
        cam_active=list(view.cameras),
        render_rgb="rgb" in view.kinds,
        render_depth="depth" in view.kinds,
        render_seg="segmentation" in view.kinds,
        use_shadows=view.shadows,
        use_textures=view.textures,
        use_precomputed_rays=not lenses,
      )
      apart = [[device] for device in devices] if "cpu" in devices else [devices]
      self._contexts[key] = [make(devices=together) for together in apart]
    return self._contexts[key]


def _bytes(packed: jax.Array) -> jax.Array:
  """Returns red, green and blue, [..., 3] uint8, of pixels 0xAARRGGBB."""
  return jnp.stack([(packed >> shift) & 0xFF for shift in (16, 8, 0)], axis=-1).astype(jnp.uint8)


def _devices() -> list[str]:
  """Returns Warp's names of this process's devices."""
  # Inside a function that is mapped over a mesh, its devices: the first ones (hardware.mesh.make_mesh).
  count = max(1, jax.sharding.get_abstract_mesh().size // jax.process_count())
  if jax.default_backend() != "gpu":
    return ["cpu"] * count
  return [f"cuda:{device.local_hardware_id}" for device in jax.local_devices()[:count]]


def _place() -> jax.Array:
  """Returns the index in `_devices()` of the function being traced, [] int32."""
  return jax.lax.axis_index(jax.sharding.get_abstract_mesh().axis_names) % len(_devices())
