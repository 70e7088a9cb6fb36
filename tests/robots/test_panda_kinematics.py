"""The Panda's kinematics in closed form: forward as MuJoCo has it, inverse as the inverse of that."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from playground.robots.panda.kinematics import (
  FLANGE,
  JOINT_RANGE,
  forward_kinematics,
  inverse_kinematics,
  within_limits,
)
from playground.robots.tabletop import build_tabletop

HOME = jnp.array([-0.00002, 0.47804, -0.00055, -1.81309, -0.00161, 2.34597, 0.78501])
forward = jax.jit(jax.vmap(forward_kinematics))
inverse = jax.jit(jax.vmap(inverse_kinematics))


@pytest.fixture(scope="module")
def angles() -> jax.Array:
  """Joint angles all over the workspace, shape [4096, 7]."""
  return jax.random.uniform(jax.random.PRNGKey(0), (4096, 7), minval=JOINT_RANGE[0], maxval=JOINT_RANGE[1])


def test_joint_range_is_the_models() -> None:
  model = build_tabletop("panda_single_cube").compile()
  np.testing.assert_allclose(model.jnt_range[:7].T, JOINT_RANGE, rtol=1e-6)


def test_forward_is_mujocos(angles: jax.Array) -> None:
  model = build_tabletop("panda_single_cube").compile()
  data = mujoco.MjData(model)
  site = model.site("gripper")
  tip = float(FLANGE + site.pos[2])
  for q in np.asarray(angles[:64]):
    data.qpos[:7] = q
    mujoco.mj_kinematics(model, data)
    pos, rot = forward_kinematics(jnp.array(q), tip)
    np.testing.assert_allclose(pos, data.site_xpos[site.id], atol=2e-6)
    np.testing.assert_allclose(rot, data.site_xmat[site.id].reshape(3, 3), atol=2e-6)


def test_inverse_reaches_every_pose_that_the_arm_can_have(angles: jax.Array) -> None:
  pos, rot = forward(angles)
  found = inverse(pos, rot, angles[:, 6], angles)
  assert jnp.isfinite(found).all()
  for reached, wanted in zip(forward(found), (pos, rot), strict=True):
    np.testing.assert_allclose(reached, wanted, atol=1e-4)


def test_inverse_gives_the_angles_back(angles: jax.Array) -> None:
  """But where the arm is past its stretch or near one of the borders between two solutions."""
  _, q2, _, q4, q5, _, _ = angles.T
  clear = (q4 < -0.6) & (jnp.abs(jnp.sin(q2)) > 0.05) & (jnp.abs(jnp.cos(q5)) > 0.05)
  some = angles[clear]
  assert len(some) > 3000
  found = inverse(*forward(some), some[:, 6], some)
  np.testing.assert_allclose(found, some, atol=1e-3)
  assert jax.vmap(within_limits)(found).mean() > 0.999  # all but for roundings at a limit


def test_each_of_the_four_solutions_reaches_the_pose() -> None:
  pos, rot = forward_kinematics(HOME)
  signs = jnp.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
  near = jnp.tile(HOME, (4, 1)).at[:, 1].set(signs[:, 0]).at[:, 4].set(jnp.where(signs[:, 1] > 0, 0.0, 3.0))
  tile = lambda x: jnp.tile(x, (4,) + (1,) * x.ndim)
  found = inverse(tile(pos), tile(rot), tile(HOME[6]), near)
  assert len({tuple(np.round(np.asarray(q), 2)) for q in found}) == 4
  for reached, wanted in zip(forward(found), (pos, rot), strict=True):
    np.testing.assert_allclose(reached, tile(wanted), atol=1e-5)
  np.testing.assert_array_equal(jnp.sign(found[:, 1]), signs[:, 0])
  np.testing.assert_array_equal(jnp.sign(jnp.cos(found[:, 4])), signs[:, 1])


@pytest.mark.parametrize(
  ("offset", "expected"),
  [
    ((0, 0.1, 0), (0.491352, 0.532792, -0.381792, -1.773130, 0.245567, 2.313456)),
    ((0, -0.1, -0.1), (-0.384040, 0.693370, 0.249755, -1.773763, -0.248516, 2.491448)),
    ((-0.05, 0.05, 0.15), (0.640699, 0.196223, -0.595910, -1.865951, 0.120511, 2.080889)),
  ],
)
def test_known_solutions(offset: tuple[float, ...], expected: tuple[float, ...]) -> None:
  pos, rot = forward_kinematics(HOME)
  np.testing.assert_allclose(pos, (0.66105318, -0.00051778, 0.17906836), atol=1e-6)
  found = inverse_kinematics(pos + jnp.array(offset), rot, HOME[6], HOME)
  np.testing.assert_allclose(found, np.append(expected, HOME[6]), atol=2e-6)


def test_a_vertical_upper_arm_leaves_joint_1_where_it_is() -> None:
  q = HOME.at[0].set(0.7).at[1].set(0.0).at[2].set(0.2)
  pos, rot = forward_kinematics(q)
  found = inverse_kinematics(pos, rot, q[6], q)
  assert jnp.isfinite(found).all()
  np.testing.assert_allclose(found[0] + found[2], 0.9, atol=1e-3)
  np.testing.assert_allclose(forward_kinematics(found)[0], pos, atol=1e-5)


@pytest.mark.parametrize("offset", [(0.109, 0, 0.32), (1, 0, 0)])
def test_out_of_reach_is_nan(offset: tuple[float, ...]) -> None:
  pos, rot = forward_kinematics(HOME)
  found = inverse_kinematics(pos + jnp.array(offset), rot, HOME[6], HOME)
  assert jnp.isnan(found[:6]).all()
  assert not within_limits(found)


def test_what_only_an_arm_without_limits_could_reach_is_said_so() -> None:
  pos, rot = forward_kinematics(HOME)
  pos += jnp.array((-0.66, 0, -0.08))  # inside the base
  found = inverse_kinematics(pos, rot, HOME[6], HOME)
  np.testing.assert_allclose(forward_kinematics(found)[0], pos, atol=1e-5)
  assert not within_limits(found)


def test_limits_are_told_apart() -> None:
  assert within_limits(HOME)
  assert not within_limits(HOME.at[3].set(0.0))
