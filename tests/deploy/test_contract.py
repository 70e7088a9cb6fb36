"""What `policy.yaml` says of tasks, against their models and their own functions (nothing is compiled)."""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import pytest
import yaml

from playground import registry
from playground.deploy.contract import describe_policy
from playground.deploy.parts import describe_part
from playground.envs.base import State
from playground.runs.files import plain


def contract(
  task: str,
  size: int,
  overrides: Mapping[str, Any] | None = None,
  info: Mapping[str, Any] | None = None,
  pictures: Mapping[str, tuple[int, ...]] | None = None,
) -> dict[str, Any]:
  env = registry.load(task, overrides=overrides)
  zero = jnp.zeros(())
  state = State(env.physics.make(), {"state": jnp.zeros(size)}, zero, zero, {}, dict(info or {}))
  inputs = {**(pictures or {}), **({"state": (size,)} if size else {})}
  written = describe_policy(env, plain(env.config), task, {"run": "a"}, inputs, state)
  assert yaml.safe_load(yaml.safe_dump(written)) == written
  return written


def test_a_joystick_policy() -> None:
  overrides = {"clip_targets": True, "obs_scales": {"gyro": 0.25}, "history": {"joint_pos": 2}}
  parts = ["linvel", "gyro", "gravity", "joint_pos", "joint_vel", "last_act", "command", "joint_pos_history"]
  said = contract("Go1JoystickFlatTerrain", 72, overrides | {"obs.state": parts})
  observation = said["observation"]
  assert [(part["part"], part["start"], part["size"]) for part in observation] == [
    *(("linvel", 0, 3), ("gyro", 3, 3), ("gravity", 6, 3), ("joint_pos", 9, 12), ("joint_vel", 21, 12)),
    *(("last_act", 33, 12), ("command", 45, 3), ("joint_pos_history", 48, 24)),
  ]
  assert (observation[1]["scale"], observation[1]["noise"]) == (0.25, 0.2)
  assert observation[0]["what"] == "Linear velocity of the base in its own frame, m/s [3]."
  assert said["policy"]["inputs"] == [{"name": "obs", "entry": "state", "shape": [1, 72], "type": "float32"}]
  assert (said["rate_hz"], said["history"], said["frames"], said["cameras"]) == (50, {"joint_pos": 2}, 1, [])
  law = said["action"]
  assert (law["law"], law["base"], law["scale"]) == ("ctrl = base + scale * action", "default_pose", 0.5)
  assert law["clipped_to"]["lower"][0] == pytest.approx(-0.863)
  assert law["base_value"] == pytest.approx([row["default"] for row in said["actuators"]])
  first = said["actuators"][0]
  assert (first["joint"], first["kp"], first["damping"], first["force_limit"]) == ("FR_hip_joint", 35, 0.5, 23.7)
  assert (first["default"], first["default_of"]) == (0.1, "keyframe home")
  assert [row["joint"] for row in said["actuators"]] == said["joints"][1:]
  assert said["command"]["max"] == [1.5, 0.8, 1.2]


@pytest.mark.parametrize(
  "task",
  ["Op3Joystick", "PandaPickCubeCartesian", "PandaRobotiqPushCube", "AlohaHandOver", "AlohaSinglePegInsertion"],
)
def test_each_part_of_a_robots_observation_is_explained(task: str) -> None:
  env = registry.load(task)
  actor = env.observation_parts["state"]
  assert actor and [name for name in actor if not describe_part(env, name.removesuffix("_history"))] == []


def test_targets_that_actions_move() -> None:
  said = contract("PandaPickCube", 66)
  assert (said["action"]["base"], said["action"]["scale"]) == ("last_target", said["env"]["action_scale"])
  assert len(said["action"]["clipped_to"]["upper"]) == 8


def test_delays_and_a_control_of_its_own() -> None:
  env = registry.load("PandaRobotiqPushCube")
  history = jnp.zeros((4, env.action_size))
  info = {"action_history": history, "action_delay": jnp.zeros((), jnp.int32)}
  said = contract("PandaRobotiqPushCube", 48, info=info)
  delays = {f"delays.{name}": steps for name, steps in said["env"]["delays"].items()}
  assert said["delays"] == delays and delays["delays.obs_max"] == 12
  assert (said["action"]["law"], said["rate_hz"]) == (None, 50)  # 200 Hz, each action four times


def test_forces() -> None:
  said = contract("CartpoleBalance", 5)
  assert said["action"] == {
    "class": "playground.envs.dm_control.cartpole:Cartpole", "law": "ctrl = base + scale * action", "base": "zero",
    "scale": 1.0, "base_value": [0.0],
  }  # fmt: skip
  assert said["actuators"][0]["gain"] == 1.0 and said["actuators"][0]["gear"] == 10.0
  assert "kp" not in said["actuators"][0] and "command" not in said


def test_a_camera() -> None:
  said = contract("CartpoleBalanceVision", 0, {"vision.brightness": [0.5, 1.0]}, None, {"pixels/fixed": (64, 64, 3)})
  (camera,) = said["cameras"]
  assert camera.pop("quat") == pytest.approx([0.5**0.5, 0.5**0.5, 0, 0])
  assert camera == {
    "entry": "pixels/fixed", "camera": "fixed", "channels": ["gray[-2]", "gray[-1]", "gray[0]"],
    "values": "the mean of red, green and blue, 0 to 255", "body": "world", "mode": "fixed", "pos": [0, -4, 1],
    "fovy": 45, "width": 64, "height": 64, "frames": 3, "image": "gray", "brightness": [0.5, 1.0], "shadows": False,
    "textures": False,
  }  # fmt: skip
  assert said["observation"] == [] and said["policy"]["inputs"] == [
    {"name": "obs", "entry": "pixels/fixed", "shape": [1, 64, 64, 3], "type": "uint8"}
  ]


def test_a_camera_that_sees_depth_beside_a_vector() -> None:
  vision = {"enable": True, "camera": "lookatcart", "image": "depth", "farthest": 3.0}
  overrides = {f"vision.{key}": value for key, value in vision.items()}
  said = contract("CartpoleBalance", 5, overrides, None, {"pixels/lookatcart": (64, 64, 1)})
  (camera,) = said["cameras"]
  assert (camera["body"], camera["mode"], camera["channels"]) == ("world", "targetbody", ["depth[0]"])
  assert camera["values"].startswith("255 * min(1, distance / 3.0 m)")
  assert [(row["name"], row["shape"]) for row in said["policy"]["inputs"]] == [
    ("pixels_lookatcart", [1, 64, 64, 1]), ("obs", [1, 5]),
  ]  # fmt: skip
  assert [part["part"] for part in said["observation"]] == ["cart_position", "pole_cos", "pole_sin", "velocity"]
