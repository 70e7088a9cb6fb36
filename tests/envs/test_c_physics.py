"""C MuJoCo behind a task: one control step as MJX takes it, batches, and what it refuses."""

import copy
import operator

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


def rolled_on(env: Env, state: State, action: jax.Array) -> jax.Array:
  return jax.jit(env.step)(state, action).data.qvel


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


def test_an_action_that_is_not_finite_shows_as_in_mjx() -> None:
  env, action = on_c("CartpoleBalance"), jnp.full(1, jnp.nan)
  state = rolled(env, 1)
  for qvel in (rolled_on(env, state, action), compiled_task("CartpoleBalance").step(state, action).data.qvel):
    assert jnp.isnan(qvel).all()
  assert jnp.isfinite(rolled_on(env, state, jnp.zeros(1))).all()


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


def test_each_environment_of_a_batch_has_its_randomised_model() -> None:
  env, mjx = on_c("CartpoleBalance"), compiled_task("CartpoleBalance")
  action, damping = jnp.full(1, 0.5), jnp.array([[0.0, 0.0], [5e-4, 2e-6], [5.0, 0.5]])
  state = rolled(env, 3)
  step = lambda fields: env.step(state, action, env.mjx_model.replace(**fields)).data.qvel
  ours = jax.jit(jax.vmap(step))({"dof_damping": damping})
  assert len(np.unique(ours[:, 0])) == 3
  for qvel, each in zip(ours, damping, strict=True):
    theirs = mjx.step(state, action, load_task("CartpoleBalance").mjx_model.replace(dof_damping=each))
    np.testing.assert_allclose(qvel, theirs.data.qvel, atol=1e-5)
  nominal = rolled_on(env, state, action)
  np.testing.assert_array_equal(nominal, rolled_on(on_c("CartpoleBalance"), state, action))


@pytest.mark.slow
def test_each_episode_has_the_model_that_events_draw() -> None:
  params = {"field": "body_mass", "target": "all", "operation": "scale", "range": [0.5, 2.0], "shared": True}
  heavier = {"events.mass": {"mode": "reset", "func": "model_field", "params": params}}
  env = on_c_physics(load_task("Go1JoystickFlatTerrain", {"impl": "jax", **heavier}))
  states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 2))
  light, heavy = (jax.tree.map(operator.itemgetter(i), states) for i in range(2))
  step, action = jax.jit(env.step), jnp.zeros(env.action_size)
  other = light.replace(info=light.info | {name: heavy.info[name] for name in heavy.info if "model" in name})
  assert (step(light, action).data.qvel != step(other, action).data.qvel).any()


def test_what_is_no_array_of_the_model_is_refused() -> None:
  physics = on_c("CartpoleBalance").physics
  other = physics.model.replace(opt=physics.model.opt.replace(gravity=jnp.zeros(3)))
  with pytest.raises(ConfigError, match="randomised arrays of a model, and its `opt` is none"):
    physics.forward(other, physics.make())


@pytest.mark.slow
def test_a_task_sees_what_c_mujoco_simulates() -> None:
  size = {"vision.width": 24, "vision.height": 24, "vision.frames": 1}
  load = lambda: registry.load("CartpoleBalanceVision", overrides=size)
  seen, dark = {}, {}
  for name, env in {"c": on_c_physics(load()), "warp": load()}.items():
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    step = jax.jit(env.step)
    states = [state, *(state := step(state, jnp.ones(1)) for _ in range(10))]
    dark[name] = env.reset(jax.random.PRNGKey(0), env.mjx_model.replace(mat_rgba=0.5 * env.mjx_model.mat_rgba)).obs
    seen[name] = np.stack([state.obs["pixels/fixed"] for state in states]).astype(float)
  np.testing.assert_array_equal(seen["c"][0], seen["warp"][0])
  np.testing.assert_array_equal(dark["c"]["pixels/fixed"], dark["warp"]["pixels/fixed"])
  assert dark["c"]["pixels/fixed"].mean() < 0.8 * seen["c"][0].mean()
  assert (seen["c"][-1] != seen["c"][0]).sum() > 10  # the cart drives off
  assert (np.abs(seen["c"] - seen["warp"]) > 2).mean() < 0.01  # but for pixels on an edge
