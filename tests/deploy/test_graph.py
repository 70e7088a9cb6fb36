"""The ONNX graph computes what Flax does, for every activation; only an MLP is taken."""

from typing import Any

import jax
import numpy as np
import onnx
import pytest

from playground.deploy.graph import OPSET, policy_graph
from playground.deploy.policy import ExportedPolicy
from playground.errors import ConfigError
from playground.learning.networks import ACTIVATIONS, ActorCritic, NetworkConfig, SoftActorCritic, SoftNetworkConfig

OBS, ACTIONS = 6, 2


def exported(model: onnx.ModelProto) -> ExportedPolicy:
  facts = {"input": "obs", "output": "continuous_actions", "entry": "state", "action_size": ACTIONS}
  return ExportedPolicy(model.SerializeToString(), {"policy": facts})


def networks(activation: str, soft: bool) -> ActorCritic | SoftActorCritic:
  if soft:
    return SoftActorCritic(OBS, ACTIONS, SoftNetworkConfig((16, 8), activation, policy_network_layer_norm=True))
  return ActorCritic(OBS, ACTIONS, NetworkConfig((16, 8), (4,), activation))


def trained(nets: ActorCritic | SoftActorCritic) -> tuple[Any, Any]:
  """Parameters, no bias of them 0, and a normaliser that has seen something."""
  shapes = jax.eval_shape(nets.init, jax.random.PRNGKey(0)).policy
  rng = np.random.default_rng(0)
  policy = jax.tree.map(lambda x: rng.normal(scale=0.4, size=x.shape).astype("f"), shapes)
  normalizer = nets.init_normalizer()
  mean, std = rng.normal(size=OBS).astype("f"), rng.uniform(0.1, 2, OBS).astype("f")
  return policy, normalizer.replace(mean={"state": mean}, std={"state": std})


@pytest.mark.parametrize(("activation", "soft"), [*((name, False) for name in ACTIVATIONS), ("relu", True)])
def test_same_actions(activation: str, soft: bool) -> None:
  nets = networks(activation, soft)
  policy, normalizer = trained(nets)
  obs = np.random.default_rng(1).normal(scale=3, size=(20, OBS)).astype(np.float32)
  for seen in (normalizer, None):
    normalization = None if seen is None else (seen.mean["state"], seen.std["state"])
    ours = exported(policy_graph(policy["params"], activation, normalization)).actions(obs)
    theirs = nets.act(policy, seen, obs, jax.random.PRNGKey(0), deterministic=True)  # pyright: ignore[reportArgumentType]
    np.testing.assert_allclose(ours, theirs, atol=2e-6)
    assert np.abs(ours).max() > 0.1


def test_what_a_controller_finds() -> None:
  nets = networks("swish", soft=False)
  model = policy_graph(trained(nets)[0]["params"], "swish", None)
  ends = [*model.graph.input, *model.graph.output]
  shapes = {end.name: [dim.dim_value for dim in end.type.tensor_type.shape.dim] for end in ends}
  assert shapes == {"obs": [1, OBS], "continuous_actions": [1, ACTIONS]}
  assert [opset.version for opset in model.opset_import] == [OPSET]


def test_another_network_is_refused() -> None:
  with pytest.raises(ConfigError, match="not an MLP"):
    policy_graph({"Conv_0": {}, "hidden_0": {}}, "relu", None)
