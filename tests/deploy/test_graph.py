"""The ONNX graph computes what Flax does, for every activation and every kind of CNN; other networks are refused."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import pytest

from playground.deploy.graph import OPSET, input_names, policy_graph
from playground.deploy.policy import ExportedPolicy
from playground.errors import ConfigError
from playground.learning.cnn import _POOLS, CNNConfig
from playground.learning.fast_sac import FastSACNetworks
from playground.learning.hyperparameters import ActivationName
from playground.learning.networks import ACTIVATIONS, ActorCritic, NetworkConfig, SoftActorCritic, SoftNetworkConfig
from tests.dummy import SMALL_FAST_SAC, PointTask

OBS, ACTIONS = 6, 2
SEEN = {"state": (OBS,), "pixels/eye": (17, 12, 3), "pixels/left-hand": (8, 9, 1)}
CNNS = [
  CNNConfig((4, 6), (5, 3), (2, 2)),
  CNNConfig((4, 6), (4, 1), (1, 3), "relu", max_pool=False, global_pool="avg", normalize_channels=True),
  CNNConfig((4,), (2,), (3,), "swish", max_pool=True, global_pool="max"),
  CNNConfig((4, 3), (3, 2), (2, 1), "gelu", max_pool=False, global_pool="spatial_softmax", normalize_channels=True),
]


def exported(model: onnx.ModelProto, entries: dict[str, tuple[int, ...]]) -> ExportedPolicy:
  kinds = {entry: "uint8" if entry.startswith("pixels/") else "float32" for entry in entries}
  names = input_names(entries)
  inputs = [{"name": names[e], "entry": e, "shape": [1, *entries[e]], "type": kinds[e]} for e in entries]
  facts = {"inputs": inputs, "output": "continuous_actions", "action_size": ACTIONS}
  return ExportedPolicy(model.SerializeToString(), {"policy": facts})


def ends(model: onnx.ModelProto) -> dict[str, list[int]]:
  """Shapes of inputs and outputs by name."""
  both = [*model.graph.input, *model.graph.output]
  return {end.name: [dim.dim_value for dim in end.type.tensor_type.shape.dim] for end in both}


def networks(activation: ActivationName, soft: bool) -> ActorCritic | SoftActorCritic:
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
def test_same_actions(activation: ActivationName, soft: bool) -> None:
  nets = networks(activation, soft)
  policy, normalizer = trained(nets)
  obs = np.random.default_rng(1).normal(scale=3, size=(20, OBS)).astype(np.float32)
  for seen in (normalizer, None):
    normalization = None if seen is None else (seen.mean["state"], seen.std["state"])
    model = policy_graph(policy["params"], nets.policy_inputs, activation, normalization)
    ours = exported(model, nets.policy_inputs).actions(obs)
    theirs = nets.act(policy, seen, obs, jax.random.PRNGKey(0), deterministic=True)  # pyright: ignore[reportArgumentType]
    np.testing.assert_allclose(ours, theirs, atol=2e-6)
    assert np.abs(ours).max() > 0.1


def test_same_actions_of_fast_sac() -> None:
  nets = FastSACNetworks(PointTask(), SMALL_FAST_SAC, None)
  rng = np.random.default_rng(0)
  shapes = jax.eval_shape(nets.init, jax.random.PRNGKey(0)).policy
  policy = jax.tree.map(lambda x: rng.normal(scale=0.4, size=x.shape).astype("f"), shapes)
  normalizer = nets.init_normalizer()
  obs = {key: rng.normal(size=(20, *size)).astype(np.float32) for key, size in nets.obs_sizes.items()}
  layers, normalization = nets.mlp(policy, jax.device_get(normalizer))
  model = policy_graph(layers, nets.policy_inputs, nets.activation_name, normalization)
  theirs = nets.act(policy, normalizer, obs, jax.random.PRNGKey(0), deterministic=True)  # pyright: ignore[reportArgumentType]
  np.testing.assert_allclose(exported(model, nets.policy_inputs).actions(obs["state"]), theirs, atol=2e-6)


def test_clipped_observations_are_clipped_in_the_graph() -> None:
  nets = ActorCritic(OBS, ACTIONS, NetworkConfig((16, 8), (4,), "swish", clip_observations=0.7))
  policy, normalizer = trained(nets)
  obs = np.random.default_rng(1).normal(scale=3, size=(20, OBS)).astype(np.float32)
  layers, normalization = nets.mlp(policy, normalizer)
  model = policy_graph(layers, nets.policy_inputs, "swish", normalization, None, nets.obs_limit)
  theirs = nets.act(policy, normalizer, obs, jax.random.PRNGKey(0), deterministic=True)  # pyright: ignore[reportArgumentType]
  np.testing.assert_allclose(exported(model, nets.policy_inputs).actions(obs), theirs, atol=2e-6)


def test_what_a_controller_finds() -> None:
  nets = networks("swish", soft=False)
  model = policy_graph(trained(nets)[0]["params"], nets.policy_inputs, "swish", None)
  assert ends(model) == {"obs": [1, OBS], "continuous_actions": [1, ACTIONS]}
  assert [opset.version for opset in model.opset_import] == [OPSET]


@pytest.mark.parametrize("cnn", CNNS, ids=lambda cnn: cnn.global_pool)
def test_same_actions_from_images_and_a_vector(cnn: CNNConfig) -> None:
  nets = ActorCritic(SEEN, ACTIONS, NetworkConfig((16, 8), (4,), "elu", cnn=cnn))
  policy, normalizer = trained(nets)
  policy = jax.tree.map(lambda x: x / 2, policy)  # or tanh hides much
  rng = np.random.default_rng(1)
  obs = {name: rng.integers(0, 256, (5, 3, *size), np.uint8) for name, size in SEEN.items() if name != "state"}
  obs["pixels/eye"][0] = 7 + obs["pixels/eye"][0] // 128  # next to no contrast
  obs |= {"state": rng.normal(scale=3, size=(5, 3, OBS)).astype(np.float32)}
  layers, normalization = nets.mlp(policy, normalizer)
  model = policy_graph(layers, nets.policy_inputs, "elu", normalization, nets.cnn)
  assert ends(model) == {
    "pixels_eye": [1, 17, 12, 3], "pixels_left_hand": [1, 8, 9, 1], "obs": [1, OBS], "continuous_actions": [1, ACTIONS],
  }  # fmt: skip
  with jax.default_matmul_precision("highest"):
    theirs = jax.jit(lambda obs: nets.act(policy, normalizer, obs, jax.random.PRNGKey(0), True))(obs)
  ours = exported(model, nets.policy_inputs).actions(obs)
  np.testing.assert_allclose(ours, theirs, atol=5e-6)
  assert ours.std(axis=(0, 1)).min() > 0.1


def test_every_pool_is_tried() -> None:
  assert {cnn.global_pool for cnn in CNNS} == set(_POOLS)


def test_images_alone_are_obs() -> None:
  sizes = {"state": (OBS,), "pixels/eye": (9, 8, 3)}
  keys: Any = {
    "policy_obs_key": "",
    "value_obs_key": "",
    "estimated_obs_key": "state",
  }  # of which the policy needs none
  nets = ActorCritic(sizes, ACTIONS, NetworkConfig((8,), (4,), **keys, cnn=CNNS[0]))
  layers, normalization = nets.mlp(trained(nets)[0], nets.init_normalizer())
  model = policy_graph(layers, nets.policy_inputs, "swish", normalization, nets.cnn)
  assert ends(model) == {"obs": [1, 9, 8, 3], "continuous_actions": [1, ACTIONS]}
  assert model.graph.input[0].type.tensor_type.elem_type == onnx.TensorProto.UINT8
  obs = {"state": jnp.zeros((2, OBS)), "pixels/eye": jnp.ones((2, 9, 8, 3), jnp.uint8)}
  assert jax.jit(exported(model, nets.policy_inputs).act)({}, obs, jax.random.PRNGKey(0)).shape == (2, ACTIONS)


def test_another_network_is_refused() -> None:
  with pytest.raises(ConfigError, match="not an MLP"):
    policy_graph({"Conv_0": {}, "hidden_0": {}}, {"state": (OBS,)}, "relu", None)
