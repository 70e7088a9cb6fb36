"""The joystick task on the Go1: shapes, composition by config, pushes, starts, and what it keeps account of."""

import copy
import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground import registry
from playground.config import compose
from playground.envs import wrappers
from playground.envs.base import State
from playground.envs.c_physics import on_c_physics
from playground.errors import ConfigError, UnknownNameError
from playground.mdp.context import Robot
from playground.robots.scene import find_mjcf
from tests.envs.golden import BATCH, KEYS, compiled_task, load_task, recorded

TASK = "Go1JoystickFlatTerrain"


@pytest.fixture(scope="module")
def pushed() -> Any:
  return compiled_task(TASK, {"events.push.enabled": True})


@pytest.fixture(scope="module")
def start(pushed: Any) -> State:
  return jax.vmap(pushed.reset)(KEYS)


def shapes(env: Any) -> State:
  return jax.eval_shape(env.reset, jax.random.PRNGKey(0))


def evaluate(env: Any, state: State, **data: Any) -> State:
  return env.post_step(state.data.replace(**data), state.info, jnp.zeros(env.action_size))


@pytest.mark.parametrize("task", [TASK, "BarkourJoystick", "G1JoystickFlatTerrain", "H1JoystickGaitTracking"])
def test_a_step_keeps_the_types_of_a_reset(task: str) -> None:
  """Weak types included: a loop over steps compiles once."""
  env = load_task(task)
  first = shapes(env)
  after = jax.eval_shape(env.step, first, jnp.zeros(env.action_size))
  types = lambda state: jax.tree.map(lambda x: (x.shape, x.dtype, x.weak_type), state)
  assert types(after) == types(first)


def test_batched_step(pushed: Any, start: State) -> None:
  after = jax.vmap(pushed.step)(start, jnp.full((BATCH, 12), 0.3, jnp.float32))
  assert {name: value.shape for name, value in after.obs.items()} == {  # pyright: ignore[reportAttributeAccessIssue]
    "state": (BATCH, 48),
    "privileged_state": (BATCH, 123),
  }
  assert pushed.action_size == 12
  assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after))
  assert (after.reward >= 0).all()


def test_observation_parts_add_up(pushed: Any) -> None:
  sizes = {name: value.shape[0] for name, value in dict(shapes(pushed).obs).items()}
  parts = pushed.observation_parts
  assert {name: sum(of.values()) for name, of in parts.items()} == sizes
  assert list(parts["state"].items())[:2] == [("linvel", 3), ("gyro", 3)]
  assert parts["privileged_state"]["feet_velocity"] == 12


def test_resets_differ(start: State) -> None:
  for value in (start.data.qpos[:, 0], start.info["command"][:, 0], start.info["push_velocity"]):
    assert len(np.unique(value)) == BATCH


def test_actor_sees_noise_and_critic_does_not(start: State) -> None:
  obs: Any = start.obs
  actor, critic = obs["state"], obs["privileged_state"]
  np.testing.assert_array_equal(critic[:, :48], actor)
  np.testing.assert_array_equal(critic[:, 48:51], start.data.sensordata[:, :3])  # the gyro
  error = np.abs(actor[:, 3:6] - critic[:, 48:51])
  assert (error > 0).all() and (error <= 0.2).all()


def test_a_push_changes_the_base_velocity(pushed: Any, start: State) -> None:
  one = jax.tree.map(lambda x: jnp.broadcast_to(x[0], x.shape), start)  # copies of one environment
  each = lambda *values: jnp.array(values + (values[0],) * (BATCH - 4))
  push = {
    "push_wait": each(0, 50, 50, 50),  # waiting, pushed along x, along y, at its end
    "push_interval": each(50, 50, 50, 50),
    "push_time": each(0, 3, 3, 6),
    "push_duration": each(0.12, 0.12, 0.12, 0.12),
    "push_velocity": each(2.0, 2.0, 2.0, 2.0),
    "push_direction": jnp.eye(3)[each(0, 0, 1, 0)],
  }
  after = jax.vmap(pushed.step)(one.replace(info=one.info | push), jnp.zeros((BATCH, 12)))
  gained = np.asarray(after.data.qvel[:, :3] - after.data.qvel[:1, :3])
  expected = 0.5 * 2.0 / 0.12 * pushed.dt  # the peak force over the mass, for one control step
  np.testing.assert_allclose([gained[1, 0], gained[2, 1]], expected, rtol=0.25)  # the legs give way
  np.testing.assert_allclose(gained[3], 0, atol=1e-3)
  assert after.info["push_wait"][:4].tolist() == [1, 50, 50, 0]
  shown, force = after.obs["privileged_state"][:, -1], after.obs["privileged_state"][:, -4:-1]
  assert shown[:4].tolist() == [0, 1, 1, 1]
  np.testing.assert_allclose(force[1, 0], 0.5 * 2.0 / 0.12 * 12.743448, rtol=1e-5)


