"""Composition: which file's value wins, what is refused and in which words."""

import contextlib
import dataclasses
import io
import json
import math
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import hydra
import pytest
from omegaconf import OmegaConf

from playground import config
from playground.config import compose, from_saved
from playground.config.files import experiment_name
from playground.config.run_options import ProfileConfig, TrackingConfig, VideoConfig, WandbConfig
from playground.errors import ConfigError, UnknownNameError
from playground.hardware.options import DistributedConfig
from playground.learning.hyperparameters import MOST_EVALS, config_class
from playground.mdp.options import is_model_field
from playground.settings import plain
from tests.aliases import LAUGHS
from tests.runs.helpers import make_run
from tests.sampling import some

TUNED = ["experiment=cartpole_balance"]


@pytest.fixture
def configs(tmp_path: Path) -> Path:
  """A copy of our configs/, to add files to."""
  return Path(shutil.copytree(config.config_roots()[0], tmp_path / "configs"))


@pytest.fixture
def run(tmp_path: Path) -> Path:
  """A run directory with a saved configuration."""
  path = tmp_path / "run"
  path.mkdir()
  (path / "config.yaml").write_text(config.to_yaml(compose(["env=CartpoleBalance", "agent.num_envs=64", "seed=7"])))
  return path


# Which value wins


def test_default_run():
  run = compose()
  assert run.name == "quickstart"
  assert run.overrides == ("experiment=quickstart",)
  assert compose(["agent.num_envs=64"]).name == "quickstart"
  assert compose(["debug=fast"]).choices["experiment"] == "quickstart"


@pytest.mark.parametrize("choice", ["env=CartpoleBalance", "agent=ppo", "curriculum=none", "experiment=null"])
def test_quickstart_never_leaks_onto_a_chosen_run(choice: str):
  run = compose([choice])
  assert run.choices["experiment"] is None
  assert run.name == "CartpoleBalance"
  assert run.agent.num_timesteps == 60_000_000


def test_env_and_agent_alone_pick_the_tuned_set():
  cartpole, go1 = compose(["env=CartpoleBalance"]), compose(["agent=ppo", "env=Go1JoystickFlatTerrain"])
  assert (cartpole.choices["tuned"], go1.choices["tuned"]) == ("ppo/CartpoleBalance", "ppo/Go1JoystickFlatTerrain")
  assert (cartpole.agent.discounting, go1.agent.discounting) == (0.995, 0.97)
  assert go1.agent.network.value_obs_key == "privileged_state"
  assert compose(["env=CartpoleBalance", "tuned=null"]).agent.discounting == 0.99


@pytest.mark.parametrize(
  ("chosen", "tuned"),
  [
    ("env=HumanoidWalk", None),
    ("experiment=humanoid_run", "reppo/HumanoidRun"),
    ("experiment=g1_joystick", "fast_sac/G1JoystickFlatTerrain"),
    ("env=T1JoystickRoughTerrain", "fast_sac/T1JoystickFlatTerrain"),
  ],
)
def test_a_task_chooses_the_agent_that_learns_it_best(chosen: str, tuned: str | None):
  own, ppo = compose([chosen]), compose([chosen, "agent=ppo"])
  agent = tuned.partition("/")[0] if tuned else "reppo"
  assert (own.agent_name, own.choices["tuned"]) == (agent, tuned)
  assert (ppo.agent_name, ppo.choices["tuned"]) == ("ppo", f"ppo/{ppo.choices['env']}")


def test_a_variant_keeps_the_agent_that_is_measured_on_it():
  assert [compose([f"env=AcrobotSwingup{kind}"]).agent_name for kind in ("", "Sparse")] == ["reppo", "ppo"]


@pytest.mark.parametrize(
  ("task", "tuned"), [("joystick", "ppo/joystick"), ("biped_joystick", "fast_sac/biped_joystick")]
)
def test_a_new_robot_trains_with_the_set_of_robots_like_it(configs: Path, task: str, tuned: str):
  assert compose([f"env={task}", "robot=h1"]).choices["tuned"] == tuned
  (configs / "env/Mine.yaml").write_text(f"defaults: [{task}, override /robot@_global_.robot: h1, _self_]\n")
  mine = compose(["env=Mine"], configs)
  assert (mine.choices["tuned"], mine.agent.network.value_obs_key) == (tuned, "privileged_state")


def test_a_task_without_a_tuned_set_has_the_agents_defaults(configs: Path):
  shutil.copy(configs / "env/CartpoleBalance.yaml", configs / "env/Untuned.yaml")
  run = compose(["env=Untuned"], configs)
  assert run.choices["tuned"] is None
  assert run.agent.num_timesteps == 50_000_000


def test_later_layers_win(configs: Path):
  (configs / "experiment/mine.yaml").write_text(
    "# @package _global_\ndefaults:\n  - override /env: CartpoleBalance\nagent: {num_envs: 512, learning_rate: 1}\n"
  )
  agent = compose(["experiment=mine"], configs).agent
  assert (agent.num_envs, agent.learning_rate, agent.num_minibatches) == (512, 1.0, 32)  # experiment over tuned
  assert isinstance(agent.learning_rate, float)
  assert compose(["experiment=mine", "agent.num_envs=256"], configs).agent.num_envs == 256
  assert compose(["agent.num_envs=4", "debug=fast", "experiment=mine"], configs).agent.num_envs == 4
  assert compose(["experiment=mine", "env=PointMass"], configs).choices["tuned"] == "ppo/PointMass"


def test_a_task_chooses_robot_and_randomization_which_the_command_line_overrides():
  run = compose(["experiment=go1_joystick"])
  assert (run.choices["robot"], run.choices["randomization"]) == ("go1", "go1")
  assert run.env.robot.name == "go1"
  startup = lambda run: [name for name, event in run.env.events.items() if event.mode == "startup"]
  assert "payload" in startup(run)
  assert startup(compose(["experiment=go1_joystick", "randomization=none"])) == []


def test_a_generic_task_takes_any_robot():
  run = compose(["env=joystick", "robot=go1"])
  assert run.name == "joystick"
  assert run.env.robot.name == "go1"


