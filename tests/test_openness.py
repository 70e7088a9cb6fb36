"""Packages of somebody else add robots, rewards, observations, events and algorithms: see tests/packages."""

import json
from pathlib import Path
from typing import Any

import pytest

from playground import registry
from playground.config import compose
from playground.robots.scene import ROBOTS
from tests.packages import PACKAGES, install, run

TERMS = [
  'env.rewards.height={func: "terms_only.terms:height_tracking_exp", weight: 0.5, params: {target: 0.27, std: 0.05}}',
  'env.observations.state.roll_pitch={func: "terms_only.terms:roll_pitch", noise: {uniform: 0.02}}',
  'env.events.wind={func: "terms_only.terms:Wind", mode: interval, params: {force: [5.0, 20.0]}}',
]


def trained(site: Path, folder: Path, *overrides: str) -> None:
  """A run of seconds, to its end."""
  options = ("debug=fast", "hardware=cpu", "tracking=csv", "video.enable=false")
  run(site, "-m", "playground.cli.run", *overrides, *options, f"run_dir={folder}")
  assert json.loads((folder / "summary.json").read_text())["status"] == "finished"


@pytest.fixture(scope="module")
def robot_only(tmp_path_factory: pytest.TempPathFactory) -> Path:
  return install(PACKAGES / "robot_only", tmp_path_factory.mktemp("robot_only"))


@pytest.fixture(scope="module")
def terms_only(tmp_path_factory: pytest.TempPathFactory) -> Path:
  return install(PACKAGES / "terms_only", tmp_path_factory.mktemp("terms_only"))


@pytest.fixture(scope="module")
def reinforce(tmp_path_factory: pytest.TempPathFactory) -> Path:
  return install(PACKAGES / "reinforce", tmp_path_factory.mktemp("reinforce"))


def test_a_package_with_a_robot_alone(robot_only: Path):
  code = """
    import warnings
    warnings.simplefilter("error", UserWarning)
    import jax
    import jax.numpy as jnp
    from playground import registry
    from playground.config import compose
    from playground.envs.c_physics import on_c_physics

    env = on_c_physics(registry.build(compose(["env=joystick", "robot=pup"]).env))
    state = env.reset(jax.random.PRNGKey(0))
    for _ in range(3):
      state = env.step(state, jnp.zeros(12))
    assert state.metrics["upright"] == 1 and state.info["last_contact"].any(), state.metrics
    assert {entry.shape for entry in state.obs.values()} == {(48,), (123,)}, state.obs
    """
  run(robot_only, "-c", code)


def test_a_robot_by_a_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
  """An MJCF in the place of a robot's own, relative to where the command is typed."""
  monkeypatch.chdir(tmp_path)
  text = (ROBOTS / "go1/go1.xml").read_text()
  (tmp_path / "mine.xml").write_text(text.replace('forcerange="-23.7 23.7"', 'forcerange="-20 20"'))
  env: Any = registry.build(compose(["env=joystick", "robot=go1", "env.robot.mjcf=mine.xml"]).env)
  assert env.mj_model.actuator("FR_hip").forcerange.tolist() == [-20, 20]


def test_terms_of_a_package_from_the_command_line(terms_only: Path):
  code = f"""
    import jax
    import jax.numpy as jnp
    from playground import registry
    from playground.config import compose
    from playground.errors import ConfigError

    env = registry.build(compose(["env=Go1JoystickFlatTerrain", *{TERMS!r}]).env)
    state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
    after = jax.eval_shape(env.step, state, jnp.zeros(12))
    assert "reward/height" in after.metrics and after.info["wind"].shape == (3,)
    assert after.obs["state"].shape == (50,) and env.observation_parts["state"]["roll_pitch"] == 2

    data = env.physics.make(qpos=env.robot.init_qpos)
    blown, _ = env.events.step(data, {{"wind": jnp.array([3.0, 0.0, 0.0])}})
    assert blown.xfrc_applied[env.robot.root, 0] == 3

    env = registry.build(compose(["experiment=go1_in_wind"]).env)
    rewards = [term.name for term in env.rewards.terms]
    assert "height_tracking_exp" in rewards and "pose_exp" not in rewards

    try:
      registry.build(compose(["env=Go1JoystickFlatTerrain", {TERMS[0].replace("std", "sdt")!r}]).env)
    except ConfigError as error:
      assert "sdt does not exist" in str(error) and "'std'" in str(error), error
    else:
      raise AssertionError("sdt is no parameter")
    """
  run(terms_only, "-c", code)


