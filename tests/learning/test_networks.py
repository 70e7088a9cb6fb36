"""The critic is Brax's value network, in float32 or with bfloat16 activations."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.agents.ppo import networks as brax_networks
from flax import linen

from playground.errors import ConfigError
from playground.learning.networks import ActorCritic, NetworkConfig

SIZES = (64, 64, 64)


def critic(dtype: str) -> tuple[ActorCritic, Any]:
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


def test_dtype_follows_the_device_and_unknown_ones_are_refused() -> None:
  networks, _ = critic("auto")
  assert networks.value_dtype == ("bfloat16" if jax.default_backend() == "gpu" else "float32")
  with pytest.raises(ConfigError, match=r"value_dtype='half' must be one of"):
    critic("half")