@pytest.mark.parametrize("env", [*some(config.task_names(), 5), "joystick robot=go1"])
def test_debug_fast_is_small_for_every_task(env: str):
  run = compose([*f"env={env}".split(), "debug=fast"])
  agent = run.agent
  assert run.env.episode_length == 20
  assert agent.num_timesteps / agent.steps_per_update == (40 if run.choices["agent"] in ("fast_sac", "fast_td3") else 4)


@pytest.mark.parametrize("agent", config.options("agent"))
def test_debug_fast_is_small_for_every_algorithm(agent: str):
  run = compose(["env=CartpoleSwingup", f"agent={agent}", "debug=fast"])
  assert (run.agent.num_timesteps, run.agent.num_envs, run.env.episode_length) == (320, 8, 20)
  assert compose(["env=CartpoleSwingup", f"agent={agent}", "debug=fast", "agent.num_envs=4"]).agent.num_envs == 4


@pytest.mark.parametrize(
  ("group", "every"),  # tuned: test_hyperparameters.py
  [
    ("experiment", 6),
    pytest.param("experiment", 1, marks=pytest.mark.slow),
    *((group, 1) for group in ("hardware", "tracking", "debug")),
  ],
)
def test_options_we_ship_compose(group: str, every: int):
  for option in list(config.options(group))[::every]:
    assert compose([f"{group}={option}"]).choices[group] == option


def test_one_string_is_no_list_of_overrides():
  with pytest.raises(ConfigError, match=r"compose takes a list of overrides: compose\(\['env=CartpoleBalance'\]\)"):
    compose("env=CartpoleBalance")


def test_several_debug_presets():
  run = compose(["debug=[fast,profile]"])
  assert run.profile.enable
  assert (run.agent.num_timesteps, run.agent.num_envs, run.env.episode_length) == (320, 8, 20)


def test_a_task_has_an_experiment_of_its_name(configs: Path):
  shutil.copy(configs / "env/CartpoleBalance.yaml", configs / "env/MyTaskRoughTerrain.yaml")
  assert compose(["experiment=my_task_rough"], configs).choices["env"] == "MyTaskRoughTerrain"
  (configs / "experiment/my_task_rough.yaml").write_text(
    "# @package _global_\ndefaults:\n  - override /env: MyTaskRoughTerrain\nseed: 7\n"
  )
  assert compose(["experiment=my_task_rough"], configs).seed == 7, "a file of the name comes first"
  chosen = {name: compose([f"experiment={name}"]).choices["env"] for name in ("aero_rotate", "spot_joystick")}
  assert chosen == {"aero_rotate": "AeroCubeRotateZAxis", "spot_joystick": "SpotFlatTerrainJoystick"}
  assert {experiment_name(task) for task in config.task_names()} <= set(config.options("experiment"))


@pytest.mark.parametrize(
  ("line", "times"),
  [("experiment=go1_joystick", 1), ("env=CartpoleBalance agent=sac hardware=gpu", 1), ("debug=fast", 2)],
)
def test_a_run_is_composed_once(monkeypatch: pytest.MonkeyPatch, configs: Path, line: str, times: int):
  """Twice where a file changes keys that only other files define."""
  calls, composed = [], hydra.compose
  monkeypatch.setattr(hydra, "compose", lambda *args, **kwargs: calls.append(args) or composed(*args, **kwargs))
  compose(line.split(), configs)
  assert len(calls) == times


def test_a_typo_of_a_tasks_key_in_a_preset_is_refused(configs: Path):
  (configs / "debug/mine.yaml").write_text("# @package _global_\nenv: {episode_lenth: 1}\n")
  for debug in ("mine", "[mine,profile]"):
    with pytest.raises(UnknownNameError, match=r"env\.episode_lenth, set by a chosen file.*'env\.episode_length'"):
      compose(["env=CartpoleBalance", f"debug={debug}"], configs)


# What a RunConfig is


@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_agent_is_what_its_algorithm_reads(name: str):
  config = compose([f"agent={name}", "agent.num_envs=256"])
  assert type(config.agent) is config_class(name)
  assert config.resolved["agent"] == {"name": name, **plain(config.agent)}
  assert (config.agent_name, config.agent.num_envs) == (name, 256)


def test_an_agent_of_an_earlier_version_is_refused(tmp_path: Path):
  with pytest.raises(UnknownNameError, match=r"agent=rsl_rl_ppo does not exist: choose from .*own runner: docs/rsl-rl"):
    compose(["agent=rsl_rl_ppo"])
  saved = compose(["env=CartpoleBalance"]).resolved
  saved["agent"]["name"] = "rsl_rl_ppo"
  with pytest.raises(UnknownNameError, match=r"agent.name=rsl_rl_ppo does not exist: .*RSL-RL trains through its own"):
    from_saved(saved)


def test_paper_values_of_go1():
  assert compose(["experiment=go1_joystick"]).agent.num_resets_per_eval == 10, "our set's own"
  agent = compose(["experiment=go1_joystick", "agent=ppo_paper"]).agent
  assert (agent.num_timesteps, agent.num_evals, agent.num_resets_per_eval) == (200_000_000, 10, 1)
  assert (agent.num_envs, agent.batch_size, agent.unroll_length, agent.max_grad_norm) == (8192, 256, 20, 1.0)
  assert tuple(agent.network.policy_hidden_layer_sizes) == (512, 256, 128)


@pytest.mark.parametrize(
  ("text", "value"),
  [
    ("agent.num_timesteps=1e6", 1_000_000),
    ("agent.learning_rate=1", 1.0),
    ("agent.max_grad_norm=1", 1),
    ("agent.max_grad_norm=null", None),
    ("agent.network.policy_hidden_layer_sizes=[8,16.0]", [8, 16]),
    ("agent.batch_size=${agent.num_envs}", 2048),
    ("+agent.num_envs=64", 64),
    ("agent.network={activation: relu}", "relu"),
  ],
)
def test_values_take_the_type_of_their_default(text: str, value: Any):
  run = compose([*TUNED, text])
  key = text.lstrip("+").split("=")[0] + (".activation" if value == "relu" else "")
  found = OmegaConf.select(OmegaConf.create(run.resolved), key)
  assert found == value
  assert type(value) in (list, type(found))


