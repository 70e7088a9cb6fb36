"""What `policy.yaml` says of tasks, against their models and their own functions (nothing is compiled)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import mujoco
import pytest
import yaml

from playground import registry
from playground.deploy.contract import check_contract, describe_policy, read_contract
from playground.envs.base import State
from playground.errors import CheckpointError
from playground.files import plain
from playground.mdp.terms import registered
from playground.text import first_docstring_line
from tests.aliases import LAUGHS


def contract(
  task: str,
  size: int,
  overrides: Mapping[str, Any] | None = None,
  info: Mapping[str, Any] | None = None,
  images: Mapping[str, tuple[int, ...]] | None = None,
) -> dict[str, Any]:
  env = registry.load(task, overrides=overrides)
  zero = jnp.zeros(())
  state = State(env.physics.make(), {"state": jnp.zeros(size)}, zero, zero, {}, dict(info or {}))
  inputs = {**(images or {}), **({"state": (size,)} if size else {})}
  written = describe_policy(env, plain(env.config), task, {"run": "a"}, inputs, state)
  assert yaml.safe_load(yaml.safe_dump(written)) == written
  return written


def test_the_law_of_an_action_does_not_depend_on_where_the_joints_are() -> None:
  """At `qpos0` the Go1's knees are straight, beyond their range."""
  law = contract("Go1Getup", 42, {"clip_targets": True})["action"]
  assert (law["law"], law["base"]) == ("ctrl = base + scale * action", "joint_pos")


def test_a_joystick_policy() -> None:
  overrides = {
    "clip_targets": True,
    "noise_level": 0.5,
    "observations.state.gyro": {"noise": {"uniform": 0.2}, "scale": 0.25},
    "observations.state.joint_vel.delay": [0, 2],
    "observations.state.past": {"func": "joint_pos_rel", "history": 2, "noise": {"same_as": "joint_pos_rel"}},
  }
  said = contract("Go1JoystickFlatTerrain", 72, overrides)
  observation = {term["name"]: term for term in said["observation"]}
  assert [(name, term["start"], term["size"]) for name, term in observation.items()] == [
    *(("linvel", 0, 3), ("gyro", 3, 3), ("gravity", 6, 3), ("joint_pos_rel", 9, 12), ("joint_vel", 21, 12)),
    *(("last_act", 33, 12), ("command", 45, 3), ("past", 48, 24)),
  ]
  assert observation["gyro"] == {
    "name": "gyro", "start": 3, "size": 3, "scale": 0.25, "noise": {"uniform": 0.1},
    "what": "Angular velocity of the base in its own frame, rad/s [3].",
  }  # fmt: skip
  assert observation["joint_vel"]["delay"] == [0, 2]
  assert (observation["past"]["history"], observation["past"]["noise"]) == (2, {"same_as": "joint_pos_rel"})
  assert said["policy"]["inputs"] == [{"name": "obs", "entry": "state", "shape": [1, 72], "type": "float32"}]
  assert (said["rate_hz"], said["control_hz"], said["frames"]) == (50, 50, 1)
  assert (said["cameras"], said["delays"]) == ([], {})
  law = said["action"]
  assert (law["law"], law["base"], law["scale"]) == ("ctrl = base + scale * action", "default_pose", 0.5)
  assert law["clipped_to"]["lower"][0] == pytest.approx(-0.863)
  assert law["base_value"] == pytest.approx([row["default"] for row in said["actuators"]])
  first = said["actuators"][0]
  assert (first["joint"], first["kp"], first["damping"], first["force_limit"]) == ("FR_hip_joint", 35, 0.5, 23.7)
  assert (first["default"], first["default_of"]) == (0.1, "keyframe home")
  assert [row["joint"] for row in said["actuators"]] == said["joints"][1:]
  assert said["command"]["max"] == [1.5, 0.8, 1.2] and "gait" not in said
  check_contract(said | {"origin": {"steps": 1, "evaluation": {}}})


def test_a_filtered_actuator_has_its_time_constant() -> None:
  env = registry.load("Go1JoystickFlatTerrain")
  env.mj_model.actuator_dyntype[1], env.mj_model.actuator_dynprm[1, 0] = mujoco.mjtDyn.mjDYN_FILTEREXACT, 0.05
  zero = jnp.zeros(())
  state = State(env.physics.make(), {}, zero, zero, {}, {})
  plain_one, filtered, *_ = describe_policy(env, plain(env.config), "T", {}, {"state": (48,)}, state)["actuators"]
  assert filtered["time_constant"] == 0.05 and "time_constant" not in plain_one


