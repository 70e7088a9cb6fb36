"""The joystick task on Barkour, without compiling physics: directions, limits, pushes, and stacked observations."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from playground.envs.base import State
from playground.envs.wrappers import wrap_for_training
from tests.envs.golden import load_task, recorded

TASK = "BarkourJoystick"
FRAME = 31


@pytest.fixture(scope="module")
def barkour() -> Any:
  return load_task(TASK)


def evaluate(env: Any, state: State, **data: Any) -> State:
  return env.post_step(state.data.replace(**data), state.info, jnp.zeros(12))


@pytest.mark.parametrize(("task", "forward"), [(TASK, 1.0), (f"v020/{TASK}", -1.0)])
def test_ahead_is_where_the_head_is(task: str, forward: float) -> None:
  env = load_task(task)
  data = mujoco.MjData(env.mj_model)
  mujoco.mj_resetDataKeyframe(env.mj_model, data, 0)
  data.qvel[0] = 1.0  # to the front feet
  mujoco.mj_forward(env.mj_model, data)
  front, hind = (data.site(f"foot_{end}_left").xpos[0] for end in ("front", "hind"))
  assert front > hind
  state = recorded(TASK)
  ahead = {"sensordata": jnp.array(data.sensordata, jnp.float32)}
  np.testing.assert_allclose(env.robot.sensor(state.data.replace(**ahead), "linvel"), [forward, 0, 0], atol=1e-6)


def test_targets_stay_within_the_robots_own_range(barkour: Any) -> None:
  for sign, limit in ((-1, barkour.robot.target_range[0]), (1, barkour.robot.target_range[1])):
    np.testing.assert_allclose(barkour.action_to_ctrl(recorded(TASK), jnp.full(12, sign * 20.0)), limit)
  assert (barkour.robot.target_range[1] < barkour.mj_model.actuator_ctrlrange[:, 1]).all()


def test_endings_all_of_which_cost(barkour: Any) -> None:
  state = recorded(TASK)
  assert evaluate(barkour, state).done == 0
  beyond = state.data.qpos.at[7].set(barkour.robot.target_range[1, 0] + 0.01)  # the joint itself could go on
  low = state.data.site_xpos.at[barkour.robot.base_site, 2].set(0.17)
  for name, data in (("joint_pos_out_of_target_range", {"qpos": beyond}), ("base_height_below", {"site_xpos": low})):
    after = evaluate(barkour, state, **data)
    ended = {key for key, value in after.metrics.items() if key.startswith("termination/") and value}
    assert ended == {f"termination/{name}"}
    assert (after.done, after.metrics["reward/is_terminated"]) == (1, -1)


def test_it_is_pushed(barkour: Any) -> None:
  push = {"push_interval": jnp.array(50), "push_duration": jnp.array(4), "push_direction": jnp.array([0.0, 1.0, 0.0])}
  push |= {"push_velocity": jnp.array(1.0), "push_mass": jnp.array(14.5), "push_step": jnp.array(102)}
  state, peak = recorded(TASK, **push), 0.5 * 14.5 * 1.0 / 0.08
  pushed = barkour.pre_step(state).data.xfrc_applied[barkour.robot.root, :3]
  np.testing.assert_allclose(pushed, [0, peak, 0], rtol=1e-5)

  mouse = state.data.xfrc_applied.at[barkour.robot.root, 2].set(7.0)
  both = barkour.pre_step(state.replace(data=state.data.replace(xfrc_applied=mouse)))
  np.testing.assert_allclose(both.data.xfrc_applied[barkour.robot.root, :3], [0, peak, 7], rtol=1e-5)
  assert not evaluate(barkour, both).data.xfrc_applied.any(), "forces act in one step"


def test_observations_never_mix_episodes(barkour: Any, monkeypatch: pytest.MonkeyPatch) -> None:
  step = lambda model, data, ctrl, substeps: data.replace(ctrl=ctrl, qpos=data.qpos.at[7].add(0.01))
  monkeypatch.setattr(barkour.physics, "forward", lambda model, data: data)
  monkeypatch.setattr(barkour.physics, "step", step)
  monkeypatch.setattr(barkour, "episode_length", 3)
  monkeypatch.setattr(barkour.terminations, "groups", {})
  env = wrap_for_training(barkour)
  state = env.reset(jax.random.split(jax.random.PRNGKey(0), 2))
  first, seen, step_all = state.obs, [], jax.jit(env.step)
  for _ in range(5):
    state = step_all(state, jnp.zeros((2, 12)))
    seen.append(np.asarray(state.obs)[0].reshape(15, FRAME))
  assert [int((frames != 0).any(1).sum()) for frames in seen] == [2, 3, 1, 2, 3]  # the third step ends an episode
  np.testing.assert_array_equal(seen[2].ravel(), np.asarray(first)[0])
  np.testing.assert_array_equal(seen[4][1:], seen[3][:-1])
  np.testing.assert_array_equal(seen[3][1], seen[2][0])