def test_pushes_know_the_mass(monkeypatch: pytest.MonkeyPatch) -> None:
  env = load_task(TASK)
  monkeypatch.setattr(env.physics, "forward", lambda model, data: data)
  heavy = env.mjx_model.replace(body_mass=2 * env.mjx_model.body_mass)
  mass = jax.jit(lambda key: env.reset(key, heavy).info["push_mass"])(KEYS[0])
  np.testing.assert_allclose(mass, 2 * 12.743448, rtol=1e-6)


TRUNK = {"field": "body_mass", "target": "trunk", "operation": "scale", "range": [1.5, 2.0]}
HEAVY_TRUNK = {"events.trunk": {"mode": "reset", "func": "model_field", "params": TRUNK}}


def test_fields_of_the_model_may_be_drawn_in_each_episode(monkeypatch: pytest.MonkeyPatch) -> None:
  env = load_task(TASK, HEAVY_TRUNK)
  trunk = env.mj_model.body("trunk").id
  seen = lambda model, data, *_: data.replace(time=model.body_mass[trunk])
  monkeypatch.setattr(env.physics, "forward", seen)
  monkeypatch.setattr(env.physics, "step", seen)

  def masses(key: jax.Array) -> Any:
    state = env.reset(key)
    again = env.redraw(state.info, key)  # as an auto-reset does
    step = lambda info: env.step(state.replace(info=info), jnp.zeros(12)).data.time
    return state.data.time, step(state.info), step(again), state.info["push_mass"]

  first, stepped, redrawn, whole = (np.asarray(x) for x in jax.jit(jax.vmap(masses))(KEYS))
  nominal = env.mj_model.body_mass
  assert (first > 1.5 * nominal[trunk]).all() and (first < 2.0 * nominal[trunk]).all() and len(set(first)) == BATCH
  np.testing.assert_array_equal(stepped, first)
  assert (redrawn != first).all() and (redrawn > 1.5 * nominal[trunk]).all()
  np.testing.assert_allclose(whole, 12.743448 - nominal[trunk] + first, rtol=1e-5)  # a push knows it


def test_an_episode_changes_the_model_of_its_environment() -> None:
  env, trunk = load_task(TASK, HEAVY_TRUNK), load_task(TASK).mj_model.body("trunk").id
  masses = jnp.linspace(1.0, 2.0, BATCH)[:, None] * env.mjx_model.body_mass  # as a startup event drew them
  batch = wrappers.Vectorize(env)

  def seen(info: Any) -> tuple[np.ndarray, np.ndarray]:
    model = jax.vmap(lambda info, mass: env.model_of(info, env.mjx_model.replace(body_mass=mass)))(info, masses)
    return np.asarray(model.body_mass / masses), np.asarray(model.body_mass.sum(axis=1))

  infos = [batch.redraw({}, keys, {"body_mass": masses}) for keys in (KEYS, KEYS[::-1])]
  for info in infos:
    scales, whole = seen(info)
    assert (scales[:, trunk] > 1.5).all() and (scales[:, trunk] < 2.0).all() and len(set(scales[:, trunk])) == BATCH
    np.testing.assert_allclose(np.delete(scales, [0, trunk], axis=1), 1, rtol=1e-6)
    np.testing.assert_allclose(info["push_mass"], whole, rtol=1e-5)  # a push knows it