def test_overrides_are_what_hydra_takes():
  run = compose(["agent.num_timesteps=1e6", "tuned=null", "+seed=2", "run_dir='a b'", "hydra.verbose=true"])
  assert run.overrides == (
    *("experiment=quickstart", "agent.num_timesteps=1000000", "~tuned", "seed=2", "run_dir='a b'"),
  )
  assert compose(run.overrides).resolved == run.resolved


@pytest.mark.parametrize("name", ["a word", "1e3", "${oc.env:HOME}", "ü: [", "2024-01-01", "null", "1_0"])
def test_saved_text_reads_back(name: str, tmp_path: Path):
  """A commit such as 1e3 is text for PyYAML and a number for OmegaConf."""
  resolved = {**compose([]).resolved, "name": name}
  run = make_run(tmp_path / "run", resolved)
  assert config.load(run.config_path).name == run.config["name"] == name


def test_saved_configuration_reads_back(tmp_path: Path):
  run = compose(["experiment=go1_joystick"])
  (tmp_path / "config.yaml").write_text(config.to_yaml(run))
  again = config.load(tmp_path / "config.yaml")
  assert again.resolved == run.resolved
  assert again.env.to_dict() == run.env.to_dict()
  assert list(run.resolved)[:2] == ["name", "choices"]


def test_foreign_configuration_is_refused(tmp_path: Path):
  for text in ("a: 1", "[1]", "a: [", "${", LAUGHS):
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(ConfigError, match=rf"^{tmp_path}/config\.yaml"):  # a chain has one for each stage
      config.load(tmp_path / "config.yaml")
  with pytest.raises(ConfigError, match="missing"):
    config.load(tmp_path / "missing")
  os.mkfifo(tmp_path / "pipe")
  with pytest.raises(ConfigError, match="pipe is not a file"):
    config.load(tmp_path / "pipe")


def test_a_saved_number_of_any_length_is_refused(tmp_path: Path):
  resolved = compose(["env=CartpoleBalance"]).resolved
  text = config.values_to_yaml({**resolved, "seed": "length"}).replace("seed: length", f"seed: 0x{'f' * 9000}")
  (tmp_path / "config.yaml").write_text(text)
  with pytest.raises(ConfigError, match=r"seed=0xf+ "):
    compose([f"resume={tmp_path}"])


def test_null_keys_can_be_assigned():
  run = compose()
  run.env.vision.camera = "side"
  assert run.env.vision.camera == "side"


def test_sections_are_typed():
  run = compose(["env=CartpoleBalance", "video.width=320", "tracking.wandb.tags=[a]"])
  assert run.video == VideoConfig(width=320)
  assert run.tracking == TrackingConfig(tensorboard=True, wandb=WandbConfig(tags=["a"]))
  saved = {**run.resolved, "profile": {"enable": True, "steps": 3}, "video": {"width": 8}}
  assert (config.from_dict(saved).profile, config.from_dict(saved).video.height) == (ProfileConfig(enable=True), 480)


def test_run_dir(run: Path):
  new = compose()
  assert re.fullmatch(r"results/quickstart/\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d", new.run_dir or "")
  assert new.resolved["run_dir"] is None
  assert compose(["run_dir=/tmp/here"]).run_dir == "/tmp/here"
  assert compose([f"resume={run}"]).run_dir == str(run)


def test_tree_shows_every_value():
  from rich.console import Console

  out = io.StringIO()
  Console(file=out, width=200).print(config.tree(compose()))
  shown = out.getvalue()
  for text in ("quickstart", "agent", "num_envs: 256", "policy_hidden_layer_sizes: [32, 32, 32, 32]", "run_dir: null"):
    assert text in shown


def test_composing_needs_no_jax():
  code = (
    "import sys, playground, playground.registry as r; r.config('CartpoleBalance'); assert 'jax' not in sys.modules"
  )
  subprocess.run([sys.executable, "-c", code], check=True)


# What is refused

