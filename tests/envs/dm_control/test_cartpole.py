"""Cartpole: the model's figures, rewards by hand, and what differs from 0.2.0."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from playground.envs.dm_control.cartpole import Cartpole
from tests.envs.golden import load_task

FIGURES = json.loads((Path(__file__).parents[1] / "figures" / "cartpole.json").read_text())


@pytest.fixture(scope="module")
def balance() -> Cartpole:
  return load_task("CartpoleBalance")


@pytest.mark.parametrize("kind", ["bodies", "joints", "collision_geoms", "cameras", "actuators"])
def test_model_has_the_figures(balance: Cartpole, kind: str) -> None:
  model = balance.mj_model
  accessor = {"bodies": model.body, "joints": model.joint, "actuators": model.actuator, "cameras": model.camera}
  fields = {
    "bodies": ("pos", "quat", "mass", "inertia", "ipos"),
    "joints": ("pos", "axis", "range", "damping", "armature", "frictionloss", "stiffness"),
    "collision_geoms": ("size", "pos", "friction", "solref", "solimp", "contype", "conaffinity", "condim"),
    "cameras": ("pos", "fovy"),
    "actuators": ("gear", "ctrlrange"),
  }[kind]
  names = {"damping": "dof_damping", "armature": "dof_armature", "frictionloss": "dof_frictionloss"}
  for figure in FIGURES[kind]:
    named = accessor.get(kind, model.geom)(figure["name"])
    assert named.id == figure["id"]
    for field in fields:
      ours = getattr(model, names[field])[model.jnt_dofadr[named.id]] if field in names else getattr(named, field)
      size = None if np.ndim(figure[field]) == 0 else len(figure[field])
      expected = np.asarray(figure[field], float).ravel()
      np.testing.assert_allclose(np.ravel(ours)[:size], expected, atol=1e-7, err_msg=f"{figure['name']}.{field}")


def test_options_have_the_figures(balance: Cartpole) -> None:
  option = balance.mj_model.opt
  figure = FIGURES["option"]
  assert (option.iterations, option.ls_iterations) == (figure["iterations"], figure["ls_iterations"])
  assert option.integrator == mujoco.mjtIntegrator.mjINT_EULER
  disabled = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_EULERDAMP
  assert option.disableflags == disabled
  np.testing.assert_allclose(balance.mj_model.body_mass.sum(), FIGURES["total_mass"])


@pytest.mark.parametrize("name", ["CartpoleBalance", "CartpoleBalanceSparse"])
def test_rewards_by_hand(name: str) -> None:
  env = load_task(name)
  at = lambda cart, pole, hinge_vel: env.physics.forward(
    env.mjx_model, env.physics.make(qpos=jnp.array([cart, pole]), qvel=jnp.array([0.0, hinge_vel]))
  )
  evaluate = jax.jit(lambda cart, pole, vel, action: env.evaluate(at(cart, pole, vel), {}, action).reward)
  upright = evaluate(0.0, 0.0, 0.0, jnp.zeros(1))
  np.testing.assert_allclose(upright, 1.0, atol=1e-6)
  off = evaluate(2.0, np.pi / 2, 5.0, jnp.ones(1))  # every margin reached: tolerance is 0.1, 0 for the action
  np.testing.assert_allclose(off, 0.0 if env.config.sparse else 0.5 * 0.55 * 0.8 * 0.55, atol=1e-6)


def test_batched_step(balance: Cartpole) -> None:
  state = jax.jit(jax.vmap(balance.reset))(jax.random.split(jax.random.PRNGKey(1), 4))
  after = jax.jit(jax.vmap(balance.step))(state, jnp.ones((4, 1)))
  assert balance.observation_size == 5 and balance.action_size == 1
  assert after.obs.shape == (4, 5)  # pyright: ignore[reportAttributeAccessIssue]
  assert jax.tree.structure(after) == jax.tree.structure(state)
  assert jax.tree.map(jax.typeof, after) == jax.tree.map(jax.typeof, state)  # weak types included
  assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(after))
  assert set(after.metrics) == {f"reward/{n}" for n in ("upright", "centered", "small_control", "small_velocity")}


def test_sparse_metrics_and_types() -> None:
  env = load_task("CartpoleSwingupSparse")
  state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
  after = jax.eval_shape(env.step, state, jax.ShapeDtypeStruct((1,), jnp.float32))
  assert set(state.metrics) == {"reward/cart_in_bounds", "reward/angle_in_bounds"}
  assert jax.tree.leaves(after) == jax.tree.leaves(state)


def test_numbers_that_are_not_finite_end_the_episode(balance: Cartpole) -> None:
  state = jax.jit(balance.reset)(jax.random.PRNGKey(0))
  broken = state.data.replace(qvel=state.data.qvel.at[0].set(jnp.nan))
  assert balance.evaluate(broken, {}, jnp.zeros(1)).done == 1
  assert balance.evaluate(state.data, {}, jnp.zeros(1)).done == 0


@pytest.mark.parametrize("parity", [False, True])
def test_initial_velocity_is_independent_of_the_position(parity: bool) -> None:
  env = load_task("CartpoleSwingup", {"parity": parity})
  start = lambda key: (lambda data: (data.qpos, data.qvel))(env.reset(key).data)
  qpos, qvel = jax.jit(jax.vmap(start))(jax.random.split(jax.random.PRNGKey(0), 500))
  correlation = np.corrcoef(qpos[:, 0], qvel[:, 0])[0, 1]
  assert (correlation > 0.99) if parity else (abs(correlation) < 0.15)
  np.testing.assert_allclose([qpos[:, 1].mean(), qpos[:, 1].std()], [np.pi, 0.01], atol=2e-3)