def test_a_deep_copy_is_a_task_of_its_own() -> None:
  env = load_task(TASK)
  assert env.jitted
  other = copy.deepcopy(env)
  other.mj_model.body_mass[1] = 99.0
  assert env.mj_model.body_mass[1] < 10 and other.spec is not env.spec and other.spec.bodies[1].name == "trunk"
  assert other.events.groups["interval"][0].instance.env is other
  assert other.jitted is not env.jitted and jax.tree.map(jnp.shape, shapes(other)) == jax.tree.map(
    jnp.shape, shapes(env)
  )


def test_terms_draw_from_another_key_in_every_step(monkeypatch: pytest.MonkeyPatch) -> None:
  """A term that draws by itself, such as `site_axes`, takes `c.info["rng"]`."""
  env = load_task(TASK)
  monkeypatch.setattr(env.physics, "forward", lambda model, data: data)
  monkeypatch.setattr(env.physics, "step", lambda model, data, *_: data)
  monkeypatch.setattr(env.observations, "compute", lambda c, *_: (c.info["rng"], {}))
  state = env.reset(KEYS[0])
  first = env.step(state, jnp.zeros(12))
  second = env.step(first, jnp.zeros(12))
  assert len({tuple(np.asarray(s.obs)) for s in (state, first, second)}) == 3


def test_settings_stand_for_a_tasks_own_numbers() -> None:
  pushed = load_task(TASK, {"events.push.enabled": True})
  changes = {
    "rewards.lin_vel_z_l2.weight": -7.0,
    "observations.state.gyro.noise.uniform": 0.9,
    "commands.velocity.params": {"max": [0.2, 0.1, 0.3], "resample_s": 0.1},
    "events.push.params.interval_s": [8.0, 9.0],
  }
  other = load_task(TASK, changes | {"events.push.enabled": True})
  same, state = pushed.with_settings(pushed.settings_of(other.config)), recorded(TASK)
  for ours, theirs in zip(*(jax.tree.leaves(evaluate(env, state)) for env in (same, other)), strict=True):
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)
  first = lambda env: env.commands.reset(KEYS[0]) | env.events.reset(KEYS[0], env.mjx_model)
  for name, value in first(same).items():
    np.testing.assert_allclose(value, first(other)[name], rtol=1e-5, err_msg=name)
  assert first(same)["push_interval"] >= 400 > first(pushed)["push_interval"]


def test_metrics_are_the_weighted_terms(pushed: Any) -> None:
  state = recorded(TASK)
  rewards, endings = pushed.config.rewards, pushed.config.terminations
  default = evaluate(pushed, state)
  names = {f"reward/{name}" for name in rewards} | {f"termination/{name}" for name in endings}
  assert set(default.metrics) == names | {"swing_peak", "fall", *pushed.summaries}
  key, weight = "rewards.flat_orientation_l2.weight", rewards.flat_orientation_l2.weight
  double = evaluate(load_task(TASK, {key: 2 * weight, "reward_clip": [-1e4, 1e4]}), state)
  name = "reward/flat_orientation_l2"
  np.testing.assert_allclose(double.metrics[name], 2 * default.metrics[name], rtol=1e-6)
  total = sum(value for key, value in double.metrics.items() if key.startswith("reward/"))
  np.testing.assert_allclose(double.reward, 0.02 * np.asarray(total), rtol=1e-5)


def test_terms_are_composed_by_config() -> None:
  changes = {
    "rewards.joint_power_l1": None,
    "rewards.pose_exp.weight": 0.0,
    "rewards.knees": {"func": "joint_deviation_l1", "weight": -0.1, "params": {"joints": ".*_calf_joint"}},
    "observations.state": {**dict.fromkeys(("linvel", "gravity", "joint_pos_rel", "joint_vel", "last_act", "command"))},
    "observations.state.last_contact": {},
    "observations.privileged_state": None,
  }
  env = load_task(TASK, changes)
  assert env.observation_size == 7  # the gyro and four contacts
  metrics = set(shapes(env).metrics)
  assert {"reward/knees", "reward/flat_orientation_l2"} < metrics
  assert not {"reward/joint_power_l1", "reward/pose_exp"} & metrics