ERRORS = {
  "env=Go1Joystic": ["env=Go1Joystic does not exist", "that `playground list` shows", "'Go1JoystickFlatTerrain'?"],
  "env=Go1Joystik": ["Did you mean 'Go1Joystick"],  # Op3Joystick has more letters in common
  "experiment=quickstar": [
    "experiment=quickstar",
    "that `playground keys experiment` shows",
    "Did you mean 'quickstart'?",
  ],
  "hardware=tpu": ["hardware=tpu does not exist: choose from the ", "`playground keys hardware` shows"],
  "env=v020/CartpoleBalanc": ["Did you mean 'v020/CartpoleBalance'?"],
  "env=go1_joystick": ["Did you mean experiment=go1_joystick?"],
  "experiment=CartpoleBalance": ["Did you mean env=CartpoleBalance?"],
  "robot=spotty_the_dog_123": ["These begin alike: spot."],
  "env=_cartpole": ["env=_cartpole does not exist", "Did you mean 'Cartpole"],
  "env=null": ["env=null does not exist: choose from the "],
  "experimen=foo": ["experimen does not exist", "Did you mean 'experiment'?"],
  "sead=1": ["sead does not exist", "Did you mean 'seed'?"],
  "learning_rate=1": ["learning_rate does not exist", "Did you mean 'agent.learning_rate'?"],
  "num_envs=1": ["num_envs does not exist", "Did you mean 'agent.num_envs'?"],
  "lr=1": ["lr does not exist", "Did you mean 'agent.learning_rate'?"],
  "env.cuda_impl=wrap": ["env.cuda_impl=wrap is unknown: choose from jax, warp. Did you mean 'warp'?"],
  "agent.num_steps_per_env=24": ["Did you mean 'agent.unroll_length'?"],
  "env=T1JoystickFlatTerrain agent.num_steps_per_env=24": [
    "agent.num_steps_per_env is agent.unroll_length, which does not exist for agent=fast_sac, only for agent=ppo",
  ],
  "agent.learning_rat=1": ["agent.learning_rat does not exist: agent has", "Did you mean 'agent.learning_rate'?"],
  "agent.network.activatio=relu": ["agent.network has policy_hidden_layer_sizes, ", "'agent.network.activation'?"],
  "agent.network={activatio: relu}": ["agent.network.activatio", "does not exist.", "'agent.network.activation'?"],
  "env=Go1JoystickFlatTerrain env.rewards.joint_power_l1.wieght=1": ["joint_power_l1.wieght does not", "'weight'?"],
  "env=Go1JoystickFlatTerrain env.rewards.feet_slipp_l2=null": [
    "env.rewards.feet_slipp_l2 does not exist: env.rewards has ",
    "Did you mean 'env.rewards.feet_slip_l2'?",
  ],
  "env=Go1JoystickFlatTerrain env.observations.state.gyr=null": ["does not exist", "'env.observations.state.gyro'?"],
  "env=Go1JoystickFlatTerrain env.observations.privileged=null": ["'env.observations.privileged_state'?"],
  "env.rewards.feet_slip_l2=null": ["env.rewards.feet_slip_l2 does not exist: env.rewards is empty."],
  "env=T1JoystickFlatTerrain agent.clipping_epsilon=0.2": [
    "agent.clipping_epsilon does not exist for agent=fast_sac, only for agent=ppo."
  ],
  "agent.name.x=1": ["agent.name.x does not exist: agent.name is a single value."],
  "agent.network.policy_hidden_layer_sizes.9.x=1": ["agent.network.policy_hidden_layer_sizes is a list of 4."],
  "env@foo=CartpoleBalance": ["env@foo does not exist", "Did you mean 'env'?"],
  "+agent.foo=1": ["agent.foo does not exist: agent has name, num_timesteps, "],
  "++env.foo=1": ["env.foo does not exist: env has "],
  "+foo.bar=1": ["foo.bar does not exist: the configuration has "],
  "~agent.num_envs": ["~agent.num_envs: a key cannot be removed"],
  "agent.learning_rate=fast": ["agent.learning_rate=fast", "must be a number, as its default 0.0003 is."],
  "agent.learning_rate=nan": ["agent.learning_rate=nan", "must be a number"],
  "agent.num_envs=1.5": ["agent.num_envs=1.5", "must be a whole number, as its default 2048 is."],
  "agent.num_envs=inf": ["agent.num_envs=inf", "must be a whole number"],
  "agent.num_envs=true": ["agent.num_envs=true", "must be a whole number"],
  "agent.num_envs=null": ["agent.num_envs=null", "must be a whole number"],
  "agent.num_envs=[1]": ["agent.num_envs=[1]", "must be a whole number"],
  "agent.num_envs=???": ["agent.num_envs has no value: set agent.num_envs=<value>."],
  "agent.normalize_advantage=1": ["agent.normalize_advantage=1", "must be true or false, as its default true is."],
  "agent.name=3": ["agent.name=3 cannot be set: agent=<name> chooses it, with the keys that it has."],
  "agent.network=3": ["agent.network=3", "must be a mapping with the keys policy_hidden_layer_sizes, "],
  "agent.network.policy_hidden_layer_sizes=8": ["=8 ", "must be a list, as its default [32, 32, 32, 32] is."],
  "agent.network.policy_hidden_layer_sizes=[8,a]": ["policy_hidden_layer_sizes[1]=a ", "must be a whole number"],
  "agent.network.activation=rel": ["agent.network.activation=rel is unknown: choose from swish, ", "mean 'relu'?"],
  "agent.network.cnn.global_pool=mean": ["global_pool=mean is unknown: choose from none, avg, max, spatial_softmax."],
  "video.visuals=mesh": ["video.visuals=mesh is unknown: choose from primitives, menagerie."],
  "tracking.wandb.mode=onlin": ["tracking.wandb.mode=onlin is unknown: choose from auto, online", "mean 'online'?"],
  "agent.max_grad_norm={a: 1}": ["agent.max_grad_norm={a: 1}", "must be a single value, a list or null."],
  "agent.batch_size=${agent.nothing}": ["agent.batch_size: Interpolation key 'agent.nothing' not found"],
  "run_dir=${oc.env:NO_SUCH_FOLDER}": ["run_dir: ", "'NO_SUCH_FOLDER' not found"],
  "init_from=${oc.env:NO_SUCH_FOLDER}": ["init_from: ", "'NO_SUCH_FOLDER' not found"],
  "run_dir=3": ["run_dir=3", "must be text (put quotes around a number)."],
  f"seed={'9' * 5000}": ["seed cannot be a whole number of more than 4300 digits: "],
  "agent=[1": ["'agent=[1' is not an override: its value does not parse; a list is [1, 2], "],
  "agent.num_envs": ["'agent.num_envs' is not an override: write key=value, such as env=CartpoleBalance"],
  "hardware.xla_flags=--a=b": ["quote its value, in a shell 'hardware.xla_flags=\"--a=b\"'."],
  "=3": ["'=3' is not an override: write key=value"],
  "~env.terminations.nonfinite_state": ["env.terminations.nonfinite_state=null removes the term."],
  "Go1JoystickFlatTerrain": ["is not an override: write env=Go1JoystickFlatTerrain."],
  "algo=sac": ["algo does not exist", "Did you mean 'agent'?"],
  "agent.lr=1": ["agent.lr does not exist", "Did you mean 'agent.learning_rate'?"],
  "agent.num_envs=1,2": ["agent.num_envs=1,2 names several values, which is a sweep: add -m (a list is [1, 2], "],
  "agent.num_timesteps=-5": ["agent.num_timesteps=-5 must be a whole number from 1 to 1e+12."],
  "agent.num_envs=0": ["agent.num_envs=0 must be a whole number from 1 to 16777216."],
  "agent.max_grad_norm=big": ["agent.max_grad_norm=big must be a number above 0 and at most 1000000000."],
  "agent.max_grad_norm=[1]": ["agent.max_grad_norm=[1] must be a number above 0 and at most"],
  "env.vision.farthest=inf": ["env.vision.farthest=inf must be a number above 0 and at most"],
  "agent.network.policy_hidden_layer_sizes=[8,0]": [
    "policy_hidden_layer_sizes=[8, 0] must be a list of whole numbers from 1 to 65536."
  ],
  "agent.network.cnn.strides=[0,2]": [
    "agent.network.cnn.strides=[0, 2] must be a list of whole numbers from 1 to 65536."
  ],
  "agent.network.cnn.kernels=[5,0]": ["agent.network.cnn.kernels=[5, 0] must be a list of whole numbers from 1 to"],
  "agent.network.cnn.channels=[-3,3]": ["agent.network.cnn.channels=[-3, 3] must be a list of whole numbers from 1 to"],
  "hardware.devices=0": ["hardware.devices=0 must be a whole number from 1 to"],
  "agent=sac agent.tau=2": ["agent.tau=2.0 must be a number from 0 to 1."],
  "agent=sac agent.grad_updates_per_step=0": ["agent.grad_updates_per_step=0 must be a whole number from 1 to"],
  "agent=sac agent.min_replay_size=-1": ["agent.min_replay_size=-1 must be a whole number from 0 to"],
  "agent.discounting=2": ["agent.discounting=2.0 must be a number from 0 to 1."],
  "agent.num_timesteps='5e6'": ["agent.num_timesteps='5e6' has the wrong type: it must be a whole number"],
  "seed=-1": ["seed=-1 must be a whole number from 0 to 4294967295."],
  "env=PandaPickCube env.success_distance=-1": ["env.success_distance=-1.0 must be a number above 0 and at most"],
  "env=PandaPickCubeCartesian env.gripper_delay=-1": ["env.gripper_delay=-1 must be a whole number from 0 to 1000."],
  "env=LeapCubeReorient env.pose_noise.injection=2": ["env.pose_noise.injection=2.0 must be a number from 0 to 1."],
  "env=Go1Getup env.reward_total=prodct": ["env.reward_total=prodct is unknown: choose from sum, product. Did you"],
  "env=PandaPickCube env.njmax=-1": ["env.njmax=-1 must be a whole number from 0 to"],
  "env=PandaPickCube env.naccdmax_per_env=30": ["env.naccdmax_per_env=30 must not be above env.naconmax_per_env=24."],
  "env.vision.brightness=[1]": ["env.vision.brightness=[1.0] must be 2 numbers from 0 to"],
  "env.vision.brightness=[-1,2]": ["env.vision.brightness=[-1.0, 2.0] must be 2 numbers from 0 to"],
  "env.vision.brightness=[2,1]": ["the first not above the second."],
  "env.impl=wrap": ["env.impl=wrap is unknown: choose from auto, jax, warp. Did you mean 'warp'?"],
  "hardware.matmul_precision=higest": ["choose from default, high, highest, ", "Did you mean 'highest'?"],
  "agent.num_envs=100": ["agent.num_envs=100 does not divide", "128 * 8 = 1024"],
  "env=joystick": ["env=joystick needs a robot: add robot=<name>, one of "],
  "env=CartpoleBalance robot=go1": ["robot=go1: env=CartpoleBalance takes no robot"],
  "init_from=/nowhere/run": ["init_from=/nowhere/run is no run directory or checkpoint", "does not exist."],
  "resume=/nowhere/run": ["resume=/nowhere/run is no run directory: /nowhere/run/config.yaml does not exist."],
}


