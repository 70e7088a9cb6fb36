"""Builds the ONNX graph of a trained actor: normalisation, layers, mean of the Gaussian, tanh."""

import re
from collections.abc import Collection, Mapping

import numpy as np
import onnx
from onnx import TensorProto, helper

from playground.deploy.operations import ACTIVATIONS, Chain, see
from playground.envs.base import PIXELS
from playground.errors import ConfigError
from playground.learning.cnn import CNNConfig, cnn_name
from playground.pytree import PyTree

INPUT, OUTPUT = "obs", "continuous_actions"
# Old enough for runtimes on robots; the first opset with LayerNormalization.
OPSET, IR_VERSION = 17, 8

_LAYER_NORM_EPSILON = 1e-6  # Flax's default


def input_names(entries: Collection[str]) -> dict[str, str]:
  """Returns the graph's input name of each observation group of an actor: `obs` for the vector or a sole image."""
  alone = len(entries) == 1
  names = {entry: re.sub(r"[^A-Za-z0-9_]", "_", entry) for entry in entries}
  return {entry: name if entry.startswith(PIXELS) and not alone else INPUT for entry, name in names.items()}


def policy_graph(
  params: Mapping[str, PyTree],
  inputs: Mapping[str, tuple[int, ...]],
  activation: str,
  normalization: tuple[np.ndarray, np.ndarray] | None,
  cnn: CNNConfig | None = None,
  obs_limit: float | None = None,
) -> onnx.ModelProto:
  """Builds the graph of a deterministic policy.

  Args:
    params: Flax parameters of the actor. Layers of its MLP are `hidden_<i>` with `kernel` [in, out] and `bias` [out],
      and `LayerNorm_<i>` with `scale` and `bias` if its layers are normalised. An actor with images has `output` as
      its last layer, and a CNN for each camera (`cnn_name`).
    inputs: shapes of the observation groups that the actor reads, in its order: images, then the vector.
    activation: of the hidden layers, as in `agent.network.activation`.
    normalization: mean and std of the vector, [n] each; None without normalisation.
    cnn: settings of the CNN, if there are images.
    obs_limit: clip range of the normalised vector; None without a limit.

  Returns:
    The model: `obs` float32 [1, n], and images uint8 [1, H, W, C] (`input_names`) -> `continuous_actions` float32
    [1, action_size] in [-1, 1].

  Raises:
    ConfigError: the actor has unknown layers.
  """
  images = [entry for entry in inputs if entry.startswith(PIXELS)]
  hidden = sum(name.startswith("hidden_") for name in params)
  norms = sum(name.startswith("LayerNorm_") for name in params)
  layers = [*(f"hidden_{i}" for i in range(hidden)), *(["output"] if images else [])]
  if set(params) != {*layers, *(f"LayerNorm_{i}" for i in range(norms)), *map(cnn_name, images)}:
    raise ConfigError("The actor is not an MLP, with or without CNNs before it, and only such can be exported.")
  graph, names, features = Chain(), input_names(inputs), []
  for entry, shape in inputs.items():
    graph.value = names[entry]
    if entry in images:
      assert cnn is not None
      see(graph, params[cnn_name(entry)], cnn, [*shape[:2]])
    else:
      if normalization is not None:
        mean, std = normalization
        graph.apply("Sub", graph.constant(mean))
        graph.apply("Div", graph.constant(std))
      if obs_limit is not None:
        graph.apply("Clip", graph.constant(-obs_limit), graph.constant(obs_limit))
    features.append(graph.value)
  if len(features) > 1:
    graph.value = features[0]
    graph.apply("Concat", *features[1:], axis=1)
  size = 0
  for i, name in enumerate(layers):
    kernel, bias = np.asarray(params[name]["kernel"]), np.asarray(params[name]["bias"])
    last = i == len(layers) - 1
    if last:  # mean and std of the actions before squashing: the mean is the mode
      size = len(bias) // 2
      kernel, bias = kernel[:, :size], bias[:size]
    graph.apply("Gemm", graph.constant(kernel), graph.constant(bias))
    if not last:
      ACTIVATIONS[activation](graph)
      if norms:
        norm = params[f"LayerNorm_{i}"]
        scale_and_bias = graph.constant(norm["scale"]), graph.constant(norm["bias"])
        graph.apply("LayerNormalization", *scale_and_bias, epsilon=_LAYER_NORM_EPSILON)
  graph.apply("Tanh")
  graph.nodes[-1].output[0] = OUTPUT
  kinds = {entry: TensorProto.UINT8 if entry in images else TensorProto.FLOAT for entry in inputs}
  sources = [helper.make_tensor_value_info(names[entry], kinds[entry], [1, *inputs[entry]]) for entry in inputs]
  sink = helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, [1, size])
  proto = helper.make_graph(graph.nodes, "policy", sources, [sink], graph.weights)
  model = helper.make_model(proto, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="playground-run")
  model.ir_version = IR_VERSION
  onnx.checker.check_model(model, full_check=True)
  return model
