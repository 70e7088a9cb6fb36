"""Chains: what their stages are composed from, and what is refused in which words."""

import functools
import shutil
from math import pi
from pathlib import Path
from typing import Any

import pytest

from playground.config import RunConfig, compose, config_roots, options
from playground.errors import ConfigError, UnknownNameError
from tests.sampling import some

CHAINS = [name for name in options("experiment") if name.endswith("_chain")]
STAGES = """
  flat: {num_timesteps: 1000, overrides: ['env.commands.velocity.params.max=[1.0, 0.5, 0.5]', agent.num_envs=1024]}
  fast: {num_timesteps: null, overrides: ['env.commands.velocity.params.max=[2.0, 0.5, 0.5]']}
  slope: {num_timesteps: 3000, overrides: [terrain=slope, env.rewards.joint_power_l1.weight=-0.002]}
"""


@pytest.fixture
def configs(tmp_path: Path) -> Path:
  """A copy of our configs/ with a chain."""
  folder = Path(shutil.copytree(config_roots()[0], tmp_path / "configs"))
  write(folder, STAGES)
  return folder


def write(configs: Path, stages: str, head: str = "defaults: [none, _self_]\n") -> None:
  (configs / "curriculum/mine.yaml").write_text(f"# @package curriculum\n{head}stages: {stages}\n")


MINE = ["env=Go1JoystickFlatTerrain", "curriculum=mine"]


def test_a_stage_adds_to_those_before_it(configs: Path):
  flat, fast, slope = compose([*MINE, "seed=5"], configs).stages
  assert [stage.env.commands.velocity.params.max[0] for stage in (flat, fast, slope)] == [1.0, 2.0, 2.0]
  assert [stage.env.scene.terrain for stage in (flat, fast, slope)] == ["flat", "flat", "slope"]
  assert [stage.env.rewards.joint_power_l1.weight for stage in (fast, slope)] == [-0.001, -0.002]
  assert [stage.agent.num_timesteps for stage in (flat, fast, slope)] == [1000, 200_000_000, 3000]
  for stage in (flat, fast, slope):
    assert (stage.seed, stage.agent.num_envs, stage.stages) == (5, 1024, ())
    assert (stage.choices["curriculum"], stage.resolved["curriculum"]["stages"]) == ("none", {})
    assert stage.resolved["agent"]["num_timesteps"] == stage.agent.num_timesteps
  assert slope.name == "Go1JoystickFlatTerrain/slope"
  assert compose(["env=Go1JoystickFlatTerrain"]).stages == ()


def test_the_command_line_wins_in_all_stages(configs: Path):
  overrides = [
    *MINE,
    "agent.num_envs=512",
    "env.rewards.joint_power_l1.weight=-0.5",
    "curriculum.stages.flat.num_timesteps=7e9",
  ]
  stages = compose(overrides, configs).stages
  assert {(stage.agent.num_envs, stage.env.rewards.joint_power_l1.weight) for stage in stages} == {(512, -0.5)}
  assert stages[0].agent.num_timesteps == 7_000_000_000


def test_another_task_brings_its_own_files(configs: Path):
  write(configs, "{a: {num_timesteps: 1, overrides: []}, b: {num_timesteps: null, overrides: [env=Go1Getup]}}")
  a, b = compose([*MINE, "agent=ppo_v020"], configs).stages
  assert (a.choices["tuned"], b.choices["tuned"]) == ("ppo_v020/Go1JoystickFlatTerrain", "ppo_paper/Go1Getup")
  assert b.agent.num_timesteps == 50_000_000
  assert (b.env.task, b.choices["robot"]) == ("playground.envs.locomotion.legged:LeggedTask", "go1")


def test_budgets_in_proportion(configs: Path):
  budgets = lambda *overrides: [s.agent.num_timesteps for s in compose([*MINE, *overrides], configs).stages]
  assert budgets("curriculum.scale=0.1") == [100, 20_000_000, 300]
  assert budgets("curriculum.scale=1e-9") == [1, 1, 1]
  assert budgets("agent.num_timesteps=5e3", "curriculum.scale=0") == [5000] * 3


