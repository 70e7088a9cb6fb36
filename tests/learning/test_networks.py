"""The critic is Brax's value network, in float32 or with bfloat16 activations."""

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.agents.ppo import networks as brax_networks
from flax import linen

from playground.config import compose, format_value
from playground.errors import ConfigError
from playground.hardware.mesh import AXIS
from playground.learning.algorithm import build_algorithm
from playground.learning.hyperparameters import PPOConfig
from playground.learning.networks import MAX_TERMS, ActorCritic, NetworkConfig, update_normalizer
from playground.settings import build
from tests.dummy import Point

SIZES = (64, 64, 64)


def critic(dtype: Literal["auto", "bfloat16", "float32"]) -> tuple[ActorCritic, Any]:
  networks = ActorCritic(5, 2, NetworkConfig((8,), SIZES, value_dtype=dtype))
  return networks, networks.init(jax.random.PRNGKey(3)).value


def test_float32_is_braxs_network() -> None:
  networks, params = critic("float32")
  theirs = brax_networks.make_ppo_networks(5, 2, value_hidden_layer_sizes=SIZES, activation=linen.swish).value_network
  value_key = jax.random.split(jax.random.PRNGKey(3))[1]
  jax.tree.map(np.testing.assert_array_equal, params, theirs.init(value_key))
  obs = jax.random.normal(jax.random.PRNGKey(0), (7, 3, 5))
  np.testing.assert_array_equal(networks.value(params, {"state": obs}), theirs.apply(None, params, obs))


def test_bfloat16_is_near_and_keeps_parameters_in_float32() -> None:
  exact, params = critic("float32")
  rough, rough_params = critic("bfloat16")
  jax.tree.map(np.testing.assert_array_equal, params, rough_params)
  assert {leaf.dtype for leaf in jax.tree.leaves(rough_params)} == {jnp.dtype("float32")}
  obs = {"state": jax.random.normal(jax.random.PRNGKey(0), (256, 5))}
  loss = lambda networks: jax.value_and_grad(lambda p: jnp.square(networks.value(p, obs) - 1).mean())(params)
  (value, grads), (near_value, near_grads) = loss(exact), loss(rough)
  np.testing.assert_allclose(near_value, value, rtol=0.01)
  for near, grad in zip(jax.tree.leaves(near_grads), jax.tree.leaves(grads), strict=True):
    assert near.dtype == jnp.float32
    assert jnp.linalg.norm(near - grad) < 0.03 * jnp.linalg.norm(grad)


@pytest.mark.parametrize("sizes", [{"state": (5,)}, {"state": (5,), "pixels/eye": (12, 12, 3)}])
def test_a_new_actors_actions_have_the_standard_deviation_that_is_set(sizes: dict[str, tuple[int, ...]]) -> None:
  zero = {key: jnp.zeros((1, *shape), jnp.uint8 if key != "state" else jnp.float32) for key, shape in sizes.items()}

  def fresh(init_std: float | None) -> tuple[Any, Any]:
    networks = ActorCritic(sizes, 2, NetworkConfig((8,), SIZES, init_std=init_std))
    params = networks.init(jax.random.PRNGKey(3))
    return networks.distribution.create_dist(networks.logits(params.policy, zero)), params

  usual, params = fresh(None)
  small, same = fresh(0.15)
  exact = 1e-6 if len(sizes) == 1 else 0.2  # an image of zeros is no vector of zeros
  np.testing.assert_allclose(usual.scale, jax.nn.softplus(0.0) + 1e-3, rtol=exact)
  np.testing.assert_allclose(small.scale, 0.15, rtol=exact)
  np.testing.assert_array_equal(small.loc, usual.loc)
  changed = [bool((a != b).any()) for a, b in zip(jax.tree.leaves(params), jax.tree.leaves(same), strict=True)]
  assert sum(changed) == 1, "one layer's biases"


def test_dtype_follows_the_device() -> None:
  networks, _ = critic("auto")
  assert networks.value_dtype == ("bfloat16" if jax.default_backend() == "gpu" else "float32")