def test_any_robot_can_be_named() -> None:
  env = registry.build(compose(["env=joystick", "robot=go1"]).env)
  assert env.action_size == 12


@pytest.mark.parametrize(
  ("overrides", "message"),
  [
    ({"observations.state.gyros": {}}, r"env\.observations\.state\.gyros: no function 'gyros'.*Did you mean 'gyro'\?"),
    ({"rewards.action_rate": {"weight": 1.0}}, r"env\.rewards\.action_rate: .*Did you mean 'action_rate_l2'\?"),
    ({"commands.velocity.func": "velocity_wlak"}, r"env\.commands\.velocity: .*Did you mean 'velocity_walk'\?"),
    ({"commands.gait": {"params": {"modes": ["trott"]}}}, r"gait\.params\.modes: 'trott'.*Did you mean 'trot'\?"),
    ({"terminations.falls": {"func": "upvector_belo"}}, r"env\.terminations\.falls: .*Did you mean 'upvector_below'\?"),
    ({"scene.terrain": "flatt"}, r"'flatt' is unknown.*Did you mean 'flat'\?"),
    ({"robot.base_site": "imuu"}, r"the site 'imuu'.*Did you mean 'imu'\?"),
    ({"robot.sensors.gyro": "gyroo"}, r"env\.robot\.sensors\.gyro: 'gyroo' is unknown.*Did you mean 'gyro'\?"),
    ({"action_base": "last_targt"}, r"env\.action_base: 'last_targt' is unknown.*Did you mean 'last_target'\?"),
  ],
)
def test_unknown_names(overrides: dict[str, Any], message: str) -> None:
  with pytest.raises(UnknownNameError, match=message) as error:
    load_task(TASK, overrides)
  assert "\n" not in str(error.value)


@pytest.mark.parametrize(
  ("term", "message"),
  [
    (
      {"func": "joint_deviation_l1", "params": {"joints": "kness"}},
      r"mine\.params\.joints='kness' matches no joint",
    ),
    (
      {"func": "feet_contact", "params": {"feet": ["FX"]}},
      r"mine\.params\.feet: 'FX' is unknown; choose",
    ),
    (
      {"func": "ang_vel_xy_l2", "params": {"sensor": "gyr"}},
      r"mine\.params\.sensor: 'gyr' is unknown.* 'gyro'",
    ),
    ({"func": "lin_vel_z_l2", "params": {"sensors": ["x_vel"]}}, r"rewards\.mine\.params\.sensors: 'x_vel' is unknown"),
  ],
)
def test_names_in_parameters_are_checked_when_the_task_is_built(term: dict[str, Any], message: str) -> None:
  with pytest.raises(UnknownNameError, match=message):
    load_task(TASK, {"rewards.mine": {"weight": 1.0, **term}})


def test_legs_have_contacts_by_group_only() -> None:
  floor = {"terminations.mine": {"func": "illegal_contact", "params": {"geoms": ["floor"]}}}
  message = (
    r"^env\.terminations\.mine: contacts of a robot on legs: 'floor' is unknown; choose from self_contact, fatal_"
  )
  with pytest.raises(UnknownNameError, match=message):
    shapes(load_task(TASK, floor))


def test_a_keyframe_is_checked_when_the_task_is_built() -> None:
  event = {"mode": "reset", "func": "reset_to_keyframe", "params": {"probability": 1.0, "keyframe": "hom"}}
  with pytest.raises(UnknownNameError, match=r"params\.keyframe names the keyframe 'hom'.*Did you mean 'home'"):
    load_task(TASK, {"events.mine": event})


def test_joints_are_found_by_group_or_expression() -> None:
  robot = load_task(TASK).robot
  assert robot.find_joints(".*_calf_joint").tolist() == [2, 5, 8, 11]
  assert robot.find_joints(["FR_hip_joint", "FL_.*"]).tolist() == [0, 3, 4, 5]
  with pytest.raises(UnknownNameError, match=r"joints='FR_hip_jont' matches no joint .*Did you mean 'FR_hip_joint'"):
    robot.find_joints("FR_hip_jont")
  with pytest.raises(ConfigError, match=r"joints='\*_hip_joint' is no regular expression, such as '\.\*_hip_joint'"):
    robot.find_joints("*_hip_joint")
  with pytest.raises(ConfigError, match=r"env\.robot\.sensors\.mine=3 must name a sensor, or be a list of names"):
    Robot(robot.mj_model, [], {"mine": 3})
  with pytest.raises(UnknownNameError, match="feet: 'FX' is unknown"):
    robot.find_feet(["FX"])


