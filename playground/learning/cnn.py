"""Convolutional networks for image observations."""

from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
from flax import linen
from jax.typing import DTypeLike

from playground.envs.base import PIXELS
from playground.errors import ConfigError
from playground.learning.hyperparameters import CNNConfig

Activation = Callable[[jax.Array], jax.Array]

ESTIMATOR = "estimator"  # a layer beside those of the actor
NORM_EPSILON = 1e-6 * 255**2  # added to the variance of an image's channel

_POOLS: dict[str, Activation] = {
  "none": lambda x: x.reshape(*x.shape[:-3], -1),
  "avg": lambda x: x.mean(axis=(-3, -2)),
  "max": lambda x: x.max(axis=(-3, -2)),
  "spatial_softmax": lambda x: _expected_places(x),
}


def check_cnn(config: CNNConfig) -> None:
  """Raises ConfigError for layers that do not fit each other."""
  lengths = {len(config.channels), len(config.kernels), len(config.strides)}
  if len(lengths) != 1 or not lengths.isdisjoint({0}):
    raise ConfigError("agent.network.cnn.channels, kernels and strides must have one entry for each layer.")


class CNN(linen.Module):
  """Features, [..., F], of images [..., height, width, channels] uint8."""

  config: CNNConfig
  activation: Activation
  dtype: DTypeLike = jnp.float32

  @linen.compact
  def __call__(self, pixels: jax.Array) -> jax.Array:
    config = self.config
    x = pixels.astype(self.dtype)
    if config.normalize_channels:  # of whole numbers, and not by the fast variance: images may have little contrast
      how = {"reduction_axes": (-3, -2), "feature_axes": -1, "epsilon": NORM_EPSILON, "use_fast_variance": False}
      x = linen.LayerNorm(use_scale=False, use_bias=False, **how)(x)
    else:
      x = x / 255 - 0.5
    init = linen.initializers.orthogonal(2**0.5)
    for i, (channels, size, stride) in enumerate(zip(config.channels, config.kernels, config.strides, strict=True)):
      conv = linen.Conv(channels, (size, size), stride, "SAME", kernel_init=init, dtype=self.dtype, name=f"conv_{i}")
      x = self.activation(conv(x))
      if config.max_pool:
        x = linen.max_pool(x, (2, 2), (2, 2), "SAME")
    return _POOLS[config.global_pool](x)


class PixelNetwork(linen.Module):
  """An MLP on the features of images, with a CNN for each camera, and optionally on a vector.

  Attributes:
    cnn: of each camera.
    cnn_activation: the CNNs'.
    hidden_layer_sizes: of the MLP.
    activation: the MLP's.
    output_size: length of the result.
    output_init: of the last layer.
    dtype: of intermediate activations; parameters and result are float32.
    estimate_size: length of the auxiliary estimate of the first hidden layer, 0 for none; it is sown among Flax's
      intermediates as `estimate`, [..., estimate_size].
  """

  cnn: CNNConfig
  cnn_activation: Activation
  hidden_layer_sizes: Sequence[int]
  activation: Activation
  output_size: int
  output_init: Callable[..., jax.Array] = jax.nn.initializers.lecun_uniform()
  dtype: DTypeLike = jnp.float32
  estimate_size: int = 0

  @linen.compact
  def __call__(self, images: Mapping[str, jax.Array], vector: jax.Array | None) -> jax.Array:
    """Returns the output, [..., output_size], for images [..., H, W, C] by camera and a vector [..., D]."""
    make = lambda key: CNN(self.cnn, self.cnn_activation, self.dtype, name=cnn_name(key))
    features = [make(key)(images[key]) for key in sorted(images)]
    hidden = jnp.concatenate([*features, *([] if vector is None else [vector.astype(self.dtype)])], axis=-1)
    init = jax.nn.initializers.lecun_uniform()
    for i, size in enumerate(self.hidden_layer_sizes):
      hidden = self.activation(linen.Dense(size, dtype=self.dtype, kernel_init=init, name=f"hidden_{i}")(hidden))
      if i == 0 and self.estimate_size:
        estimator = linen.Dense(self.estimate_size, kernel_init=init, name=ESTIMATOR)
        self.sow("intermediates", "estimate", estimator(hidden))
    return linen.Dense(self.output_size, dtype=jnp.float32, kernel_init=self.output_init, name="output")(hidden)


def cnn_name(entry: str) -> str:
  """Returns the name of a camera's CNN among a network's parameters."""
  return entry.replace("/", "_")


def pixel_places(height: int, width: int) -> jax.Array:
  """Returns the positions of an image's pixels, row by row: down and right in [-1, 1], [H * W, 2]."""
  places = jnp.meshgrid(jnp.linspace(-1, 1, height), jnp.linspace(-1, 1, width), indexing="ij")
  return jnp.stack(places, axis=-1).reshape(-1, 2)


def random_shift(obs: dict[str, jax.Array], shifts: jax.Array, pad: int) -> dict[str, jax.Array]:
  """Shifts images by whole pixels, repeating their edges (Yarats et al., 2021).

  Args:
    obs: observation groups; images are [..., B, H, W, C].
    shifts: [B, 2] in 0 .. 2 * pad, rows and columns; `pad` is no shift.
    pad: the largest shift.
  """

  def shift(image: jax.Array, start: jax.Array) -> jax.Array:
    padded = jnp.pad(image, ((pad, pad), (pad, pad), (0, 0)), mode="edge")
    return jax.lax.dynamic_slice(padded, (*start, 0), image.shape)

  def each(x: jax.Array) -> jax.Array:
    starts = jnp.broadcast_to(shifts, (*x.shape[:-3], 2)).reshape(-1, 2)
    return jax.vmap(shift)(x.reshape(-1, *x.shape[-3:]), starts).reshape(x.shape)

  return {key: each(x) if key.startswith(PIXELS) else x for key, x in obs.items()}


def _expected_places(x: jax.Array) -> jax.Array:
  """Returns where each channel is strongest, in [-1, 1]: [..., 2 C] of [..., H, W, C] (Levine et al., 2016)."""
  height, width, channels = x.shape[-3:]
  weights = jax.nn.softmax(x.reshape(*x.shape[:-3], height * width, channels), axis=-2)
  expected = jnp.einsum("...pc,pd->...dc", weights, pixel_places(height, width))
  return expected.reshape(*expected.shape[:-2], -1)
