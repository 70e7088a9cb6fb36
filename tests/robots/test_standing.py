"""Every robot in its keyframe: it stands, and its sensors say so (C MuJoCo)."""

import dataclasses
from typing import Any

import mujoco
import numpy as np
import pytest
from ml_collections import ConfigDict

from playground.mdp.legged import LeggedRobot
from playground.robots.scene import build_scene, set_gains
from tests.robots.figures import robot_config

BALANCED = ("go1", "spot", "barkour", "h1", "op3")
ROBOTS = (*BALANCED, "berkeley_humanoid", "g1", "t1", "apollo")  # the others' servos are too soft to stand for long


@dataclasses.dataclass
class Robot:
  """A robot on flat ground in its keyframe, held there by its servos."""

  config: dict[str, Any]
  model: mujoco.MjModel
  data: mujoco.MjData

  def sensor(self, key: str) -> np.ndarray:
    return self.data.sensor(self.config["sensors"][key]).data

  def contacts(self) -> list[bool]:
    return [any(self.data.sensor(name).data[0] > 0 for name in foot) for foot in self.config["foot_contact"]]

  def up(self) -> np.ndarray:
    """The world's z in the frame of the base site."""
    return self.data.site(self.config["base_site"]).xmat.reshape(3, 3)[2]


def place(name: str) -> Robot:
  config = robot_config(name)
  model = build_scene(name, floor_contacts=config["floor_contacts"]).compile()
  set_gains(model, **config["pd"])
  data = mujoco.MjData(model)
  mujoco.mj_resetDataKeyframe(model, data, model.key(config["keyframe"]).id)
  data.ctrl = data.qpos[7:]
  return Robot(config, model, data)


@pytest.fixture(params=ROBOTS)
def robot(request: pytest.FixtureRequest) -> Robot:
  return place(request.param)


@pytest.mark.parametrize("name", BALANCED)
def test_stands(name: str) -> None:
  robot = place(name)
  height = robot.data.qpos[2]
  mujoco.mj_step(robot.model, robot.data, 500)  # 2 s
  assert robot.data.qpos[2] == pytest.approx(height, rel=0.2)
  assert robot.sensor("upvector")[2] > 0.99
  assert all(robot.contacts())
  np.testing.assert_allclose(robot.sensor("accelerometer"), 9.81 * robot.up(), atol=0.15)
  np.testing.assert_allclose(robot.sensor("gyro"), 0, atol=0.05)


def test_feet_touch_the_ground_soon(robot: Robot) -> None:
  mujoco.mj_step(robot.model, robot.data, 40)  # 0.1 to 0.2 s
  assert all(robot.contacts())
  assert robot.sensor("upvector")[2] > 0.98


def test_falls_freely(robot: Robot) -> None:
  robot.data.qpos[2] += 1.0
  mujoco.mj_forward(robot.model, robot.data)
  assert not any(robot.contacts())
  np.testing.assert_allclose(robot.sensor("accelerometer"), 0, atol=1e-6)


def test_moves_forward_and_turns_left(robot: Robot) -> None:
  """Velocities at the base are in the robot's own frame, +x ahead; those of the feet in the world's."""
  robot.data.qpos[3:7] = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]  # it faces the world's +y
  robot.data.qvel[1] = 1.0
  mujoco.mj_forward(robot.model, robot.data)
  np.testing.assert_allclose(robot.sensor("linvel"), [1, 0, 0], atol=1e-6)
  np.testing.assert_allclose(robot.sensor("global_linvel"), [0, 1, 0], atol=1e-6)
  for name in robot.config["foot_linvel"]:
    np.testing.assert_allclose(robot.data.sensor(name).data, [0, 1, 0], atol=1e-6)
  robot.data.qvel[:6] = [0, 0, 0, 0, 0, 1]
  mujoco.mj_forward(robot.model, robot.data)
  np.testing.assert_allclose(robot.sensor("gyro"), [0, 0, 1], atol=1e-6)


def test_barkour_looks_where_its_commands_lead() -> None:
  """0.2.0 reads sensors that are turned by 180 degrees about z (`v020/BarkourJoystick`); ours are not."""
  robot = place("barkour")
  robot.data.qvel[0] = 1.0
  mujoco.mj_forward(robot.model, robot.data)
  head = robot.data.site("head_camera_frame").xpos - robot.data.body("torso").xpos
  assert head[0] > 0.2
  legged = LeggedRobot(robot.model, ConfigDict(robot.config))
  data: Any = robot.data
  np.testing.assert_allclose(legged.sensor(data, "linvel"), [1.0, 0, 0], atol=1e-6)
  forward = robot.data.site_xmat[legged.base_site].reshape(3, 3)[:, 0]
  np.testing.assert_allclose(forward, [1, 0, 0], atol=1e-6)


@pytest.mark.parametrize(("name", "limits"), [("op3", [-3.141592, 3.141592]), ("h1", [-0.43, 0.43])])
def test_joint_range(name: str, limits: list[float]) -> None:
  """The OP3's joints have no limits: those of its servos' targets count."""
  robot = place(name)
  lower, upper = LeggedRobot(robot.model, ConfigDict(robot.config)).joint_range
  np.testing.assert_allclose([lower[0], upper[0]], limits, rtol=1e-6)
  assert (lower < upper).all()
