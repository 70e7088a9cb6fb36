"""SAC's losses are Brax's, on the same batch and the same draws, and each gradient is its own loss's."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training import types
from brax.training.agents.sac import losses as brax_losses
from brax.training.agents.sac import networks as brax_networks

from playground.learning.hyperparameters import SACConfig
from playground.learning.networks import SoftActorCritic, SoftActorCriticParams, SoftNetworkConfig
from playground.learning.off_policy import Transition
from playground.learning.sac import PARTS, sac_loss

B, OBS, ACTIONS = 12, 5, 3


def as_brax(q: Any) -> Any:
  """Our stacked critics as Brax's two modules."""
  first, second = (jax.tree.map(lambda x, i=i: x[i], q["params"]) for i in range(2))
  return {"params": {"MLP_0": first, "MLP_1": second}}


@pytest.mark.parametrize("batched", [False, True])
def test_losses_and_gradients_equal_brax(batched: bool) -> None:
  rng = np.random.default_rng(0)
  draw = lambda *shape: jnp.asarray(rng.normal(size=shape), jnp.float32)
  flags = lambda p: jnp.asarray(rng.random(B) < p, jnp.float32)
  config = SoftNetworkConfig((16, 24), policy_network_layer_norm=True, q_network_layer_norm=True)
  ours = SoftActorCritic(OBS, ACTIONS, config)
  ours.batched = batched
  theirs = brax_networks.make_sac_networks(
    OBS, ACTIONS, hidden_layer_sizes=(16, 24), policy_network_layer_norm=True, q_network_layer_norm=True
  )
  params = ours.init(jax.random.PRNGKey(0)).replace(log_alpha=jnp.asarray(-0.7))
  target_q = ours.init(jax.random.PRNGKey(1)).q
  obs, next_obs, action = draw(B, OBS), draw(B, OBS), jnp.tanh(draw(B, ACTIONS))
  reward, discount, masked = draw(B), 1 - flags(0.3), flags(0.3)
  batch = Transition({"state": obs}, {"state": next_obs}, action, reward, discount, masked)  # pyright: ignore
  keys = jax.random.split(jax.random.PRNGKey(2))
  noise = jnp.stack([jax.random.normal(key, (B, ACTIONS)) for key in keys])

  settings = SACConfig(num_timesteps=1, discounting=0.97, reward_scaling=0.5)

  @jax.jit
  def found() -> tuple[jax.Array, SoftActorCriticParams]:
    loss = jax.value_and_grad(sac_loss, has_aux=True)
    (_, parts), grads = loss(params, target_q, batch, noise, ours, settings)
    return parts, grads

  @jax.jit
  def expected() -> dict[str, tuple[jax.Array, Any]]:
    extras = {"state_extras": {"truncation": masked}, "policy_extras": {}}
    data = types.Transition(obs, action, reward, discount, next_obs, extras=extras)  # pyright: ignore
    alpha_loss, critic_loss, actor_loss = map(jax.value_and_grad, brax_losses.make_losses(theirs, 0.5, 0.97, ACTIONS))
    alpha, policy = jnp.exp(params.log_alpha), params.policy
    q, target = as_brax(params.q), as_brax(target_q)
    return {
      "critic_loss": critic_loss(q, policy, None, target, alpha, data, keys[1]),
      "actor_loss": actor_loss(policy, None, q, alpha, data, keys[0]),
      "alpha_loss": alpha_loss(params.log_alpha, policy, None, data, keys[0]),
    }

  parts, grads = found()
  ours_by_name = {"critic_loss": as_brax(grads.q), "actor_loss": grads.policy, "alpha_loss": grads.log_alpha}
  for name, (value, grad) in expected().items():
    np.testing.assert_allclose(parts[PARTS.index(name)], value, rtol=1e-5, err_msg=name)
    equal = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)
    jax.tree.map(equal, ours_by_name[name], grad)
  np.testing.assert_allclose(parts[PARTS.index("alpha")], np.exp(-0.7), rtol=1e-6)