@pytest.mark.parametrize("line", ERRORS)
def test_errors_are_one_sentence(line: str):
  overrides = [line] if "{" in line or "[" in line else line.split()
  with pytest.raises(ConfigError) as caught:
    compose(overrides)
  message = str(caught.value)
  for part in ERRORS[line]:
    assert part in message
  assert "\n" not in message
  assert message[-1] in ".?"
  assert isinstance(caught.value, UnknownNameError) == ("does not exist" in message and "=/nowhere" not in line)


def test_resume_of_a_folder_of_runs_names_the_newest(tmp_path: Path):
  for name in ("2026-01-01_00-00-00", "2026-01-02_00-00-00"):
    (tmp_path / name).mkdir()
    (tmp_path / name / "config.yaml").touch()
  with pytest.raises(ConfigError, match=r"is a folder of runs: name one, .* resume=\S*/2026-01-02_00-00-00\."):
    compose([f"resume={tmp_path}"])


def test_resume_of_a_checkpoint_names_its_run(tmp_path: Path):
  (tmp_path / "checkpoints" / "000000000320").mkdir(parents=True)
  (tmp_path / "plots").mkdir()
  (tmp_path / "status.json").touch()
  for path in (tmp_path / "checkpoints", tmp_path / "checkpoints" / "000000000320"):
    with pytest.raises(ConfigError, match=rf"is a part of a run: resume={tmp_path} continues it"):
      compose([f"resume={path}"])


def test_resume_of_a_sweep_names_its_command(tmp_path: Path):
  (tmp_path / "sweep.yaml").touch()
  with pytest.raises(ConfigError, match=r"folder of a sweep: `playground sweep retry \S+` continues it, resume="):
    compose([f"resume={tmp_path}"])


def test_a_key_of_an_empty_mapping_is_set_with_the_mapping():
  with pytest.raises(UnknownNameError, match=r"is empty\. Set it whole: env\.observation_order=\{state: <value>\}\."):
    compose(["env=Go1JoystickFlatTerrain", "env.observation_order.state=[gyro]"])


