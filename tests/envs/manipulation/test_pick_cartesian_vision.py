"""The hand that picks up by what it sees: what counts as success, and what is hidden. Without physics or pictures."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.envs.golden import golden, load_task

UNSEEN = {"vision.enable": False, "impl": "jax"}


def build(parity: bool) -> Any:
  env = load_task("PandaPickCubeCartesianVision", {**UNSEEN, "parity": parity})
  env.physics.forward = lambda model, data: data
  return env


@pytest.fixture(scope="module")
def task() -> Any:
  return build(False)


@pytest.mark.parametrize(("place", "success"), [((0.6, 0.1, 0.16), 1), ((0.6, 0.1, 0.24), 1), ((0.63, 0, 0.14), 0)])
def test_success_is_a_height(task: Any, place: tuple[float, ...], success: int) -> None:
  state = jax.tree.map(lambda x: x[4], golden("PandaPickCubeCartesian").states)
  data = state.data.replace(xpos=state.data.xpos.at[task.mj_model.body("box").id].set(jnp.array(place)))
  after = jax.jit(task.evaluate)(data, state.info, jnp.zeros(3))
  assert after.metrics["success"] == success == after.done
  np.testing.assert_allclose(after.metrics["reward/success"], 2.0 * success)
  assert {"reward/lifted", "reward/box_target"} < set(after.metrics)
  assert not {"reward/action_rate", "reward/no_solution"} & set(after.metrics)


def test_nobody_sees_the_target(task: Any) -> None:
  target = task.mj_model.body("mocap_target")
  assert task.mj_model.geom_rgba[target.geomadr[0], 3] == 0
  np.testing.assert_allclose(task.reset(jax.random.PRNGKey(0)).data.mocap_pos[0, 2], 0.2)


def test_parity_keeps_the_target_in_the_robots_base(task: Any) -> None:
  parity = build(True)
  np.testing.assert_array_equal(parity.reset(jax.random.PRNGKey(0)).data.mocap_pos, np.zeros((1, 3)))
  assert parity.mj_model.geom_rgba[parity.mj_model.body("mocap_target").geomadr[0], 3] > 0
  assert parity.mj_model.light("top").mode != task.mj_model.light("top").mode
