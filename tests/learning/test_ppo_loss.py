"""The loss is Brax's, on the same batch."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training import types
from brax.training.acme import running_statistics
from brax.training.agents.ppo import losses as brax_losses
from brax.training.agents.ppo import networks as brax_networks

from playground.learning.hyperparameters import PPOConfig
from playground.learning.networks import ActorCritic, ActorCriticParams, NetworkConfig, normalize
from playground.learning.ppo import Batch, ppo_loss

T, B, OBS, PRIVILEGED, ACTIONS = 6, 5, 4, 7, 3


@pytest.mark.parametrize("clip_value", [None, 0.2])
def test_loss_and_gradient_equal_brax(clip_value: float | None) -> None:
  rng = np.random.default_rng(0)
  sizes = {"state": (OBS,), "privileged_state": (PRIVILEGED,)}
  network = NetworkConfig((16, 16), (24,), value_obs_key="privileged_state")
  ours = ActorCritic(sizes, ACTIONS, network)
  theirs = brax_networks.make_ppo_networks(
    sizes,
    ACTIONS,
    preprocess_observations_fn=running_statistics.normalize,  # pyright: ignore[reportArgumentType]
    policy_hidden_layer_sizes=(16, 16),
    value_hidden_layer_sizes=(24,),
    value_obs_key="privileged_state",
  )
  draw = lambda *shape: jnp.asarray(rng.normal(size=shape), jnp.float32)
  flags = lambda p: jnp.asarray(rng.random((T, B)) < p, jnp.float32)
  raw_obs = {"state": draw(T + 1, B, OBS) * 3 + 1, "privileged_state": draw(T + 1, B, PRIVILEGED) - 2}
  empty = ours.init_normalizer().replace(count=types.UInt64(hi=0, lo=0))  # pyright: ignore[reportCallIssue]
  normalizer = running_statistics.update(empty, raw_obs)
  obs = normalize(raw_obs, normalizer)
  done, truncated = flags(0.3), flags(0.5)
  truncation = done * truncated
  batch = Batch(
    obs=jax.tree.map(lambda x: x[:-1], obs),
    last_obs=jax.tree.map(lambda x: x[-1], obs),
    raw_action=draw(T, B, ACTIONS),
    log_prob=draw(T, B) - 3,
    reward=draw(T, B),
    termination=done * (1 - truncation),
    truncation=truncation,
    value=draw(T, B),
  )
  options: dict[str, Any] = dict(
    entropy_cost=0.02, discounting=0.97, reward_scaling=0.1, gae_lambda=0.9, clipping_epsilon=0.2,
    clipping_epsilon_value=clip_value,
  )  # fmt: skip
  key = jax.random.PRNGKey(1)
  params = ours.init(jax.random.PRNGKey(2))

  batch_first = lambda x: jnp.swapaxes(x, 0, 1)
  data = types.Transition(
    observation=jax.tree.map(lambda x: batch_first(x[:-1]), raw_obs),
    action=jnp.tanh(batch_first(batch.raw_action)),
    reward=batch_first(batch.reward),
    discount=batch_first(1 - done),
    next_observation=jax.tree.map(lambda x: batch_first(x[1:]), raw_obs),
    extras={  # pyright: ignore[reportArgumentType]
      "state_extras": {"truncation": batch_first(truncation)},
      "policy_extras": {
        "raw_action": batch_first(batch.raw_action),
        "log_prob": batch_first(batch.log_prob),
        "distribution_params": draw(B, T, 2 * ACTIONS),
        "value": batch_first(batch.value),
      },
    },
  )

  def brax_loss(params: ActorCriticParams) -> jax.Array:
    brax_params = brax_losses.PPONetworkParams(policy=params.policy, value=params.value)  # pyright: ignore[reportCallIssue]
    return brax_losses.compute_ppo_loss(brax_params, normalizer, data, key, theirs, **options)[0]

  our_loss, our_grad = jax.value_and_grad(
    lambda p: ppo_loss(p, batch, key, ours, PPOConfig(num_timesteps=1, **options))[0]
  )(params)
  their_loss, their_grad = jax.value_and_grad(brax_loss)(params)
  np.testing.assert_allclose(our_loss, their_loss, rtol=1e-5)
  for a, b in zip(jax.tree.leaves(our_grad), jax.tree.leaves(their_grad), strict=True):
    np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5)
