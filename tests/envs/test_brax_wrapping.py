"""`wrap_for_brax_training` with randomised models, as users of the old package call it."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import playground
from playground.randomization import domain_randomizer

N = 16
MASS = {"field": "body_mass", "target": "pole_1", "operation": "scale", "range": [0.5, 2.0]}
EVENTS = {"pole_mass": {"mode": "startup", "func": "model_field", "params": MASS}}


def test_the_same_start_on_different_models_goes_different_ways() -> None:
  env = playground.load("CartpoleBalance")
  randomize: Any = domain_randomizer(env.mj_model, EVENTS)
  keys = jax.random.split(jax.random.PRNGKey(1), N)
  wrapped = playground.wrap_for_brax_training(
    env, episode_length=3, action_repeat=1, randomization_fn=functools.partial(randomize, rng=keys)
  )
  state = jax.jit(wrapped.reset)(jnp.tile(jax.random.PRNGKey(0), (N, 1)))
  assert len(np.unique(np.asarray(state.data.qpos), axis=0)) == 1
  step = jax.jit(wrapped.step)
  state = step(state, jnp.ones((N, env.action_size)))
  assert len(np.unique(np.asarray(state.data.qvel), axis=0)) == N
  for _ in range(2):
    state = step(state, jnp.ones((N, env.action_size)))
  np.testing.assert_array_equal(state.done, 1)
  np.testing.assert_array_equal(state.info["truncation"], 1)
  assert wrapped.observation_size == 5
  assert wrapped.unwrapped is env


def test_tasks_without_randomisation_have_no_randomizer() -> None:
  assert playground.registry.get_domain_randomizer("CartpoleBalance") is None
  assert callable(playground.registry.get_domain_randomizer("Go1JoystickFlatTerrain"))
