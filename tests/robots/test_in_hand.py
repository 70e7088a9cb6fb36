"""Hands with a cube: what holds at the keyframe, and what the scene's masks let touch."""

import mujoco
import pytest

from playground.errors import UnknownNameError
from playground.robots.in_hand import CUBES, build_in_hand_scene


@pytest.fixture(params=CUBES, scope="module")
def model(request: pytest.FixtureRequest) -> mujoco.MjModel:
  return build_in_hand_scene(request.param).compile()


def drop(model: mujoco.MjModel, x: float, seconds: float = 2.0) -> mujoco.MjData:
  """The data after the cube fell from above the given place, the hand in its keyframe."""
  data = mujoco.MjData(model)
  mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
  data.joint("cube_freejoint").qpos[0] = x
  for _ in range(round(seconds / model.opt.timestep)):
    mujoco.mj_step(model, data)
  return data


def test_hand_holds_the_cube(model: mujoco.MjModel) -> None:
  data = drop(model, x=float(model.key("home").qpos[16]))
  assert data.body("cube").xpos[2] > -0.05  # where tasks end the episode
  assert abs(data.qvel).max() < 0.05


def test_cube_beside_the_hand_lands_on_the_floor(model: mujoco.MjModel) -> None:
  data = drop(model, x=0.6)
  half_size = model.geom("cube").size[0]
  assert -0.25 + 0.9 * half_size < data.body("cube").xpos[2] < -0.25 + 1.8 * half_size


def test_unknown_hand() -> None:
  with pytest.raises(UnknownNameError, match="leap_hand"):
    build_in_hand_scene("leap_hnad")