def test_a_shortened_chain_sees_as_much_of_an_episode():
  """As many steps from one fresh start of all environments to the next."""

  def starts(*overrides: str) -> set[int]:
    return {stage.agent.num_resets_per_eval for stage in compose(["experiment=go1_handstand_chain", *overrides]).stages}

  assert starts() == starts("curriculum.scale=2") == {10}
  assert starts("curriculum.scale=0.3") == {3}
  assert starts("curriculum.scale=0.01") == {1}
  assert starts("curriculum.scale=0.3", "agent.num_resets_per_eval=0") == {0}
  assert starts("curriculum.scale=0.3", "agent.num_resets_per_eval=10") == {10}


def test_a_chain_starts_at_a_stage_with_what_those_before_it_set(configs: Path, tmp_path: Path):
  (only,) = compose([*MINE, "curriculum.start_at=slope", f"init_from={tmp_path}"], configs).stages
  assert (only.name, only.env.commands.velocity.params.max[0]) == ("Go1JoystickFlatTerrain/slope", 2.0)
  assert only.resolved["init_from"] is None, "the chain says it"
  assert len(compose([*MINE, "curriculum.start_at=flat"], configs).stages) == 3, "the first needs no weights"


# Ours


@functools.cache
def shipped(experiment: str) -> RunConfig:
  return compose([f"experiment={experiment}"])


@pytest.mark.parametrize("experiment", CHAINS)
def test_every_chain_we_ship_composes(experiment: str):
  stages = shipped(experiment).stages
  assert len(stages) > 1
  assert all(str(stage.choices["tuned"]).startswith(f"{stage.agent_name}/") for stage in stages)
  assert len({stage.agent_name for stage in stages}) == 1, "weights of one algorithm"


@pytest.mark.parametrize("experiment", some(CHAINS, len(CHAINS)))
def test_a_chain_is_small_with_debug_fast(experiment: str):
  tiny = compose([f"experiment={experiment}", "debug=fast"]).stages
  assert [stage.agent.num_timesteps for stage in tiny] == [320] * len(tiny)


def test_every_chain_has_an_experiment():
  used = {shipped(experiment).choices["curriculum"] for experiment in CHAINS}
  assert used == set(options("curriculum")) - {"none"}


@pytest.mark.parametrize(
  ("experiment", "keys", "expected"),
  [
    (
      "go1_joystick_chain",  # paper, Appendix B.2.5
      ("env.commands.velocity.params.max", "env.scene.terrain", "agent.num_timesteps"),
      [
        ([1.5, 0.8, 1.2], "flat", 100_000_000),
        ([1.5, 0.8, pytest.approx(2 * pi)], "flat", 50_000_000),
        ([1.5, 0.8, pytest.approx(2 * pi)], "rough", 100_000_000),
      ],
    ),
    (
      "go1_getup_chain",
      ("env.terminations.power_above.params.limit", "env.rewards.joint_vel_limits_l2.weight"),
      [(400.0, 0.0), (400.0, -0.1)],
    ),
    (
      "go1_footstand_chain",
      (
        "env.terminations.power_above.params.limit",
        "env.rewards.joint_power_l1.weight",
        "env.rewards.joint_acc_l2.weight",
      ),
      [(None, None, None), *((watts, -0.003, -2.5e-7) for watts in (400.0, 300.0, 250.0, 200.0))],
    ),
    (
      "leap_reorient_chain",  # paper, Section IV-C.1
      ("env.torque_limits", "env.pose_noise.injection", "agent.num_timesteps", "agent.learning_rate"),
      [(False, 0.0, 200_000_000, 3e-4), (True, 0.1, 100_000_000, 1e-4)],
    ),
    (
      "aero_rotate_chain",  # ours
      ("env.rewards.action_rate_l2.weight", "agent.num_timesteps", "agent.discounting"),
      [(-0.1, 100_000_000, 0.99), (-1.0, 200_000_000, 0.99)],
    ),
    (
      "g1_rough_chain",
      ("choices.env", "agent.name", "agent.num_timesteps"),
      [("G1JoystickFlatTerrain", "fast_sac", 50_000_000), ("G1JoystickRoughTerrain", "fast_sac", 50_000_000)],
    ),
  ],
)
def test_chains_are_as_published_or_measured(experiment: str, keys: tuple[str, ...], expected: list[Any]):
  def value(node: Any, key: str) -> Any:
    for part in key.split("."):
      node = node.get(part, {})
    return None if node == {} else node

  stages = shipped(experiment).stages
  assert [tuple(value(stage.resolved, key) for key in keys) for stage in stages] == expected