def test_terms_of_a_module_that_the_user_trusts():
  """Without an entry point the command line says that it trusts the module."""
  code = f"""
    from playground import registry, trust
    from playground.config import compose
    from playground.errors import ConfigError

    config = compose(["env=Go1JoystickFlatTerrain", {TERMS[0]!r}]).env
    try:
      registry.build(config)
    except ConfigError as error:
      assert "add trust=terms_only" in str(error), error
    else:
      raise AssertionError("terms_only is not trusted")
    trust.trust("terms_only")
    assert "height" in [term.name for term in registry.build(config).rewards.terms]
    """
  run(PACKAGES / "terms_only", "-c", code)


def test_settings_of_an_algorithm_are_checked_before_jax_is_imported(reinforce: Path):
  code = """
    import sys
    from playground.config import compose
    from playground.errors import PlaygroundError

    assert compose(["agent=reinforce", "agent.unroll_length=20"]).agent.learning_rate == 1e-3
    for override, sentence in {
      "agent=reinforc": "agent=reinforc does not exist: choose from",
      "agent.unrol_length=2": "Did you mean 'agent.unroll_length'?",
      "agent.discounting=2": "agent.discounting=2.0 must be a number from 0 to 1",
    }.items():
      try:
        compose(["agent=reinforce", override] if "." in override else [override])
      except PlaygroundError as error:
        assert sentence in str(error), error
      else:
        raise AssertionError(override)
    assert "jax" not in sys.modules
    """
  run(reinforce, "-c", code)


def test_an_algorithm_of_a_package_trains_and_resumes(reinforce: Path, tmp_path: Path):
  """A resumed run ends bit for bit as one that never stopped; the task has no physics to compile."""
  code = f"""
    from playground import registry
    from playground.config import compose
    from playground.runs.callbacks import RunCallbacks
    from playground.runs.run_dir import RunDirectory
    from playground.runs.train import train
    from tests.dummy import Point

    registry.load = lambda *_, **__: Point()
    fast = ["env=CartpoleBalance", "agent=reinforce", "debug=fast", "hardware=cpu", "tracking=csv"]
    whole, parts = ({str(tmp_path)!r} + name for name in ("/whole", "/parts"))
    assert train(compose([*fast, f"run_dir={{whole}}"])) == 0
    should_stop = RunCallbacks.should_stop
    RunCallbacks.should_stop = lambda job: job._step >= 160
    train(compose([*fast, f"run_dir={{parts}}"]))
    assert RunDirectory(parts).status["status"] == "preempted"
    RunCallbacks.should_stop = should_stop
    assert train(compose([f"resume={{parts}}"])) == 0
    for key in ("params_sha256", "final_return", "steps"):
      assert RunDirectory(parts).summary[key] == RunDirectory(whole).summary[key], key
    """
  run(reinforce, "-c", code)


@pytest.mark.slow
def test_an_algorithm_of_a_package_is_in_a_sweep_and_exported(reinforce: Path, tmp_path: Path):
  options = ("debug=fast", "hardware=cpu", "tracking=csv", f"sweep_dir={tmp_path / 'sweep'}")
  run(reinforce, "-m", "playground.cli.run", "-m", "env=CartpoleBalance", "agent=ppo,reinforce", *options)
  summaries = [json.loads(path.read_text()) for path in (tmp_path / "sweep").glob("**/summary.json")]
  assert [summary["status"] for summary in summaries] == ["finished"] * 2
  (job,) = (
    path.parent for path in (tmp_path / "sweep").glob("**/config.yaml") if "name: reinforce" in path.read_text()
  )
  run(reinforce, "-m", "playground.cli.main", "export", str(job))
  assert (job / "export" / "policy.onnx").is_file()


@pytest.mark.slow
def test_a_robot_of_a_package_trains(robot_only: Path, tmp_path: Path):
  trained(robot_only, tmp_path / "run", "env=joystick", "robot=pup")


@pytest.mark.slow
def test_terms_of_a_package_train(terms_only: Path, tmp_path: Path):
  trained(terms_only, tmp_path / "run", "env=Go1JoystickFlatTerrain", *TERMS)
