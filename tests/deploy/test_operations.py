"""How exactly single operations compute what the trained network does."""

import numpy as np
import onnxruntime
from onnx import TensorProto, helper

from playground.deploy.graph import IR_VERSION, OPSET
from playground.deploy.operations import Chain, see
from playground.learning.cnn import NORM_EPSILON, CNNConfig

SIZE = [64, 64]


def test_a_dark_image_keeps_its_digits() -> None:
  cnn = CNNConfig((3,), (1,), (1,), "relu", max_pool=False, normalize_channels=True)
  graph = Chain()
  graph.value = "image"
  see(graph, {"conv_0": {"kernel": np.eye(3)[None, None], "bias": np.full(3, 10.0)}}, cnn, SIZE)
  image = helper.make_tensor_value_info("image", TensorProto.UINT8, [1, *SIZE, 3])
  seen = helper.make_tensor_value_info(graph.value, TensorProto.FLOAT, [1, 3 * SIZE[0] * SIZE[1]])
  whole = helper.make_graph(graph.nodes, "see", [image], [seen], graph.weights)
  model = helper.make_model(whole, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
  session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])

  rng = np.random.default_rng(0)
  pixels = rng.integers(6, 9, (1, *SIZE, 3)).astype(np.uint8)
  pixels[:, 30:34] = 250  # a bright strip
  exact = pixels.astype(np.float64)
  exact -= exact.mean(axis=(1, 2), keepdims=True)
  exact = np.maximum(exact / np.sqrt((exact**2).mean(axis=(1, 2), keepdims=True) + NORM_EPSILON) + 10, 0)
  (ours,) = session.run(None, {"image": pixels})
  np.testing.assert_allclose(np.asarray(ours).reshape(exact.shape), exact, rtol=3e-7)