def test_what_is_not_kept_cannot_be_observed() -> None:
  phase = {"observations.state.phase": {}}
  with pytest.raises(ConfigError, match=r"reads info\['phase'\], which this task does not have"):
    _ = load_task(TASK, phase).observation_size
  sizes = load_task(TASK, phase | {"commands.gait": {"params": {"modes": ["trot"]}}}).observation_size
  assert sizes["state"] == (48 + 8,)


def test_rewards_need_what_they_are_about() -> None:
  env = load_task(TASK, {"rewards.self_contact": {"weight": -1.0}})
  with pytest.raises(ConfigError, match=r"env\.robot\.self_contact is empty or missing"):
    jax.eval_shape(env.step, shapes(env), jnp.zeros(12))


def test_joints_in_another_order(pushed: Any) -> None:
  with pytest.raises(ConfigError, match=r"env\.robot\.joints must name the model's joints in their order: FR_hip"):
    load_task(TASK, {"robot.joints": list(reversed(pushed.config.robot.joints))})


SLIDES_AND_A_BALL = '<joint type="slide"/>' * 3 + '<joint type="ball"/>'  # as many numbers as a free joint


@pytest.mark.parametrize(
  ("ours", "theirs", "message"),
  [
    ("<freejoint/>", SLIDES_AND_A_BALL, "needs <freejoint/> as its first joint, in the body trunk"),
    ("<position name=", '<position gear="2" name=', "the actuator FR_hip has gear=2, and an action is its joint's tar"),
    ("<position name=", '<motor ctrlrange="-1 1" name=', "the actuator FR_hip is no position servo"),
    ("<position name=", '<intvelocity actrange="-1 1" name=', "the actuator FR_hip is no position servo"),
  ],
)
def test_a_robot_without_a_free_joint_or_servos(ours: str, theirs: str, message: str, tmp_path: Path) -> None:
  robot = tmp_path / "robot.xml"
  mjcf = find_mjcf("go1")
  robot.write_text(mjcf.read_text().replace(ours, theirs))
  with pytest.raises(ConfigError, match=re.escape(message)):
    load_task(TASK, {"robot.mjcf": str(robot)})


@pytest.mark.parametrize(
  ("ours", "theirs", "message"),
  [
    (
      'joint="FR_hip_joint"/>',
      'joint="FL_hip_joint"/>',
      "in the order of the joints: there is none for FR_hip_joint.",
    ),
    (
      '<position name="FR_hip" class="hip" joint="FR_hip_joint"/>',
      "",
      "in the order of the joints: there is none for FR_hip_joint.",
    ),
    (
      "<actuator>",
      '<actuator><position name="more" class="hip" joint="RL_calf_joint"/>',
      "in the order of the joints: its servos drive RL_calf_joint, FR_hip_joint, ",
    ),
    (
      "<worldbody>",
      '<worldbody><light name="studio/spotlight"/>',
      "in light; rename it in the robot's MJCF.",
    ),
    ("<worldbody>", '<asset><mesh name="m" file="no.stl"/></asset><worldbody>', "MuJoCo cannot compile the task's"),
  ],
)
def test_servos_that_do_not_fit_the_joints_or_a_model_that_does_not_compile(
  ours: str, theirs: str, message: str, tmp_path: Path
) -> None:
  robot, text = tmp_path / "robot.xml", find_mjcf("go1").read_text()
  robot.write_text(text.replace(ours, theirs, 1))
  with pytest.raises(ConfigError, match=re.escape(message)):
    load_task(TASK, {"robot.mjcf": str(robot)})