ROBOT_FILES = {  # a line of a robot's file: the error, or what begins it
  "pd: {kd: 1}": "env.robot.pd.kd does not exist. Did you mean 'kv'?",
  "pd: 5": "env.robot.pd=5 has the wrong type: it must be a mapping, such as",
  "floor_contacts: null": "env.robot.floor_contacts=null has the wrong type: it must be a list of texts.",
  "mjcf: null": "env.robot.mjcf=null has the wrong type: it must be text",
  "sensors: [gyro]": "env.robot.sensors=[gyro] has the wrong type: it must be a mapping",
  "gaits: [1]": "env.robot.gaits=[1] has the wrong type: it must be a mapping",
  "gaits: {trot: 3}": "env.robot.gaits.trot=3 must be a list of numbers from",
  "target_range: [0, 1]": "env.robot.target_range=[0, 1] has the wrong type: it must be a mapping",
  "target_range: {lower: [0]}": "env.robot.target_range.upper is missing.",
  "mirror: [FL]": "env.robot.mirror=[FL] has the wrong type: it must be a mapping",
  "mirror: {FL: null}": "env.robot.mirror.FL=null has the wrong type: it must be text",
  "restricted_range: [1]": "env.robot.restricted_range=[1] has the wrong type: it must be a mapping",
  "name: {a: b}": "env.robot.name={a: b} has the wrong type: it must be text",
  "pose_weights: 1": "env.robot.pose_weights=1 must be a list of numbers from 0 to",
  "hips: ${no.such}": "env.robot.hips: Interpolation key 'no.such' not found.",
}


@pytest.mark.parametrize("line", ROBOT_FILES)
def test_a_robots_file_with_a_wrong_type_is_refused(configs: Path, line: str):
  kept = re.sub(rf"(?m)^{line.partition(':')[0]}:.*\n(^ .*\n)*", "", (configs / "robot/go1.yaml").read_text())
  (configs / "robot/mine.yaml").write_text(f"{kept}{line}\n")
  with pytest.raises(ConfigError, match=re.escape(ROBOT_FILES[line])):
    compose(["env=joystick", "robot=mine"], configs)


def test_a_robots_file_must_be_a_mapping_in_its_package(configs: Path):
  head, mine = "# @package env.robot\n", configs / "robot/mine.yaml"
  go1 = (configs / "robot/go1.yaml").read_text()
  for text, message in {
    f"{head}- name\n- mjcf\n": "env.robot=[name, mjcf] has the wrong type: it must be a mapping",
    f"{head}5\n": "The files of env=joystick robot=mine do not compose: Invalid loaded object type: int.",
    go1.removeprefix(head): "robot=mine: the first line of its file must be `# @package env.robot`.",
    f"# Mine.\n{go1}": "robot=mine: the first line of its file must be `# @package env.robot`.",
  }.items():
    mine.write_text(text)
    with pytest.raises(ConfigError, match=re.escape(message)):
      compose(["env=joystick", "robot=mine"], configs)


@pytest.mark.parametrize(
  ("file", "content", "chosen", "message"),
  [
    ("randomization/mine", "a: {mode: startup}", "randomization=mine", "randomization=mine: the first line of each"),
    ("tuned/ppo/Mine", "agent: {num_evals: 3}", "tuned=ppo/Mine", "tuned=ppo/Mine: the first line of each"),
    ("debug/mine", "agent: {num_evals: 3}", "debug=mine", "debug=mine: the first line of each of its files must be"),
    ("experiment/mine", "seed: 3", "experiment=mine", "experiment=mine: the first line of each of its files must be"),
    (
      *("experiment/mine", "defaults: [override /env: WalkerRun]", "experiment=mine"),
      "the first line of experiment/mine.yaml must be `# @package _global_`.",
    ),
    (
      *("env/Mine", "defaults: [joystick, override /robot: go1, _self_]", "env=Mine"),
      "in env/Mine.yaml write `override /robot@_global_.robot: <name>`.",
    ),
    (
      *("curriculum/mine", "# @package curriculum\ndefaults: [none, _self_]\nstages: [a, b]", "curriculum=mine"),
      "In 'curriculum/mine': Cannot merge DictConfig with ListConfig.",
    ),
  ],
)
def test_files_in_the_wrong_place_say_what_they_lack(file: str, content: str, chosen: str, message: str, configs: Path):
  (configs / f"{file}.yaml").write_text(f"{content}\n")
  with pytest.raises(ConfigError, match=re.escape(message)):
    compose([chosen], configs)


def test_an_agent_without_sizes_for_debug_says_which_file_it_lacks(configs: Path):
  (configs / "debug/sizes/_sac.yaml").unlink()
  with pytest.raises(ConfigError, match=r"debug=fast needs configs/debug/sizes/_sac\.yaml in the package of agent=sac"):
    compose(["agent=sac", "debug=fast"], configs)


MOVED = {
  "env.reward.scales.feet_slip=-1": "env.rewards.feet_slip_l2.weight",
  "env.reward.scales.alive=1": "env.rewards.constant.weight",
  "env.reward.tracking_sigma=1": "env.rewards.<term>.params",
  "env.reward.clip=null": "env.reward_clip",
  "env.noise.level=0": "env.noise_level",
  "env.noise.scales.gyro=1": "env.observations.state.<term>.noise",
  "env.noise.pose.injection=1": "env.pose_noise.injection",
  "env.obs_scales.gyro=1": "env.observations.state.<term>.scale",
  "env.obs.state=[gyro]": "env.observations.<group>.<term>",
  "env.history.joint_pos=3": "env.observations.state.<term>.history",
  "env.frames=3": "env.observation_frames",
  "env.termination.low=0.1": "env.terminations.<term>.params",
  "env.command.max=[1,1,1]": "env.commands.velocity.params.max",
  "env.command.duration=1": "env.commands.velocity.params.resample_s",
  "env.gait.frequency=[1,1]": "env.commands.gait.params.frequency",
  "env.pushes.enable=true": "env.events.push.enabled",
  "env.pushes.interval=[1,2]": "env.events.push.params.interval_s",
  "env.reset.xy=1": "env.events.<term>.params",
  "env.reward.when_moving=0.1": "env.rewards.<term>.when: {command_above: x}",
  "env.reward.functions.x=1": "env.rewards.<term>.func",
  "env.command.timer=exponential": "env.commands.velocity.params.exponential",
  "env.scene.rough.height=1": "env.scene.terrain_params.height",
  "env.reward_config.scales.tracking_lin_vel=1": "env.rewards.track_linear_velocity_exp.weight",
  "env.noise_config.level=1": "env.noise_level",
  "env.command_config.a=[1,1,1]": "env.commands.velocity.params.a",
  "env.pert_config.kick_durations=[1,2]": "env.events.push.params.duration_s",
  "env.push_config.enable=true": "env.events.push.enabled",
  "env.hand=leap_hand": "robot=<name>",
  "env.hand.name=leap": "env.robot.name",
  "env.parity=true": "env=v020/<TaskName>",
  "randomization.terms=[]": "env.events.<term>, of mode startup",
}


