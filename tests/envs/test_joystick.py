"""The joystick task on the Go1: shapes, composition by config, kicks, and what differs from 0.2.0."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground import registry
from playground.config import compose
from playground.envs.base import State
from playground.envs.locomotion.joystick import Joystick
from playground.errors import ConfigError, UnknownNameError
from tests.envs.golden import load_task

TASK = "Go1JoystickFlatTerrain"


@pytest.fixture(scope="module")
def kicked() -> Joystick:
  return load_task(TASK, {"pushes.enable": True})


@pytest.fixture(scope="module")
def start(kicked: Joystick) -> State:
  return jax.jit(jax.vmap(kicked.reset))(jax.random.split(jax.random.PRNGKey(0), 4))


@pytest.fixture(scope="module")
def step(kicked: Joystick):
  return jax.jit(jax.vmap(kicked.step))


def shapes(env: Joystick) -> State:
  return jax.eval_shape(env.reset, jax.random.PRNGKey(0))


def test_batched_step(kicked: Joystick, start: State, step) -> None:
  after = step(start, jnp.full((4, 12), 0.3, jnp.float32))
  assert after.obs["state"].shape == (4, 48)
  assert after.obs["privileged_state"].shape == (4, 123)
  assert kicked.action_size == 12
  assert jax.tree.structure(after) == jax.tree.structure(start)
  # The same types, weak ones included: a loop over steps compiles once.
  assert jax.tree.map(jax.typeof, after) == jax.tree.map(jax.typeof, start)
  assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(after))
  assert (after.reward >= 0).all()


def test_observation_parts_add_up(kicked: Joystick) -> None:
  sizes = {name: value.shape[0] for name, value in dict(shapes(kicked).obs).items()}
  parts = kicked.observation_parts
  assert {name: sum(of.values()) for name, of in parts.items()} == sizes
  assert list(parts["state"].items())[:2] == [("linvel", 3), ("gyro", 3)]
  assert parts["privileged_state"]["feet_velocity"] == 12


def test_resets_differ(start: State) -> None:
  for value in (start.data.qpos[:, 0], start.info["command"][:, 0], start.info["pert_mag"]):
    assert len(np.unique(value)) == 4


def test_actor_sees_noise_and_critic_does_not(start: State) -> None:
  assert isinstance(start.obs, dict)
  actor, critic = start.obs["state"], start.obs["privileged_state"]
  np.testing.assert_array_equal(critic[:, :48], actor)
  np.testing.assert_array_equal(critic[:, 48:51], start.data.sensordata[:, :3])  # the gyro
  error = np.abs(actor[:, 3:6] - critic[:, 48:51])
  assert (error > 0).all() and (error <= 0.2).all()


def test_kick_changes_the_base_velocity(kicked: Joystick, start: State, step) -> None:
  one = jax.tree.map(lambda x: jnp.broadcast_to(x[0], x.shape), start)  # four copies of one environment
  kick = {
    "steps_since_last_pert": jnp.array([0, 100, 100, 100]),  # waiting, kicked along x, along y, at its end
    "steps_until_next_pert": jnp.array([50] * 4),
    "pert_steps": jnp.array([0, 3, 3, 6]),
    "pert_duration": jnp.array([6] * 4),
    "pert_duration_seconds": jnp.array([0.12] * 4),
    "pert_mag": jnp.array([2.0] * 4),
    "pert_dir": jnp.eye(3)[jnp.array([0, 0, 1, 0])],
  }
  after = step(one.replace(info=one.info | kick), jnp.zeros((4, 12)))
  gained = np.asarray(after.data.qvel[:, :3] - after.data.qvel[:1, :3])
  expected = 0.5 * 2.0 / 0.12 * kicked.dt  # the peak force over the mass, for one control step
  np.testing.assert_allclose(gained[1, 0], expected, rtol=0.25)  # the legs give way
  np.testing.assert_allclose(gained[2, 1], expected, rtol=0.25)
  np.testing.assert_allclose(gained[3], 0, atol=1e-3)
  assert after.info["steps_since_last_pert"].tolist() == [1, 100, 100, 0]
  pushed, force = after.obs["privileged_state"][:, -1], after.obs["privileged_state"][:, -4:-1]
  assert pushed.tolist() == [0, 1, 1, 0]
  np.testing.assert_allclose(force[1, 0], 0.5 * 2.0 / 0.12 * 12.743448, rtol=1e-5)


def test_metrics_are_the_weighted_terms(start: State, kicked: Joystick) -> None:
  scales = kicked.config.reward.scales
  in_use = {name for name in scales if scales[name] != 0}
  assert set(start.metrics) == {f"reward/{name}" for name in in_use} | {"swing_peak", "fall", *kicked.summaries}
  default = jax.vmap(kicked.evaluate)(start.data, start.info, jnp.zeros((4, 12)))
  double = load_task(TASK, {"reward.scales.orientation": 2 * scales.orientation, "reward.clip": [-1e4, 1e4]})
  other = jax.vmap(double.evaluate)(start.data, start.info, jnp.zeros((4, 12)))
  name = "reward/orientation"
  np.testing.assert_allclose(other.metrics[name], 2 * default.metrics[name], rtol=1e-6)
  total = sum(value for key, value in other.metrics.items() if key.startswith("reward/"))
  np.testing.assert_allclose(other.reward, double.dt * np.asarray(total), rtol=1e-5)


def test_terms_of_weight_zero_are_gone() -> None:
  env = load_task(TASK, {"reward.scales.energy": 0, "reward.scales.pose": 0.0})
  metrics = set(shapes(env).metrics)
  assert "reward/orientation" in metrics
  assert not {"reward/energy", "reward/pose"} & metrics


def test_observations_are_composed_by_config() -> None:
  env = load_task(TASK, {"obs.state": ["gyro", "last_contact"], "obs.privileged_state": ["push_force", "state"]})
  assert env.observation_size == {"state": (7,), "privileged_state": (10,)}


def test_any_robot_can_be_named() -> None:
  env = registry.build(compose(["env=joystick", "robot=go1"]).env)
  assert env.action_size == 12


@pytest.mark.parametrize(
  ("overrides", "message"),
  [
    ({"obs.state": ["gyros"]}, r"env\.obs\.state: 'gyros' is unknown.*Did you mean 'gyro'\?"),
    ({"command.sampler": "wlak"}, r"env\.command\.sampler: 'wlak' is unknown.*Did you mean 'walk'\?"),
    ({"gait.modes": ["trott"]}, r"env\.gait\.modes: 'trott' is unknown.*Did you mean 'trot'\?"),
    ({"reset.draw_order": [["yow"]]}, r"env\.reset\.draw_order: 'yow' is unknown.*Did you mean 'yaw'\?"),
    ({"reward.total": "product_"}, r"env\.reward\.total: 'product_' is unknown.*Did you mean 'product'\?"),
    ({"scene.terrain": "flatt"}, r"'flatt' is unknown.*Did you mean 'flat'\?"),
    ({"robot.base_site": "imuu"}, r"the site 'imuu'.*Did you mean 'imu'\?"),
    ({"robot.sensors.gyro": "gyroo"}, r"the sensor 'gyroo'.*Did you mean 'gyro'\?"),
  ],
)
def test_unknown_names(overrides: dict, message: str) -> None:
  with pytest.raises(UnknownNameError, match=message) as error:
    load_task(TASK, overrides)
  assert "\n" not in str(error.value)


@pytest.mark.parametrize(
  ("section", "entry", "message"),
  [
    ("reward.scales", ("orientatoin", 1.0), r"env\.reward\.scales: 'orientatoin'.*Did you mean 'orientation'\?"),
    ("noise.scales", ("gyr", 1.0), r"env\.noise\.scales: 'gyr' is unknown.*Did you mean 'gyro'\?"),
    ("termination", ("falls", 1.0), r"env\.termination: 'falls' is unknown.*Did you mean 'fall'\?"),
  ],
)
def test_unknown_entries(kicked: Joystick, section: str, entry: tuple[str, float], message: str) -> None:
  config = kicked.config.copy_and_resolve_references()
  with config.unlocked():
    node = config
    for part in section.split("."):
      node = node[part]
    node[entry[0]] = entry[1]
  with pytest.raises(UnknownNameError, match=message):
    Joystick(config)


def test_what_is_not_kept_cannot_be_observed() -> None:
  env = load_task(TASK, {"obs.state": ["gyro", "phase"]})
  with pytest.raises(ConfigError, match="needs the 'phase' that this task does not keep"):
    _ = env.observation_size
  assert load_task(TASK, {"obs.state": ["gyro", "phase"], "gait.modes": ["trot"]}).observation_size["state"] == (11,)


def test_rewards_need_what_they_are_about() -> None:
  env = load_task(TASK, {"reward.scales.collision": -1.0})
  with pytest.raises(ConfigError, match=r"env\.robot\.self_contact is empty or missing"):
    jax.eval_shape(env.step, shapes(env), jnp.zeros(12))


def test_joints_in_another_order(kicked: Joystick) -> None:
  with pytest.raises(ConfigError, match=r"env\.robot\.joints must name the model's joints in their order: FR_hip"):
    load_task(TASK, {"robot.joints": list(reversed(kicked.config.robot.joints))})


def test_missing_reward_parameter(kicked: Joystick) -> None:
  config = kicked.config.copy_and_resolve_references()
  with config.unlocked():
    del config.reward["tracking_sigma"]
  with pytest.raises(ConfigError, match=re.escape("env.reward.tracking_sigma is missing")):
    Joystick(config)


@pytest.mark.parametrize("parity", [False, True])
def test_soft_limits(parity: bool, start: State) -> None:
  env = load_task(TASK, {"parity": parity})
  knee = env.robot.joint_range[1, 2]  # at its upper hard limit, -0.888
  data = start.data.replace(qpos=jnp.broadcast_to(env.robot.init_qpos, start.data.qpos.shape).at[:, 9].set(knee))
  penalty = jax.vmap(env.evaluate)(data, start.info, jnp.zeros((4, 12))).metrics["reward/dof_pos_limits"]
  inside = 0.025 * (2.818 - 0.888)  # by how much the soft limit keeps clear of the hard one
  np.testing.assert_allclose(penalty, 0 if parity else -inside, atol=1e-6)


@pytest.mark.parametrize("parity", [False, True])
def test_kicks_know_the_mass(parity: bool) -> None:
  env = load_task(TASK, {"parity": parity, "pushes.enable": True})
  heavy = env.mjx_model.replace(body_mass=2 * env.mjx_model.body_mass)
  mass = jax.jit(lambda key: env.reset(key, heavy).info["pert_mass"])(jax.random.PRNGKey(0))
  np.testing.assert_allclose(mass, 12.743448 * (1 if parity else 2), rtol=1e-6)


def test_a_fall_ends_the_episode(kicked: Joystick, start: State) -> None:
  sensor = kicked.mj_model.sensor("upvector")
  upside_down = start.data.replace(sensordata=start.data.sensordata.at[:2, sensor.adr[0] + 2].set(-0.1))
  after = jax.vmap(kicked.evaluate)(upside_down, start.info, jnp.zeros((4, 12)))
  assert after.done.tolist() == [1, 1, 0, 0]
  np.testing.assert_allclose(after.metrics["reward/termination"], [-1, -1, 0, 0])
  drawn_anew = after.info["steps_until_next_cmd"] != start.info["steps_until_next_cmd"] - 1
  assert drawn_anew.tolist() == [True, True, False, False]
  np.testing.assert_array_equal(after.info["command"], start.info["command"])


def test_commands_are_drawn_when_due(kicked: Joystick, start: State) -> None:
  due = start.info | {"steps_until_next_cmd": jnp.array([1, 1, 2, 2])}
  after = jax.vmap(kicked.evaluate)(start.data, due, jnp.zeros((4, 12)))
  changed = (after.info["command"] != start.info["command"]).any(axis=-1)
  assert not changed[2:].any() and changed[:2].any()
  assert after.info["steps_until_next_cmd"].tolist()[2:] == [1, 1]
  np.testing.assert_array_equal(after.obs["state"][:, -3:], start.info["command"])  # seen is the old one


def test_swing_bookkeeping(kicked: Joystick, start: State) -> None:
  sensors = [kicked.mj_model.sensor(f"{foot}_floor_found").adr[0] for foot in ("FR", "FL", "RR", "RL")]
  contact = jnp.array([1.0, 0.0, 0.0, 1.0])
  data = start.data.replace(sensordata=start.data.sensordata.at[:, jnp.array(sensors)].set(contact))
  info = start.info | {"feet_air_time": jnp.full((4, 4), 0.2), "swing_peak": jnp.full((4, 4), 0.15)}
  info["command"] = jnp.ones((4, 3))
  after = jax.vmap(kicked.evaluate)(data, info, jnp.zeros((4, 12)))
  np.testing.assert_allclose(after.info["feet_air_time"][0], [0, 0.22, 0.22, 0], atol=1e-6)
  np.testing.assert_allclose(after.info["swing_peak"][0], [0, 0.15, 0.15, 0], atol=1e-6)
  np.testing.assert_array_equal(after.info["last_contact"][0], contact)
  np.testing.assert_allclose(after.metrics["reward/feet_air_time"], 0.1 * 2 * 0.12, rtol=1e-5)
  np.testing.assert_allclose(after.metrics["reward/feet_height"], -0.2 * 2 * 0.5**2, rtol=1e-5)
  np.testing.assert_allclose(after.metrics["swing_peak"], 0.075, rtol=1e-5)
