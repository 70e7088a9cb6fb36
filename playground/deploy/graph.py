"""A trained actor as an ONNX graph: normalise, the layers, the first half of the output, tanh (or all, clipped)."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from playground.errors import ConfigError

INPUT, OUTPUT = "obs", "continuous_actions"
# Old enough for the runtimes on robots' computers; the first that has LayerNormalization.
OPSET, IR_VERSION = 17, 8

_LAYER_NORM_EPSILON = 1e-6  # Flax's default


class _Chain:
  """Appends nodes to a chain of operations, each of which takes the value of the one before."""

  def __init__(self, value: str):
    self.value = value
    self.nodes: list[onnx.NodeProto] = []
    self.weights: list[onnx.TensorProto] = []

  def constant(self, array: Any) -> str:
    """Stores an array as float32 and returns its name."""
    name = f"weight_{len(self.weights)}"
    self.weights.append(numpy_helper.from_array(np.asarray(array, np.float32), name))
    return name

  def apply(self, op: str, *others: str, **attributes: Any) -> None:
    """Applies an operation to the present value and others; what comes out is the present value."""
    output = f"value_{len(self.nodes)}"
    self.nodes.append(helper.make_node(op, [self.value, *others], [output], **attributes))
    self.value = output


def _swish(graph: _Chain) -> None:
  x = graph.value
  graph.apply("Sigmoid")
  graph.apply("Mul", x)


def _gelu(graph: _Chain) -> None:
  """As Flax computes it, with tanh: x / 2 * (1 + tanh(sqrt(2 / pi) * (x + 0.044715 x^3)))."""
  x = graph.value
  graph.apply("Pow", graph.constant(3.0))
  graph.apply("Mul", graph.constant(0.044715))
  graph.apply("Add", x)
  graph.apply("Mul", graph.constant(np.sqrt(2 / np.pi)))
  graph.apply("Tanh")
  graph.apply("Add", graph.constant(1.0))
  graph.apply("Mul", x)
  graph.apply("Mul", graph.constant(0.5))


_ACTIVATIONS: dict[str, Callable[[_Chain], Any]] = {
  "swish": _swish,
  "relu": lambda graph: graph.apply("Relu"),
  "elu": lambda graph: graph.apply("Elu"),
  "tanh": lambda graph: graph.apply("Tanh"),
  "gelu": _gelu,
}


def policy_graph(
  params: Mapping[str, Any],
  activation: str,
  normalization: tuple[np.ndarray, np.ndarray] | None,
  squashed: bool = True,
) -> onnx.ModelProto:
  """Builds the graph of a deterministic policy.

  Args:
    params: of the actor's MLP, as Flax has them: `hidden_<i>` with `kernel` [in, out] and `bias` [out], and where its
      layers are normalised `LayerNorm_<i>` with `scale` and `bias`.
    activation: of the hidden layers, as in `agent.network.activation`.
    normalization: mean and deviation of the observation, [n] each; None if the actor sees it as it is.
    squashed: whether the output is mean and deviation of actions before tanh; else it is their mean, to be clipped.

  Returns:
    The model: `obs` float32 [1, n] -> `continuous_actions` float32 [1, action_size] in [-1, 1].

  Raises:
    ConfigError: the actor is no MLP.
  """
  norms = sum(name.startswith("LayerNorm_") for name in params)
  count = len(params) - norms
  if set(params) != {f"hidden_{i}" for i in range(count)} | {f"LayerNorm_{i}" for i in range(norms)}:
    raise ConfigError("The actor is not an MLP on one vector, and only such can be exported.")
  graph = _Chain(INPUT)
  if normalization is not None:
    mean, std = normalization
    graph.apply("Sub", graph.constant(mean))
    graph.apply("Div", graph.constant(std))
  for i in range(count):
    layer = params[f"hidden_{i}"]
    kernel, bias = np.asarray(layer["kernel"]), np.asarray(layer["bias"])
    if i == count - 1 and squashed:  # mean and deviation of the actions before they are squashed: the mean is the mode
      kernel, bias = kernel[:, : len(bias) // 2], bias[: len(bias) // 2]
    graph.apply("Gemm", graph.constant(kernel), graph.constant(bias))
    if i < count - 1:
      _ACTIVATIONS[activation](graph)
      if norms:
        norm = params[f"LayerNorm_{i}"]
        names = graph.constant(norm["scale"]), graph.constant(norm["bias"])
        graph.apply("LayerNormalization", *names, epsilon=_LAYER_NORM_EPSILON)
  if squashed:
    graph.apply("Tanh")
  else:
    graph.apply("Clip", graph.constant(-1.0), graph.constant(1.0))
  graph.nodes[-1].output[0] = OUTPUT
  ends = [(INPUT, len(params["hidden_0"]["kernel"])), (OUTPUT, len(bias))]
  source, sink = (helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, size]) for name, size in ends)
  proto = helper.make_graph(graph.nodes, "policy", [source], [sink], graph.weights)
  model = helper.make_model(proto, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="playground-run")
  model.ir_version = IR_VERSION
  onnx.checker.check_model(model, full_check=True)
  return model