@pytest.mark.parametrize("line", MOVED)
def test_a_key_of_an_earlier_version_is_answered_with_todays(line: str):
  with pytest.raises(UnknownNameError) as caught:
    compose(["env=Go1JoystickFlatTerrain", line])
  key = line.split("=")[0]
  assert str(caught.value) == f"{key} is of an earlier version: write {MOVED[line]} (docs/migrate.md has all names)."


def test_a_run_of_an_earlier_version_is_refused():
  saved = {**compose(["env=CartpoleBalance"]).resolved, "randomization": {"terms": []}}
  with pytest.raises(ConfigError, match=r"is of version 0\.1"):
    from_saved(saved)


def test_a_key_that_only_a_file_sets_is_refused(configs: Path):
  (configs / "experiment/typo.yaml").write_text("# @package _global_\nagent: {lerning_rate: 1}\n")
  with pytest.raises(UnknownNameError, match=r"agent\.lerning_rate, set by a chosen file.*'agent\.learning_rate'"):
    compose(["experiment=typo"], configs)


def test_a_file_may_remove_only_a_term_that_exists(configs: Path):
  task = configs / "env" / "MyOp3.yaml"
  whole = "defaults: [Op3Joystick, _self_]\n"
  for text, said in {
    "rewards: {is_terminated: null, feet_slip_l2: null}": None,
    "rewards: {is_terminated: null, feet_slipp_l2: null}": "env.rewards.feet_slipp_l2 does not exist: .*'env",
    "observations: {state: {gyr: null}}": "env.observations.state.gyr does not exist: .*'env.observations.state.gyro'",
    "observations: {privileged: null}": "env.observations.privileged does not exist: ",
  }.items():
    task.write_text(whole + text)
    with pytest.raises(UnknownNameError, match=said) if said else contextlib.nullcontext():
      assert compose(["env=MyOp3"], configs).env.rewards.feet_slip_l2 is None
  task.write_text(whole)
  experiment = configs / "experiment" / "mine.yaml"
  experiment.write_text(
    "# @package _global_\ndefaults: [override /env: MyOp3, override /randomization: go1, _self_]\n"
    "env: {events: {base_com: null}, rewards: {alive: {weight: 2}}}\n"
  )
  assert compose(["experiment=mine"], configs).env.events.base_com is None, "randomization has it"
  (configs / "debug" / "mine.yaml").write_text("# @package _global_\nenv: {rewards: {alive: null, alife: null}}\n")
  with pytest.raises(UnknownNameError, match=r"env.rewards.alife does not exist: .*Did you mean 'env.rewards.alive'\?"):
    compose(["experiment=mine", "debug=mine"], configs)


@pytest.mark.parametrize(
  ("text", "said"),
  {
    "env: null": "env=null has the wrong type: it must be a mapping",
    "agent: 5": "agent=5 has the wrong type: it must be a mapping",
    "agent: {5: 3}": "agent.5, set by a chosen file or mapping, does not exist.",
    "env: {rewards: {5: null}}": "env.rewards.5 does not exist: env.rewards is empty.",
    "env: {rewards: {a.b: null}}": "'a.b' cannot be the name of a key or a term",
    "env: {terminations: {1: {}}}": "1 cannot be the name of a key or a term",
  }.items(),
)
def test_sections_of_a_file_are_mappings_and_keys_are_text(configs: Path, text: str, said: str):
  (configs / "experiment/wrong.yaml").write_text(f"# @package _global_\n{text}\n")
  with pytest.raises(ConfigError, match=re.escape(said)):
    compose(["experiment=wrong"], configs)


def test_a_saved_key_that_is_no_text_is_refused(run: Path):
  saved = OmegaConf.to_container(OmegaConf.load(run / "config.yaml"))
  (run / "config.yaml").write_text(config.values_to_yaml({**saved, "agent": {**saved["agent"], 5: 3}}))  # pyright: ignore
  with pytest.raises(ConfigError, match=r"agent\.5 does not exist"):
    compose([f"resume={run}"])


def test_files_that_do_not_compose(configs: Path):
  (configs / "experiment/broken.yaml").write_text("# @package _global_\ndefaults:\n  - override /env: Gone\n")
  with pytest.raises(ConfigError, match=r"experiment=broken do not compose.*env/Gone"):
    compose(["experiment=broken"], configs)


# resume and init_from


def test_resume_takes_the_runs_own_configuration(run: Path):
  resumed = compose([f"resume={run}", "hardware=cpu", "video.enable=false", "tracking.wandb.enable=true"])
  assert (resumed.name, resumed.seed, resumed.agent.num_envs) == ("CartpoleBalance", 7, 64)
  assert (resumed.hardware.platform, resumed.choices["hardware"]) == ("cpu", "cpu")
  assert (resumed.video.enable, resumed.tracking.wandb.enable) == (False, True)
  assert resumed.resume == resumed.run_dir == str(run)


def test_a_group_of_hardware_keeps_a_resumed_runs_precision_and_flags(configs: Path, tmp_path: Path):
  """Else `resume=<run> hardware=multi_node` would not end with the bits of an uninterrupted run."""
  flags = "--xla_cpu_use_fusion_emitters=false"
  line = ["env=CartpoleBalance", f"hardware.xla_flags='{flags}'", "hardware.network_precision=high"]
  started = compose(line, configs)
  run = make_run(tmp_path / "exact", started.resolved).path
  kept = compose([f"resume={run}", "hardware=gpu_x2"], configs).hardware
  assert (kept.devices, kept.xla_flags, kept.network_precision) == (2, flags, "high")
  mine = "# @package hardware\ndefaults: [gpu_x2, _self_]\nmatmul_precision: float32\n"
  (configs / "hardware/mine.yaml").write_text(mine)
  other = compose([f"resume={run}", "hardware=mine", "hardware.xla_flags="], configs).hardware
  assert (other.matmul_precision, other.xla_flags, other.network_precision) == ("float32", "", "high")


