"""How physics reaches a backend; what it computes is in test_golden.py."""

import re

import jax
import jax.numpy as jnp

from playground import registry


def test_a_control_step_calls_warp_at_one_place() -> None:
  # Each place holds temporary memory of its own on a GPU: for the G1's 8192 environments about a GiB.
  env = registry.load("CheetahRun", config_overrides={"impl": "warp", "sim_dt": 0.005})
  state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
  program = jax.jit(env.step).lower(state, jnp.zeros(env.action_size)).as_text()
  assert len(re.findall(r"custom_call @\w*func_wrapper", program)) == 1
