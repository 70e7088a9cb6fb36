"""How physics reaches a backend; what it computes is in test_golden.py."""

import re

import jax
import jax.numpy as jnp

from playground import registry
from playground.hardware.mesh import GROUP
from playground.physics.backend import WORLDS, batch_size


def test_a_control_step_calls_warp_at_one_place() -> None:
  # Each place holds temporary memory of its own on a GPU: for the G1's 8192 environments about a GiB.
  env = registry.load("CheetahRun", config_overrides={"impl": "warp", "sim_dt": 0.005})
  state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
  program = jax.jit(env.step).lower(state, jnp.zeros(env.action_size)).as_text()
  assert len(re.findall(r"custom_call @\w*func_wrapper", program)) == 1


def test_warps_buffers_grow_with_the_environments_of_all_agents_on_a_device() -> None:
  sizes: list[int] = []
  environment = lambda x: sizes.append(batch_size()) or x
  batch = jax.vmap(environment, axis_name=WORLDS)
  batch(jnp.zeros(4))
  jax.vmap(batch, axis_name=GROUP)(jnp.zeros((3, 4)))
  environment(jnp.zeros(()))
  assert sizes == [4, 12, 1]