@pytest.mark.parametrize(
  ("config", "message"),
  [
    (
      {"network": {"value_dtype": "half"}},
      "agent.network.value_dtype=half is unknown: choose from auto, bfloat16, float32",
    ),
    ({"network": {"activation": "rel"}}, "agent.network.activation=rel is unknown: .* Did you mean 'relu'"),
    ({"network": {"cnn": {"global_pool": "mean"}}}, "network.cnn.global_pool=mean is unknown: choose from none, avg"),
    ({"network": {"cnn": {"activation": "rel"}}}, "network.cnn.activation=rel is unknown: .* Did you mean 'relu'"),
    ({"network": {"policy_hidden_layer_sizes": [8, 0]}}, r"sizes=\[8, 0\] must be a list of whole numbers from 1 to"),
    ({"discounting": 1.5}, "agent.discounting=1.5 must be a number from 0 to 1"),
    ({"network": {"init_std": 0.0001}}, "network.init_std=0.0001 must be a number from 0.01 to 10"),
  ],
)
def test_python_and_the_command_line_refuse_the_same_values(config: dict[str, Any], message: str) -> None:
  with pytest.raises(ConfigError, match=message):
    build_algorithm(Point(), build(PPOConfig, config), None)
  with pytest.raises(ConfigError, match=message):
    compose(["env=CartpoleBalance", "agent=ppo", *(f"agent.{key}={format_value(x)}" for key, x in config.items())])


def test_statistics_are_of_all_observations_on_all_devices_and_of_any_number() -> None:
  """Two devices and two updates; a tree with fetched statistics stays on the host."""
  obs = np.random.default_rng(0).normal(3.0, 2.0, (2, 2, 50, 4)).astype(np.float32)  # update, device, environment, D
  normalizer: Any = ActorCritic({"state": (4,)}, 2, NetworkConfig((8,), (8,))).init_normalizer()
  one = lambda obs, state: update_normalizer(state, {"state": obs})
  update = jax.jit(jax.vmap(one, (0, None), None, axis_name=AXIS))
  for each in obs:
    normalizer = jax.device_get(update(each, normalizer))
  seen = obs.reshape(-1, 4)
  np.testing.assert_allclose(normalizer.mean["state"], seen.mean(0), rtol=1e-5)
  np.testing.assert_allclose(normalizer.std["state"], seen.std(0), rtol=1e-5)
  assert all(isinstance(x, np.ndarray) for x in jax.tree.leaves(jax.tree.map(lambda x: x, normalizer)))
  assert (int(normalizer.count.hi), int(normalizer.count.lo)) == (0, 200)
  full = normalizer.replace(count=normalizer.count.replace(lo=np.uint32(2**32 - 1)))
  count = update(obs[0], full).count
  assert (int(count.hi), int(count.lo)) == (0, (2**32 + 99) // 2)


def test_the_spread_of_observations_stays_after_very_many_updates() -> None:
  """In float32, 2**24 or more equal terms make a sum that the next one does not change."""
  normalizer: Any = ActorCritic({"state": (1,)}, 2, NetworkConfig((8,), (8,))).init_normalizer()
  many = 3 * MAX_TERMS // 4
  normalizer = normalizer.replace(
    count=normalizer.count.replace(lo=jnp.uint32(many)), summed_variance={"state": jnp.full(1, float(many))}
  )

  def update(state: Any, key: jax.Array) -> tuple[Any, None]:
    each = jax.random.rademacher(key, (1, 1, 1), jnp.float32)  # of variance 1
    return jax.vmap(lambda obs: update_normalizer(state, {"state": obs}), out_axes=None, axis_name=AXIS)(each), None

  rounds = jax.jit(lambda state, key: jax.lax.scan(update, state, jax.random.split(key, MAX_TERMS))[0])
  for i in range(2):
    normalizer = rounds(normalizer, jax.random.PRNGKey(i))
    assert int(normalizer.count.lo) < MAX_TERMS and int(normalizer.count.hi) == 0
    np.testing.assert_allclose(normalizer.std["state"], 1.0, atol=0.01)
