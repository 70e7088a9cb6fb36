"""The hand that picks up by what it sees: what counts as success, and what is hidden. Without physics or images."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.envs.golden import recorded, without_physics

TASK = "PandaPickCubeCartesianVision"
UNSEEN: dict[str, Any] = {"vision.enable": False, "impl": "jax"}


@pytest.fixture(scope="module")
def task() -> Any:
  return without_physics(TASK, **UNSEEN)


@pytest.mark.parametrize(("place", "success"), [((0.6, 0.1, 0.16), 1), ((0.6, 0.1, 0.24), 1), ((0.63, 0, 0.14), 0)])
def test_success_is_a_height(task: Any, place: tuple[float, ...], success: int) -> None:
  state = recorded("PandaPickCubeCartesian")
  data = state.data.replace(xpos=state.data.xpos.at[task.mj_model.body("box").id].set(jnp.array(place)))
  after = task.post_step(data, state.info, jnp.zeros(3))
  assert after.metrics["success"] == success == after.done
  np.testing.assert_allclose(after.metrics["reward/object_at_goal"], 2.0 * success)
  assert {"reward/object_lifted", "reward/object_goal_distance_tanh"} < set(after.metrics)
  assert not {"reward/action_rate_norm", "reward/no_ik_solution"} & set(after.metrics)


def test_nobody_sees_the_target(task: Any) -> None:
  target = task.mj_model.body("mocap_target")
  assert task.mj_model.geom_rgba[target.geomadr[0], 3] == 0
  np.testing.assert_allclose(task.reset(jax.random.PRNGKey(0)).data.mocap_pos[0, 2], 0.2)


def test_0_2_0_keeps_the_target_in_the_robots_base(task: Any) -> None:
  old = without_physics(f"v020/{TASK}", **UNSEEN)
  np.testing.assert_array_equal(old.reset(jax.random.PRNGKey(0)).data.mocap_pos, np.zeros((1, 3)))
  assert old.mj_model.geom_rgba[old.mj_model.body("mocap_target").geomadr[0], 3] > 0
  assert old.mj_model.light("top").mode != task.mj_model.light("top").mode