# What is refused


@pytest.mark.parametrize(
  ("line", "message"),
  {
    "curriculum.start_at=slpe": "curriculum.start_at=slpe does not exist: choose from flat, fast, slope. Did you mean",
    "curriculum.start_at=slope": "=slope is not the first stage, so it needs weights to start from: add init_from=<",
    "curriculum.scale=-1": "curriculum.scale=-1.0 must be a number from 0 to 1000.",
    "curriculum.stages.slop.num_timesteps=1": "slop.num_timesteps does not exist: curriculum.stages has flat, fast, ",
    "curriculum.stages.flat.num_timesteps=0": "flat.num_timesteps=0 must be a number above 0 and at most 1e+12.",
    "agent.num_timesteps=5": "agent.num_timesteps=5 is not for a chain, whose stages have budgets of their own",
    "curriculum=none curriculum.start_at=flat": "curriculum.start_at=flat needs a chain: add curriculum=<name>, one of",
    "curriculum=mien": "curriculum=mien does not exist: choose from",
  }.items(),
)
def test_what_the_command_line_may_not_say(configs: Path, line: str, message: str):
  with pytest.raises(ConfigError) as caught:
    compose([*MINE, *line.split()], configs)
  assert message in str(caught.value)
  assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
  ("override", "message"),
  {
    "env.comand.max=[1, 1, 1]": "env.comand.max does not exist: env has",
    "agent.learning_rate=fast": "agent.learning_rate=fast has the wrong type: it must be a number",
    "env=Go1JoystickRoughTerain": "Did you mean 'Go1JoystickRoughTerrain'?",
    "hardware=cpu": "hardware=cpu cannot be set by a stage, which takes only env, robot, agent,",
    "init_from=here": "init_from=here cannot be set by a stage",
    "agent.num_timesteps=5": "agent.num_timesteps=5: a stage's budget is its num_timesteps.",
    "agent.num_envs=1000": "agent.num_envs=1000 does not divide",
    "env.reward": "'env.reward' is not an override",
  }.items(),
)
def test_what_a_stage_may_not_set(configs: Path, override: str, message: str):
  write(configs, f"{{a: {{num_timesteps: 1, overrides: []}}, b: {{num_timesteps: 1, overrides: ['{override}']}}}}")
  with pytest.raises(ConfigError) as caught:
    compose(MINE, configs)
  assert str(caught.value).startswith("Stage b of the chain: ")
  assert message in str(caught.value)
  assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
  ("stages", "message"),
  {
    "{a: {num_timesteps: 1}}": "curriculum.stages.a.overrides is missing.",
    "{a: {num_timestep: 1, overrides: []}}": "Did you mean 'num_timesteps'?",
    "{a: {num_timesteps: 1.5, overrides: []}}": "a.num_timesteps=1.5 must be a whole number, or null.",
    "{a: {num_timesteps: 1, overrides: {env.ctrl_dt: 1}}}": "curriculum.stages.a.overrides={env.ctrl_dt: 1} has the",
    "{a: {num_timesteps: 1, overrides: [{env.ctrl_dt: 1}]}}": "it must be a list of key=value",
    "{a: 3}": "curriculum.stages.a=3 has the wrong type: it must be a mapping with the keys num_timesteps, overrides.",
    "{a/b: {num_timesteps: 1, overrides: []}}": "curriculum.stages.a/b: a stage's name is that of a folder",
    "{a.b: {num_timesteps: 1, overrides: []}}": "curriculum.stages.a.b: a stage's name is that of a folder",
  }.items(),
)
def test_stages_that_are_none(configs: Path, stages: str, message: str):
  write(configs, stages)
  with pytest.raises(ConfigError) as caught:
    compose(MINE, configs)
  assert message in str(caught.value)
  assert isinstance(caught.value, UnknownNameError) == ("Did you mean" in message)


def test_a_chain_without_the_fields_of_none(configs: Path):
  write(configs, STAGES, head="")
  with pytest.raises(ConfigError, match=r"^curriculum\.scale is missing: write defaults: \[none, _self_\] in the"):
    compose(MINE, configs)