def test_targets_of_servos_without_a_range_have_that_of_their_joints(tmp_path: Path) -> None:
  robot, text = tmp_path / "robot.xml", find_mjcf("go1").read_text()
  robot.write_text(text.replace(' inheritrange="1"', ""))
  env = load_task(TASK, {"robot.mjcf": str(robot), "clip_targets": True})
  np.testing.assert_array_equal(env.robot.target_range, env.mj_model.jnt_range[1:].T.astype(np.float32))
  (joint,) = re.findall(r'<joint name="FR_hip_joint" [^/]*', robot.read_text())
  robot.write_text(robot.read_text().replace(joint, f'{joint} limited="false"'))
  with pytest.raises(ConfigError, match=r"needs a range for each joint or for its servo: FR_hip_joint has none"):
    load_task(TASK, {"robot.mjcf": str(robot)})


def test_servos_with_a_time_constant_hold_the_pose_that_an_episode_starts_in(tmp_path: Path) -> None:
  robot, text = tmp_path / "robot.xml", find_mjcf("go1").read_text()
  robot.write_text(text.replace("<position kp=", '<position timeconst="0.05" kp='))
  data = on_c_physics(load_task(TASK, {"robot.mjcf": str(robot)})).reset(jax.random.PRNGKey(0)).data
  np.testing.assert_array_equal(data.act, data.ctrl)
  np.testing.assert_allclose(data.actuator_force, 0.0, atol=1e-4)


@pytest.mark.parametrize(
  ("changed", "message"),
  [
    (
      {"robot.foot_linvel": ["FL_global_linvel", "FR_global_linvel", "RR_global_linvel", "RL_global_linvel"]},
      "env.robot.foot_linvel: the sensor FL_global_linvel is at the foot FL, and must be at FR.",
    ),
    (
      {"robot.foot_contact": [["FR_floor_found"], ["FR_floor_found"], ["RR_floor_found"], ["RL_floor_found"]]},
      "env.robot.foot_contact: the sensor FR_floor_found is at the foot FR, and must be at FL.",
    ),
    (
      {"robot.sensors.upvector": "gyro"},
      "env.robot.sensors.upvector: the sensor gyro is a gyro, and must be a framezaxis.",
    ),
    (
      {"robot.sensors.linvel": "global_linvel"},
      "env.robot.sensors.linvel: the sensor global_linvel is a framelinvel, and must be a velocimeter.",
    ),
    ({"robot.feet": ["FR", "FL", "RR", "RLx"]}, "env.robot.feet names the site 'RLx', which the model does not have."),
    ({"robot.keyframe": "hom"}, "env.robot.keyframe names the keyframe 'hom', which the model does not have."),
  ],
)
def test_parts_of_a_robot_that_are_others_than_they_must_be(changed: dict[str, Any], message: str) -> None:
  with pytest.raises(ConfigError, match=rf"^{re.escape(message)}"):
    load_task(TASK, changed)


def test_each_name_of_a_group_of_joints_is_one() -> None:
  hips = ["left_hip_roll_joint", "right_hip_rol_joint"]
  with pytest.raises(UnknownNameError, match=r"^env\.robot\.hips='right_hip_rol_joint' matches no .*'right_hip_roll_j"):
    load_task("G1JoystickFlatTerrain", {"robot.hips": hips})


def test_a_servo_that_holds_another_angle_than_its_target(tmp_path: Path) -> None:
  robot, text = tmp_path / "robot.xml", find_mjcf("go1").read_text()
  servo = '<general gaintype="fixed" biastype="affine" gainprm="30" biasprm="0 -15 -1" ctrlrange="-1 1" name='
  robot.write_text(text.replace("<position name=", servo))
  with pytest.raises(ConfigError, match="the actuator FR_hip is no position servo"):
    load_task(TASK, {"robot.mjcf": str(robot), "robot.pd": None})


def test_a_keyframe_is_within_the_limits_of_the_joints(tmp_path: Path) -> None:
  robot, text = tmp_path / "robot.xml", find_mjcf("go1").read_text()
  robot.write_text(text.replace('qpos="0 0 0.278 1 0 0 0 0.1', 'qpos="0 0 0.278 1 0 0 0 1.5'))
  outside = r"keyframe=home: the joint FR_hip_joint is at 1\.5, outside its range of -0\.863 to 0\.863\.$"
  with pytest.raises(ConfigError, match=outside):
    load_task(TASK, {"robot.mjcf": str(robot)})