def test_a_command_may_leave_an_axis_out() -> None:
  config = registry.config("H1InplaceGaitTracking")
  size = registry.build(config).observation_size
  said = contract("H1InplaceGaitTracking", size["state"][0] if isinstance(size, dict) else size)
  assert said["command"]["max"] == [0, 0, 0]
  check_contract(said | {"origin": {"steps": 1, "evaluation": {}}})
  said["command"] = {"max": [1, 0, 1], "min": [0, 0.1, -1]}
  with pytest.raises(CheckpointError, match="must not have its minimum above its maximum"):
    check_contract(said | {"origin": {"steps": 1, "evaluation": {}}})


def test_frames_and_a_gait() -> None:
  said = contract("G1JoystickFlatTerrain", 206, {"observation_frames": 2})
  last = said["observation"][-1]
  assert (last["name"], last["start"], last["size"], last["what"][:15]) == ("past_frames", 103, 103, "All terms above")
  assert (said["frames"], said["gait"]["modes"]) == (2, ["walk"])


def test_a_policy_that_reads_everything() -> None:
  overrides = {"observations.state.gyro": {"noise": {"uniform": 0.2}, "history": 3}}
  env = registry.load("Go1JoystickFlatTerrain", overrides=overrides)
  zero = jnp.zeros(())
  state = State(env.physics.make(), {}, zero, zero, {}, {})
  said = describe_policy(env, plain(env.config), "T", {}, {"privileged_state": (129,)}, state)
  rows = [(row["name"], row["start"], row["size"]) for row in said["observation"]]
  assert rows[:3] == [("linvel", 0, 3), ("gyro", 3, 9), ("gravity", 12, 3)]
  assert rows[6:9] == [("command", 51, 3), ("gyro", 54, 3), ("accelerometer", 57, 3)]
  assert all(row["what"] for row in said["observation"])
  noisy, exact = (row for row in said["observation"] if row["name"] == "gyro")
  assert (noisy["noise"], noisy["history"], "noise" in exact) == ({"uniform": 0.2}, 3, False)


def test_a_command_by_another_name_and_repeated_actions() -> None:
  config = registry.config("Go1JoystickFlatTerrain").commands.velocity.to_dict()
  overrides = {"commands": {"velocity": None, "walk": {**config, "func": "uniform_velocity"}}, "action_repeat": 2}
  said = contract("Go1JoystickFlatTerrain", 48, overrides)
  assert said["command"]["max"] == [1.5, 0.8, 1.2]
  assert (said["rate_hz"], said["control_hz"]) == (25, 50)


def test_an_arm_begins_within_the_limits_of_its_joints() -> None:
  elbow = contract("PandaOpenCabinet", 55)["actuators"][3]
  assert (elbow["joint"], elbow["default_of"]) == ("joint4", "keyframe upright")
  assert elbow["default"] == pytest.approx(-0.0698)


@pytest.mark.parametrize("kind", ["observations", "rewards", "terminations", "commands", "events"])
def test_each_registered_term_is_explained(kind: str) -> None:
  assert [name for name, func in registered(kind).items() if not first_docstring_line(func)] == []


def test_targets_that_actions_move() -> None:
  said = contract("PandaPickCube", 66)
  assert (said["action"]["base"], said["action"]["scale"]) == ("last_target", said["env"]["action_scale"])
  assert len(said["action"]["clipped_to"]["upper"]) == 8


def test_delays_and_an_action_of_its_own() -> None:
  env = registry.load("PandaRobotiqPushCube")
  info = {"action_history": jnp.zeros((4, env.action_size)), "action_delay": jnp.zeros((), jnp.int32)}
  said = contract("PandaRobotiqPushCube", 48, info=info)
  assert said["delays"] == {"action_delay": [1, 3], "observation_delay": [6, 12]}
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
  assert [term["name"] for term in said["observation"]] == ["cart_position", "pole_cos", "pole_sin", "velocity"]


def test_a_file_of_endless_aliases_is_no_contract(tmp_path: Path) -> None:
  (tmp_path / "policy.yaml").write_text(LAUGHS)
  assert read_contract(tmp_path / "policy.yaml") is None
