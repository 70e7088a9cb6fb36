"""C MuJoCo behind a task: one control step as MJX takes it, batches, and what it refuses."""

import copy

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground import registry
from playground.envs.base import Env, State
from playground.envs.c_physics import on_c_physics
from playground.errors import ConfigError
from tests.envs.golden import compiled_task, load_task
from tests.envs.test_golden import OTHER_BOUND, STEP_BOUNDS

SLOW = ["Go1JoystickFlatTerrain", "CheetahRun"]
TASKS = ["CartpoleBalance", *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)]


def on_c(name: str) -> Env:
  return on_c_physics(load_task(name, {"impl": "jax"}))


def rolled(env: Env, steps: int) -> State:
  """Some steps into an episode, with the model's own control."""
  step, action = jax.jit(env.step), jnp.full(env.action_size, 0.1)
  state = jax.jit(env.reset)(jax.random.PRNGKey(0))
  for _ in range(steps):
    state = step(state, action)
  return state


@pytest.mark.parametrize("name", TASKS)
def test_one_control_step_is_that_of_mjx(name: str) -> None:
  state = rolled(on_c(name), 5)
  action = jnp.full(load_task(name).action_size, 0.3)
  ours = jax.jit(on_c(name).step)(state, action)
  mjx = compiled_task(name).step(state, action)
  for (path, actual), expected in zip(jax.tree_util.tree_leaves_with_path(ours), jax.tree.leaves(mjx), strict=True):
    field = jax.tree_util.keystr(path, simple=True, separator="/")
    actual, expected = np.asarray(actual, np.float64), np.asarray(expected, np.float64)
    atol = STEP_BOUNDS.get(field, OTHER_BOUND) * max(1.0, np.abs(expected).max(initial=0.0))
    np.testing.assert_allclose(actual, expected, atol=atol, rtol=0, err_msg=field)


def test_a_batch_is_its_environments_one_after_another() -> None:
  env = on_c("CartpoleBalance")
  keys, actions = jax.random.split(jax.random.PRNGKey(1), 4), jnp.linspace(-1, 1, 4)[:, None]
  batch = jax.vmap(env.jitted[0], (0, None, None))(keys, {}, {})
  batch = jax.vmap(env.jitted[1], (0, 0, None, None))(batch, actions, {}, {})
  for i in range(4):
    one = env.jitted[1](env.jitted[0](keys[i], {}, {}), actions[i], {}, {})
    np.testing.assert_array_equal(batch.data.qpos[i], one.data.qpos)
    np.testing.assert_array_equal(jnp.asarray(batch.obs)[i], one.obs)


def test_a_deep_copy_simulates_alone() -> None:
  env = on_c("CartpoleBalance")
  other = copy.deepcopy(env)
  assert other.physics.mj_model is other.mj_model is not env.mj_model
  np.testing.assert_array_equal(rolled(other, 2).data.qpos, rolled(env, 2).data.qpos)


def test_an_unstable_simulation_shows_its_numbers() -> None:
  physics = on_c("CartpoleBalance").physics
  data = physics.make(qvel=jnp.array([np.inf, 0.0]))
  after = physics.step(physics.model, data, jnp.zeros(1), 1)
  assert not np.isfinite(np.asarray(after.qpos)).all()  # MuJoCo's own way is to begin anew


def test_a_randomised_model_is_refused() -> None:
  env = on_c("CartpoleBalance")
  with pytest.raises(ConfigError, match="nothing of it can be randomised"):
    jax.eval_shape(env.jitted[0], jax.random.PRNGKey(0), {"dof_damping": jnp.ones(2)}, {})


@pytest.mark.slow
def test_a_task_sees_what_c_mujoco_simulates() -> None:
  size = {"vision.width": 24, "vision.height": 24, "vision.frames": 1}
  load = lambda: registry.load("CartpoleBalanceVision", overrides=size)
  seen = {}
  for name, env in {"c": on_c_physics(load()), "warp": load()}.items():
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    step = jax.jit(env.step)
    states = [state, *(state := step(state, jnp.ones(1)) for _ in range(10))]
    seen[name] = np.stack([state.obs["pixels/fixed"] for state in states]).astype(float)
  np.testing.assert_array_equal(seen["c"][0], seen["warp"][0])
  assert (seen["c"][-1] != seen["c"][0]).sum() > 10  # the cart drives off
  assert (np.abs(seen["c"] - seen["warp"]) > 2).mean() < 0.01  # but for pixels on an edge