def test_a_keyframe_may_be_empty(tmp_path: Path) -> None:
  robot, text = tmp_path / "robot.xml", find_mjcf("go1").read_text()
  robot.write_text(text.replace("<keyframe>", '<keyframe><key name="zero"/>', 1))
  load_task(TASK, {"robot.mjcf": str(robot)})


def test_soft_limits_lie_within_the_hard_ones(pushed: Any) -> None:
  knee = pushed.robot.joint_range[1, 2]  # at its upper hard limit, -0.888
  after = evaluate(pushed, recorded(TASK), qpos=pushed.robot.init_qpos.at[9].set(knee))
  inside = 0.025 * (2.818 - 0.888)  # by how much the soft limit keeps clear of the hard one
  np.testing.assert_allclose(after.metrics["reward/joint_pos_limits"], -inside, atol=1e-6)


def test_a_fall_ends_the_episode_and_starts_the_time_of_the_command_over(pushed: Any) -> None:
  state = recorded(TASK, command_steps_left=jnp.array(900))
  up = pushed.mj_model.sensor("upvector").adr[0] + 2
  for height, fallen in ((-0.1, 1.0), (0.1, 0.0)):
    after = evaluate(pushed, state, sensordata=state.data.sensordata.at[up].set(height))
    ended = [after.done, after.metrics["fall"], after.metrics["termination/fell_over"]]
    assert [*ended, -after.metrics["reward/is_terminated"]] == [fallen] * 4
    assert (after.info["command_steps_left"] == 899) == (not fallen)
    np.testing.assert_array_equal(after.info["command"], state.info["command"])


def test_what_is_observed_is_the_command_of_the_step(pushed: Any) -> None:
  state = recorded(TASK, command_steps_left=jnp.array(1), command=jnp.full(3, 9.0), rng=KEYS[1])
  after = evaluate(pushed, state)
  assert (after.info["command"] != 9.0).any()
  obs: Any = after.obs
  np.testing.assert_array_equal(obs["state"][-3:], [9, 9, 9])


def test_actions_are_remembered(pushed: Any) -> None:
  state, action = recorded(TASK), jnp.linspace(-1, 1, 12)
  after = pushed.post_step(state.data, state.info, action)
  np.testing.assert_array_equal(after.info["last_act"], action)
  np.testing.assert_array_equal(after.info["last_last_act"], state.info["last_act"])
  np.testing.assert_array_equal(after.obs["state"][-15:-3], state.info["last_act"])


def test_swing_bookkeeping(pushed: Any) -> None:
  sensors = [pushed.mj_model.sensor(f"{foot}_floor_found").adr[0] for foot in ("FR", "FL", "RR", "RL")]
  contact = jnp.array([1.0, 0.0, 0.0, 1.0])
  carried = {"feet_air_time": jnp.full(4, 0.2), "swing_peak": jnp.full(4, 0.15), "last_contact": jnp.zeros(4, bool)}
  state = recorded(TASK, command=jnp.ones(3), **carried)
  feet = state.data.site_xpos.at[pushed.robot.feet, 2].set(0.02)
  after = evaluate(pushed, state, sensordata=state.data.sensordata.at[jnp.array(sensors)].set(contact), site_xpos=feet)
  np.testing.assert_allclose(after.info["feet_air_time"], [0, 0.22, 0.22, 0], atol=1e-6)
  np.testing.assert_allclose(after.info["swing_peak"], [0, 0.15, 0.15, 0], atol=1e-6)
  np.testing.assert_array_equal(after.info["last_contact"], contact)
  np.testing.assert_allclose(after.metrics["reward/feet_air_time"], 0.1 * 2 * 0.12, rtol=1e-5)
  np.testing.assert_allclose(after.metrics["reward/feet_swing_height_l2"], -0.2 * 2 * 0.5**2, rtol=1e-5)
  np.testing.assert_allclose(after.metrics["swing_peak"], 0.075, rtol=1e-5)
