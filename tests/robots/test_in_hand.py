"""Hands with a cube: what holds at the keyframe, and what the scene's masks let touch."""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from playground.errors import ConfigError, UnknownNameError
from playground.robots.scene import ROBOTS
from tests.robots.figures import HANDS, in_hand_scene

LEAP = ROBOTS / "leap_hand/right_hand.xml"


@pytest.fixture(params=HANDS, scope="module")
def model(request: pytest.FixtureRequest) -> mujoco.MjModel:
  return in_hand_scene(request.param).compile()


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


def test_a_hand_of_a_users_file(tmp_path: Path) -> None:
  """Its YAML says which cube it gets and where that begins."""
  mine = tmp_path / "mine.xml"
  mine.write_text(LEAP.read_text())
  cube = {"half_size": 0.03, "mass": 0.05, "start": [0.12, 0.01, 0.06]}
  model = in_hand_scene("leap_hand", mjcf=str(mine), cube=cube).compile()
  np.testing.assert_allclose(model.key("home").qpos[-7:-4], cube["start"])
  np.testing.assert_allclose([model.body("cube").mass[0], *model.geom("cube").size], [0.05, 0.03, 0.03, 0.03])
  drawn = model.geom_pos[model.geom_bodyid == model.body("cube").id]
  np.testing.assert_allclose(np.abs(drawn).max(), 0.99 * 0.03)


def test_a_hand_with_a_name_of_the_scene(tmp_path: Path) -> None:
  mine = tmp_path / "mine.xml"
  mine.write_text(LEAP.read_text().replace("</mujoco>", '<sensor><clock name="palm_position"/></sensor></mujoco>'))
  with pytest.raises(ConfigError, match=r"clashes with what the scene adds to it: .*repeated name 'palm_position'"):
    in_hand_scene("leap_hand", mjcf=str(mine))


@pytest.mark.parametrize(
  ("changes", "missing", "message"),
  [
    ({"mjcf": "leap_hnad"}, "", "env.robot.mjcf=leap_hnad does not exist"),
    ({}, "grasp_site", "sites of env.robot.mjcf=.*: 'grasp_site' is unknown"),
    ({}, "home", "keyframes of env.robot.mjcf=.*: 'home' is unknown"),
    ({"cube": {"half_size": 0.03, "mass": 0.05, "start": [0.1, 0.0]}}, "", r"cube.start=\[0.1, 0.0\] must be three"),
  ],
)
def test_bad_hands(tmp_path: Path, changes: dict[str, Any], missing: str, message: str) -> None:
  mine = tmp_path / "mine.xml"
  text = LEAP.read_text()
  mine.write_text(text.replace(f'name="{missing}"', 'name="other"') if missing else text)
  with pytest.raises((UnknownNameError, ConfigError), match=message):
    in_hand_scene("leap_hand", **({"mjcf": str(mine)} | changes))