def test_a_resumed_run_may_train_longer_with_evaluations_as_far_apart(run: Path):
  before = compose([f"resume={run}"]).agent
  after = compose([f"resume={run}", f"agent.num_timesteps={3 * before.num_timesteps}"]).agent
  assert after.num_timesteps == 3 * before.num_timesteps
  assert after.num_evals - 1 == 3 * (before.num_evals - 1)
  assert dataclasses.replace(after, num_timesteps=before.num_timesteps, num_evals=before.num_evals) == before
  assert compose([f"resume={run}", f"agent.num_timesteps={10**12}"]).agent.num_evals == MOST_EVALS


@pytest.mark.parametrize(
  ("override", "parts"),
  {
    "agent.gae_lambda=0.9": ["agent.gae_lambda=0.9 cannot be given with resume", "init_from={run} starts a new run"],
    "agent.num_timesteps=9": ["agent.num_timesteps=9: {run} trains", "and can only train longer."],
    "agent.num_timesteps=1e15": ["must be a whole number from 1 to 1e+12"],
    "agent.num_timesteps=often": ["has the wrong type: it must be a whole number"],
    "env=CartpoleBalance": [
      "env=CartpoleBalance cannot be given with resume",
      "video and a larger agent.num_timesteps;",
    ],
    "seed=2": ["seed=2 cannot be given with resume"],
    "run_dir=x": ["run_dir=x cannot be given with resume"],
    "init_from={run}": ["resume={run} exclude each other"],
    "hardware.devces=1": ["hardware.devces does not exist", "'hardware.devices'"],
    "video.width=0": ["video.width=0 must be a whole number from 1 to 8192."],
  }.items(),
)
def test_what_resume_refuses(run: Path, override: str, parts: list[str]):
  with pytest.raises(ConfigError) as caught:
    compose([f"resume={run}", override.format(run=run)])
  for part in parts:
    assert part.format(run=run) in str(caught.value)


def test_a_mistyped_run_names_its_neighbour(run: Path):
  with pytest.raises(ConfigError, match="Did you mean 'run'"):
    compose([f"resume={run.parent / 'rum'}"])
  assert compose([f"init_from={run}"]).init_from == str(run)


def test_override_section():
  env = compose(["env=Go1JoystickFlatTerrain"]).env
  overrides = {"rewards.joint_power_l1.weight": -1, "commands.velocity.params.max": (1.0, 0.5, 0.5)}
  changed = config.override_section("env", env, overrides | {"rewards.action_l2": {"weight": 1}})
  assert changed["rewards"]["joint_power_l1"] == {"weight": -1.0}
  assert changed["commands"]["velocity"]["params"]["max"] == [1.0, 0.5, 0.5]
  assert list(changed["rewards"]) == [*env.rewards, "action_l2"], "in order"
  assert not math.isclose(env.rewards.joint_power_l1.weight, -1)


def test_another_randomization_replaces_the_events_that_draw_the_model() -> None:
  own = {"wind": {"mode": "startup", "func": "model_field", "params": {"field": "body_mass", "target": "trunk"}}}
  env = compose(["env=Go1JoystickFlatTerrain"]).resolved["env"]
  strong = compose(["env=Go1JoystickFlatTerrain", "randomization=go1_strong"]).resolved["env"]
  env["events"]["push"]["enabled"] = True
  changed = config.override_task({**env, "events": env["events"] | own}, ["randomization=go1_strong"])
  assert changed["events"] == {**strong["events"], "push": env["events"]["push"]}
  assert list(changed["events"]) == list(strong["events"]), "in order"
  line = ["env.events.payload.params.range=[0,3]", "randomization=go1_strong"]
  assert config.override_task(env, line)["events"]["payload"]["params"]["range"] == [0.0, 3.0]
  nominal = config.override_task(env, ["randomization=none"])["events"]
  assert nominal and not any(is_model_field(*event) for event in nominal.items())
  with pytest.raises(UnknownNameError, match="'go1_strong'"):
    config.override_task(env, ["randomization=go1_stron"])
  with pytest.raises(ConfigError, match=r"robot=g1: .* and randomization=<name>"):
    config.override_task(env, ["robot=g1"])


def test_a_run_saved_by_an_earlier_version_gets_todays_keys_but_keeps_its_choices() -> None:
  now = compose(["env=Go1JoystickFlatTerrain", "agent.num_envs=512"])
  saved = json.loads(json.dumps(now.resolved))
  del saved["hardware"]["distributed"], saved["video"]["visuals"], saved["agent"]["network"]["value_dtype"]
  del saved["env"]["settle_s"], saved["env"]["rewards"]["joint_power_l1"]
  saved["env"]["rewards"]["feet_slipp"] = None  # which a command line may no longer remove
  saved["video"]["width"] = 320
  again = from_saved(saved)
  assert again.hardware.distributed == now.hardware.distributed
  assert (again.video.visuals, again.video.width) == ("primitives", 320)
  assert again.agent.network.value_dtype == "auto" and again.agent.num_envs == 512
  assert again.env.settle_s == 0
  assert "joint_power_l1" not in again.env.rewards, "a term that the run did not have stays out"


def test_a_saved_run_whose_task_is_gone_keeps_what_it_has() -> None:
  saved = json.loads(json.dumps(compose(["env=CartpoleBalance"]).resolved))
  saved["choices"]["env"] = "NoLongerThere"
  del saved["hardware"]["distributed"]
  again = from_saved(saved)
  assert again.choices["env"] == "NoLongerThere" and again.hardware.distributed == DistributedConfig()


def test_an_entry_of_a_list_has_a_number() -> None:
  with pytest.raises(
    ConfigError, match=r"^env\.[a-z.]*max\.x=2: env\.commands\.velocity\.params\.max is a list, whose ent"
  ):
    compose(["env=Go1JoystickFlatTerrain", "env.commands.velocity.params.max.x=2"])


def test_a_short_key_may_have_a_plus() -> None:
  assert compose(["env=Go1JoystickFlatTerrain", "+terrain=stairs"]).env.scene.terrain == "stairs"
