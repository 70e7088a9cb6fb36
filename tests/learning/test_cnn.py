"""Networks on images: sizes, what is shared, what is normalised, shifts, and a training step on bytes."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

from playground.config import compose
from playground.envs.base import State
from playground.errors import ConfigError
from playground.hardware.mesh import make_mesh
from playground.learning import ppo
from playground.learning.cnn import CNN, CNNConfig, random_shift
from playground.learning.networks import ACTIVATIONS, ActorCritic, NetworkConfig, SoftActorCritic, SoftNetworkConfig
from playground.learning.ppo import Batch, ppo_loss
from playground.learning.trainer import Trainer
from tests.dummy import SMALL_PPO, PointTask, numbers

SIZES = {"state": (5,), "privileged_state": (7,), "pixels/eye": (16, 12, 3), "pixels/hand": (8, 8, 1)}
TINY = CNNConfig(channels=(4,), kernels=(3,), strides=(2,))
NATURE = CNNConfig((32, 64, 64), (8, 4, 3), (4, 2, 1), "relu", max_pool=False)


def features(config: CNNConfig, pixels: jax.Array) -> jax.Array:
  return CNN(config, ACTIVATIONS[config.activation]).init_with_output(jax.random.PRNGKey(0), pixels)[0]


def observe(key: int, *batch: int) -> dict[str, Any]:
  keys = jax.random.split(jax.random.PRNGKey(key), len(SIZES))
  draw = lambda name, k: (
    jax.random.randint(k, (*batch, *SIZES[name]), 0, 256).astype(jnp.uint8)
    if name.startswith("pixels/")
    else jax.random.normal(k, (*batch, *SIZES[name]))
  )
  return {name: draw(name, k) for name, k in zip(SIZES, keys, strict=True)}


@pytest.mark.parametrize(
  ("config", "size"),
  [
    (CNNConfig(), 4 * 4 * 32),
    (NATURE, 8 * 8 * 64),
    (dataclasses.replace(NATURE, global_pool="avg"), 64),
    (dataclasses.replace(NATURE, global_pool="max"), 64),
    (dataclasses.replace(NATURE, global_pool="spatial_softmax"), 2 * 64),
  ],
)
def test_number_of_features_of_64_pixels_squared(config: CNNConfig, size: int) -> None:
  pixels = jax.ShapeDtypeStruct((3, 2, 64, 64, 3), jnp.uint8)
  assert jax.eval_shape(lambda x: features(config, x), pixels).shape == (3, 2, size)


def test_experiments_have_the_networks_of_their_sources() -> None:
  cartpole = compose(["experiment=cartpole_pixels"]).agent.network
  assert (cartpole.cnn.max_pool, tuple(cartpole.cnn.channels), cartpole.policy_obs_key) == (True, (16, 32), "")
  panda = compose(["experiment=panda_pick_pixels"]).agent.network
  assert panda.cnn == dataclasses.replace(
    CNNConfig([32, 64, 64], [8, 4, 3], [4, 2, 1], "relu", max_pool=False), global_pool="none", normalize_channels=True
  )
  assert panda.policy_hidden_layer_sizes == [256, 256]


def test_normalised_channels_know_no_brightness_nor_contrast() -> None:
  pixels = jax.random.randint(jax.random.PRNGKey(1), (2, 16, 16, 3), 0, 100).astype(jnp.uint8)
  brighter = pixels * jnp.array([1, 2, 1], jnp.uint8) + jnp.array([50, 0, 20], jnp.uint8)
  normalising = dataclasses.replace(TINY, normalize_channels=True)
  np.testing.assert_allclose(features(normalising, pixels), features(normalising, brighter), atol=1e-3)
  assert jnp.abs(features(TINY, pixels) - features(TINY, brighter)).max() > 0.1
  beside_a_bright_one = jnp.concatenate([pixels[:1], pixels[1:] + 150])  # each image is normalised by itself
  np.testing.assert_allclose(features(normalising, beside_a_bright_one), features(normalising, pixels), atol=1e-3)


def test_spatial_softmax_finds_a_bright_spot() -> None:
  from playground.learning.cnn import _POOLS

  spot = jnp.zeros((1, 9, 5, 1)).at[0, 8, 2, 0].set(100.0)
  np.testing.assert_allclose(_POOLS["spatial_softmax"](spot), [[1.0, 0.0]], atol=1e-5)  # bottom, middle


def test_actor_and_critic_have_cnns_of_their_own_and_vectors_of_their_choice() -> None:
  config = NetworkConfig((8,), (8,), policy_obs_key="", value_obs_key="privileged_state", cnn=TINY)
  networks = ActorCritic(SIZES, 2, config)
  params = jax.jit(networks.init)(jax.random.PRNGKey(0))
  logits, value = jax.jit(networks.logits), jax.jit(networks.value)
  cnn_of = lambda tree: tree["params"]["pixels_eye"]["conv_0"]["kernel"]
  assert (cnn_of(params.policy) != cnn_of(params.value)).any()
  assert set(params.policy["params"]) == {"pixels_eye", "pixels_hand", "hidden_0", "output"}

  obs = networks.select(observe(0, 3, 2))
  assert set(obs) == {"privileged_state", "pixels/eye", "pixels/hand"}
  assert logits(params.policy, obs).shape == (3, 2, 4) and value(params.value, obs).shape == (3, 2)
  other = obs | {"privileged_state": obs["privileged_state"] + 1}
  np.testing.assert_array_equal(logits(params.policy, obs), logits(params.policy, other))
  assert (value(params.value, obs) != value(params.value, other)).all()
  dark = obs | {"pixels/hand": jnp.zeros_like(obs["pixels/hand"])}
  assert (logits(params.policy, obs) != logits(params.policy, dark)).all()


def test_images_are_not_normalised() -> None:
  networks = ActorCritic(SIZES, 2, NetworkConfig((8,), (8,), cnn=TINY))
  assert isinstance(mean := networks.init_normalizer().mean, Mapping) and set(mean) == {"state"}


def test_shifts_move_a_trajectory_as_one_and_repeat_edges() -> None:
  image = jnp.arange(12, dtype=jnp.uint8).reshape(3, 4, 1)
  obs = {"pixels/eye": jnp.broadcast_to(image, (2, 3, 3, 4, 1)), "state": jnp.ones((2, 3, 5))}
  shifted = random_shift(obs, jnp.array([[1, 1], [2, 1], [1, 0]]), pad=1)
  np.testing.assert_array_equal(shifted["state"], obs["state"])
  still, up, right = np.asarray(shifted["pixels/eye"][0, ..., 0])
  np.testing.assert_array_equal(shifted["pixels/eye"][0], shifted["pixels/eye"][1])
  np.testing.assert_array_equal(still, image[..., 0])
  np.testing.assert_array_equal(up, image[jnp.array([1, 2, 2]), :, 0])
  np.testing.assert_array_equal(right, image[:, jnp.array([0, 0, 1, 2]), 0])


@pytest.mark.parametrize(
  ("settings", "message"),
  [
    ({"policy_obs_key": "stat"}, r"policy_obs_key='stat' must be an entry.*Did you mean 'state'"),
    ({"value_obs_key": "pixels/eye"}, r"must be an entry .* that is no image: state, privileged_state\.$"),
    ({"estimated_obs_key": "stat"}, r"estimated_obs_key='stat' must be an entry.*Did you mean 'state'"),
    ({"estimated_obs_key": "state"}, "estimated_obs_key='state' is what the actor reads: estimate another entry"),
    ({"estimated_obs_key": "state", "policy_hidden_layer_sizes": ()}, "from images by the first .* lacks one"),
    ({"cnn": dataclasses.replace(TINY, strides=(2, 2))}, "must have one entry for each layer"),
  ],
)
def test_what_cannot_be(settings: dict[str, Any], message: str) -> None:
  with pytest.raises(ConfigError, match=message):
    ActorCritic(SIZES, 2, NetworkConfig(**settings))


def test_no_images_no_empty_key_and_none_for_sac() -> None:
  with pytest.raises(ConfigError, match="policy_obs_key='' must be an entry"):
    ActorCritic(5, 2, NetworkConfig(policy_obs_key=""))
  with pytest.raises(ConfigError, match="estimated_obs_key='state' is estimated from images"):
    ActorCritic(5, 2, NetworkConfig(estimated_obs_key="state"))
  with pytest.raises(ConfigError, match="agent=sac reads no images: choose agent=ppo"):
    SoftActorCritic(SIZES, 2, SoftNetworkConfig())


class Seen(PointTask):
  """The point, and a image whose two channels are as bright as it is far to the right and up."""

  def _obs(self, data: Any) -> dict[str, jax.Array]:
    bright = jnp.clip(60 * (data.qpos + 2), 0, 255)
    return super()._obs(data) | {"pixels/eye": jnp.broadcast_to(bright, (6, 6, 2)).astype(jnp.uint8)}

  def reset(self, rng: jax.Array, model: Any = None) -> State:
    return super().reset(rng)


def test_a_training_step_keeps_images_as_bytes_and_shifts_them(monkeypatch: pytest.MonkeyPatch) -> None:
  shifted: list[Any] = []
  note = lambda obs, shifts, pad: (
    shifted.append((obs["pixels/eye"].shape, shifts, pad)) or random_shift(obs, shifts, pad)
  )
  monkeypatch.setattr(ppo, "random_shift", note)
  network = NetworkConfig((16,), (16,), policy_obs_key="", value_obs_key="", cnn=TINY)
  config = dataclasses.replace(SMALL_PPO, network=network, augment_pixels=1)
  trainer = Trainer(Seen(), config, make_mesh(1))
  state = trainer.init(jax.random.PRNGKey(0), {}, None, trainer.settings)
  assert state.env_state.obs["pixels/eye"].dtype == jnp.uint8
  before = numbers(state.algorithm.params)
  traced = trainer.train.trace(state, {}, jnp.int32(1))
  floats = [v.aval for v in _variables(traced.jaxpr.jaxpr) if v.aval.shape == (5, 32, 6, 6, 2)]
  assert floats and {aval.dtype.name for aval in floats} == {"uint8"}  # all that is collected: [T, B, H, W, C]
  (collected, shifts, pad), (last, same, _) = shifted[:2]  # of a minibatch, [T, B, ...], and of what came after it
  assert pad == 1 and shifts is same and collected[1:] == last and shifts.shape == (last[0], 2)
  state, metrics = trainer.train(state, {}, jnp.int32(1))
  assert metrics["nonfinite_updates"] == 0 and "obs_farthest" not in metrics
  assert all((a != b).any() for a, b in zip(before, numbers(state.algorithm.params), strict=True) if a.any())


def test_a_shift_of_images_is_no_change_of_the_policy() -> None:
  """`max_kl` ends an update after the first gradient step that changes the policy, not before it."""
  network = NetworkConfig((16,), (16,), policy_obs_key="", value_obs_key="", cnn=TINY)
  config = dataclasses.replace(SMALL_PPO, network=network, augment_pixels=2, max_kl=1e-12)
  trainer = Trainer(Seen(), config, make_mesh(1))
  _, metrics = trainer.train(trainer.init(jax.random.PRNGKey(0), {}, None, trainer.settings), {}, jnp.int32(1))
  assert metrics["gradient_steps"] == 1 and np.isfinite(metrics["total_loss"])


def test_only_images_can_be_shifted() -> None:
  with pytest.raises(
    ConfigError, match=r"^agent\.augment_pixels=4 shifts images, and the task has none: set it to 0\.$"
  ):
    Trainer(PointTask(), dataclasses.replace(SMALL_PPO, augment_pixels=4), make_mesh(1))


def test_what_the_actor_estimates_is_learnt_and_does_not_act() -> None:
  network = NetworkConfig((16,), (16,), policy_obs_key="", value_obs_key="", estimated_obs_key="state", cnn=TINY)
  config = dataclasses.replace(SMALL_PPO, network=network)
  trainer = Trainer(Seen(), config, make_mesh(1))
  state = trainer.init(jax.random.PRNGKey(0), {}, None, trainer.settings)
  nets, policy = trainer.networks, jax.device_get(state.algorithm.params.policy)
  assert isinstance(nets, ActorCritic)
  assert policy["params"]["estimator"]["kernel"].shape == (16, 2)
  obs = nets.select(state.env_state.obs)
  logits, estimate = nets.logits_and_estimate(policy, obs)
  np.testing.assert_array_equal(logits, nets.logits(policy, obs))
  other = obs | {"state": obs["state"] + 1}
  np.testing.assert_array_equal(estimate, nets.logits_and_estimate(policy, other)[1])  # from images alone

  log = []
  for _ in range(10):
    state, metrics = trainer.train(state, {}, jnp.int32(2))
    log.append(float(metrics["estimation_loss"]))
    assert metrics["total_loss"] > 0.5 * metrics["estimation_loss"]
  assert log[-1] < 0.3 * log[0], log
  far = jax.tree.map(lambda x: jnp.zeros((1, 2, *x.shape[1:]), x.dtype), obs)
  far |= {"state": jnp.full_like(far["state"], 1000.0)}  # what hardly ever changes, normalised
  row = jnp.zeros((1, 2))
  batch = Batch(far, jax.tree.map(lambda x: x[0], far), jnp.zeros((1, 2, trainer.env.action_size)), row, row, row, row)
  _, parts = ppo_loss(state.algorithm.params, batch, jax.random.PRNGKey(0), nets, config)
  assert 900 < parts["estimation_loss"] < 1100  # not a million, which would drown what the policy learns
  still = dataclasses.replace(config, estimation_coefficient=0.0)
  trainer = Trainer(Seen(), still, make_mesh(1))
  state = trainer.init(jax.random.PRNGKey(0), {}, None, trainer.settings)
  after = trainer.train(state, {}, jnp.int32(2))[0].algorithm.params.policy["params"]
  np.testing.assert_array_equal(after["estimator"]["kernel"], policy["params"]["estimator"]["kernel"])


def _variables(jaxpr: Any) -> list[Any]:
  """All that a program computes, in the programs inside it, too."""
  inner = [sub for eqn in jaxpr.eqns for sub in jaxprs_in_params(eqn.params)]
  return [v for eqn in jaxpr.eqns for v in eqn.outvars] + [v for sub in inner for v in _variables(sub)]
