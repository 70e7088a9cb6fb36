"""Builds the ONNX operations of a trained actor: activations, and the CNN of a camera's images."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import onnx
from numpy.typing import ArrayLike
from onnx import TensorProto, helper, numpy_helper

from playground.learning.cnn import NORM_EPSILON, CNNConfig, pixel_places
from playground.pytree import PyTree


class Chain:
  """Appends nodes to a chain of operations; each takes the output of the previous one."""

  def __init__(self):
    self.value = ""
    self.nodes: list[onnx.NodeProto] = []
    self.weights: list[onnx.TensorProto] = []

  def constant(self, array: ArrayLike) -> str:
    """Stores an array as float32 and returns its name."""
    name = f"weight_{len(self.weights)}"
    self.weights.append(numpy_helper.from_array(np.asarray(array, np.float32), name))
    return name

  def apply(self, op: str, *others: str, **attributes: Any) -> None:
    """Applies an operation to the current value and others; its output becomes the current value."""
    output = f"value_{len(self.nodes)}"
    self.nodes.append(helper.make_node(op, [self.value, *others], [output], **attributes))
    self.value = output


def _swish(graph: Chain) -> None:
  x = graph.value
  graph.apply("Sigmoid")
  graph.apply("Mul", x)


def _gelu(graph: Chain) -> None:
  """Applies GELU as in Flax, with tanh: x / 2 * (1 + tanh(sqrt(2 / pi) * (x + 0.044715 x^3)))."""
  x = graph.value
  graph.apply("Pow", graph.constant(3.0))
  graph.apply("Mul", graph.constant(0.044715))
  graph.apply("Add", x)
  graph.apply("Mul", graph.constant(np.sqrt(2 / np.pi)))
  graph.apply("Tanh")
  graph.apply("Add", graph.constant(1.0))
  graph.apply("Mul", x)
  graph.apply("Mul", graph.constant(0.5))


ACTIVATIONS: dict[str, Callable[[Chain], None]] = {
  "swish": _swish,
  "relu": lambda graph: graph.apply("Relu"),
  "elu": lambda graph: graph.apply("Elu"),
  "tanh": lambda graph: graph.apply("Tanh"),
  "gelu": _gelu,
}


def _all_features(graph: Chain, _: list[int]) -> None:
  graph.apply("Transpose", perm=[0, 2, 3, 1])  # Flax has channels last
  graph.apply("Flatten")


def _pooled(op: str) -> Callable[[Chain, list[int]], None]:
  def pool(graph: Chain, _: list[int]) -> None:
    graph.apply(op)
    graph.apply("Flatten")

  return pool


def _expected_places(graph: Chain, size: list[int]) -> None:
  graph.apply("Flatten", axis=2)  # one row of pixels for each channel
  graph.apply("Softmax", axis=1)
  graph.apply("MatMul", graph.constant(pixel_places(*size)))
  graph.apply("Transpose", perm=[1, 0])
  graph.apply("Flatten", axis=0)


# From the last layer, [1, C, H, W] of size (H, W), to features [1, F].
_POOLS: dict[str, Callable[[Chain, list[int]], None]] = {
  "none": _all_features,
  "avg": _pooled("GlobalAveragePool"),
  "max": _pooled("GlobalMaxPool"),
  "spatial_softmax": _expected_places,
}


def _normalize_channels(graph: Chain) -> None:
  """Normalises each channel to mean 0 and std 1.

  The mean is that of the rows' means. ONNX Runtime's InstanceNormalization subtracts the mean last, and sums over a
  whole image lose digits: both errors are too large for a policy with steep actions.
  """
  x = graph.value
  _mean_of_image(graph)
  mean, graph.value = graph.value, x
  graph.apply("Sub", mean)
  x = graph.value
  graph.apply("Mul", x)
  _mean_of_image(graph)
  graph.apply("Add", graph.constant(NORM_EPSILON))
  graph.apply("Sqrt")
  std, graph.value = graph.value, x
  graph.apply("Div", std)


def _mean_of_image(graph: Chain) -> None:
  """Reduces an image [1, C, H, W] to the mean of each channel, [1, C, 1, 1]."""
  graph.apply("ReduceMean", axes=[3])
  graph.apply("ReduceMean", axes=[2])


def see(graph: Chain, params: Mapping[str, PyTree], cnn: CNNConfig, size: list[int]) -> None:
  """Applies a camera's CNN to an image [1, H, W, C] uint8 of size (H, W); the output is features [1, F]."""
  same = {"auto_pad": "SAME_UPPER"}  # pads both sides, an odd pixel below and on the right, as XLA does
  graph.apply("Cast", to=TensorProto.FLOAT)
  graph.apply("Transpose", perm=[0, 3, 1, 2])
  if cnn.normalize_channels:
    _normalize_channels(graph)
  else:
    graph.apply("Div", graph.constant(255.0))
    graph.apply("Sub", graph.constant(0.5))
  for i, stride in enumerate(cnn.strides):
    layer = params[f"conv_{i}"]
    kernel = np.transpose(layer["kernel"], (3, 2, 0, 1))  # from height, width, in, out
    graph.apply("Conv", graph.constant(kernel), graph.constant(layer["bias"]), strides=[stride, stride], **same)
    ACTIVATIONS[cnn.activation](graph)
    size = [-(-pixels // stride) for pixels in size]
    if cnn.max_pool:
      graph.apply("MaxPool", kernel_shape=[2, 2], strides=[2, 2], **same)
      size = [-(-pixels // 2) for pixels in size]
  _POOLS[cnn.global_pool](graph, size)
