"""Manipulation tasks reset and step in a batch, and their shapes and types never change."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.envs.dm_control.states import state_at
from tests.envs.golden import BATCH, KEYS, compiled_task, load_task

SIZES = {  # observation, action
  "PandaPickCube": (66, 8),
  "PandaPickCubeOrientation": (66, 8),
  "PandaPickCubeCartesian": (70, 3),
  "PandaOpenCabinet": (55, 8),
  "PandaRobotiqPushCube": (48, 7),
  "AlohaHandOver": (83, 14),
  "AlohaSinglePegInsertion": (82, 14),
  "LeapCubeReorient": ({"state": 57, "privileged_state": 128}, 16),
  "LeapCubeRotateZAxis": ({"state": 32, "privileged_state": 105}, 16),
  "AeroCubeRotateZAxis": ({"state": 14, "privileged_state": 81}, 7),
}


@pytest.mark.parametrize("name", SIZES)
def test_structure_and_types_stay(name: str) -> None:
  """Traced, not compiled, and without the physics."""
  env = load_task(name)
  env.physics.forward = lambda model, data: data
  env.physics.step = lambda model, data, ctrl, num_substeps: data.replace(ctrl=ctrl)
  first = jax.eval_shape(env.reset, KEYS[0])
  second = jax.eval_shape(env.step, first, jnp.zeros(env.action_size))
  assert (jax.tree.map(lambda obs: obs.shape[-1], first.obs), env.action_size) == SIZES[name]
  parts = {group: sum(sizes.values()) for group, sizes in env.observation_parts.items()}
  assert (parts if len(parts) > 1 else parts["state"]) == SIZES[name][0]
  assert jax.tree.structure(second) == jax.tree.structure(first)  # the keys of metrics and info
  kind = lambda x: (x.shape, x.dtype, x.weak_type)  # that of a Python number would compile the step once more
  assert jax.tree.map(kind, second) == jax.tree.map(kind, first)
  assert {"success", "position_error_cm"} <= set(first.metrics) or "turns" in first.metrics
  assert set(env.summaries) <= set(first.metrics)
  assert set(env.episode_info) - {"observation_buffers"} <= set(first.info)


@pytest.mark.parametrize("name", SIZES)
def test_the_first_observation_is_of_the_start_on_the_model_given(name: str) -> None:
  """Traced only; 0.2.0 computes none."""
  for task in (name, f"v020/{name}"):
    env, seen = load_task(task), []
    env.physics.forward = lambda model, data, seen=seen: seen.append(model) or data
    randomised = env.mjx_model.replace(opt=env.mjx_model.opt)
    jax.eval_shape(lambda key, env=env, model=randomised: (env.reset(key), env.reset(key, model)), KEYS[0])
    expected = [] if task != name else [env.mjx_model, randomised]
    assert len(seen) == len(expected) and all(a is b for a, b in zip(seen, expected, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("name", SIZES)
def test_a_roll(name: str) -> None:
  env: Any = compiled_task(name)
  first = jax.vmap(env.reset)(KEYS)
  second = jax.vmap(env.step)(first, jnp.ones((BATCH, env.action_size)))
  third = jax.vmap(env.step)(second, -jnp.ones((BATCH, env.action_size)))
  for steps, state in enumerate((first, second, third)):
    assert jax.tree.map(jax.typeof, state) == jax.tree.map(jax.typeof, first)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state))
    np.testing.assert_allclose(state.data.time, steps * env.dt, rtol=1e-5)
  assert not any(leaf.any() for leaf in jax.tree.leaves((first.reward, first.done, first.metrics)))
  assert (third.data.qvel != second.data.qvel).any(axis=1).all()
  for i in range(BATCH):  # the first observation shows the scene
    data = jax.tree.map(lambda x, i=i: x[i], first.data)
    expected = state_at(env, qpos=data.qpos, mocap_pos=data.mocap_pos, mocap_quat=data.mocap_quat)
    for field in {"xpos", "site_xpos", "site_xmat"} & set(env.derived):
      np.testing.assert_allclose(getattr(data, field), getattr(expected, field), atol=1e-5, err_msg=field)
