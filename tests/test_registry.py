"""Task names to tasks: ours, and those of an outside package."""

import copy
import json
import os
import pickle
import subprocess
import sys
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from ml_collections import ConfigDict

import playground
from playground import registry, trust
from playground.config import compose, config_dict, config_roots, options
from playground.config.files import lineage
from playground.envs.c_physics import on_c_physics
from playground.envs.wrappers import wrap_for_evaluation
from playground.errors import ConfigError, UnknownNameError
from playground.randomization import Randomizer
from tests.processes import WITHOUT_WARP
from tests.sampling import some

GENERIC = [
  ["env=joystick", "robot=go1"],
  ["env=getup", "robot=go1"],
  ["env=gait_tracking", "robot=spot"],
  ["env=stand", "robot=go1", "env.support=[FR,FL]"],
]


def test_names():
  names = registry.names()
  assert names == sorted(names)
  assert {"CartpoleBalance", "Go1JoystickFlatTerrain"} <= set(names)
  assert not {"joystick", "getup", "gait_tracking", "stand", "_cartpole"} & set(names)
  assert registry.names("GO1") == [name for name in names if name.startswith("Go1")]
  assert registry.names("nothing") == []
  assert tuple(names) == registry.ALL_ENVS


def test_a_task_inherits_from_two_files_at_most():
  """A family file, or a task that it varies with its family file; each file from one other at most."""
  root = config_roots()[:1]
  for name in options("env", root):
    files = lineage("env", name, root)
    assert len(files) <= 3, files
    for path in (root[0] / f"env/{file}.yaml" for file in files):
      defaults = (yaml.safe_load(path.read_text()) or {}).get("defaults", [])
      assert sum(isinstance(entry, str) and entry != "_self_" for entry in defaults) <= 1, path


def test_config_is_a_fresh_unlocked_copy():
  config: Any = registry.config("Go1JoystickFlatTerrain")
  assert config.robot.name == "go1"
  config.rewards.joint_power_l1.weight = 5.0
  config.new = 1
  again: Any = registry.get_default_config("Go1JoystickFlatTerrain")
  assert again.rewards.joint_power_l1.weight != 5.0
  assert isinstance(registry.config("CartpoleBalance"), ConfigDict)


def test_config_is_the_tasks_own_whatever_an_algorithm_is_tuned_for():
  assert registry.config("CartpoleBalance").to_dict() == compose(["env=CartpoleBalance", "tuned=null"]).env.to_dict()


def test_load():
  env = playground.load("CartpoleBalance", overrides={"episode_length": 10, "sim_dt": 0.005})
  assert (env.episode_length, env.n_substeps, env.action_size) == (10, 2, 1)
  assert registry.load("CartpoleBalance", config_overrides={"episode_length": 11}).episode_length == 11


def test_overrides_may_be_numbers_of_numpy_and_jax():
  overrides = {"sim_dt": np.float32(0.005), "ctrl_dt": jnp.array(0.01), "vision": {"brightness": np.array([0.5, 1.0])}}
  config = registry.load("CartpoleBalance", overrides={"episode_length": np.int64(10), **overrides}).config
  np.testing.assert_allclose([config.sim_dt, config.ctrl_dt, *config.vision.brightness], [0.005, 0.01, 0.5, 1.0])
  assert config.episode_length == 10


def test_load_with_a_config_leaves_it_alone():
  config = registry.config("CartpoleBalance")
  config.episode_length = 12
  env = registry.load("CartpoleBalance", config, overrides={"ctrl_dt": 0.02})
  assert (env.episode_length, env.dt, config.ctrl_dt) == (12, 0.02, 0.01)


@pytest.mark.parametrize(
  ("name", "overrides"),
  [
    ("CartpoleBalance", {"episode_length": 10}),
    ("Go1JoystickFlatTerrain", {"rewards.joint_power_l1.weight": -5.0}),
    ("CartpoleBalanceVision", {"vision.width": 8, "vision.height": 4}),
  ],
)
def test_a_pickled_task_is_built_from_its_config(name: str, overrides: dict[str, Any]):
  env = registry.load(name, overrides=overrides)
  for task in (env, copy.copy(env), copy.deepcopy(env)):
    other = pickle.loads(pickle.dumps(task))
    assert type(other) is type(env)
    assert str(other.config.to_dict()) == str(env.config.to_dict()), "the keys keep their order"
    parts, own = other.observation_parts, env.observation_parts
    assert [(group, list(terms.items())) for group, terms in parts.items()] == [
      (group, list(terms.items())) for group, terms in own.items()
    ]
  assert copy.copy(env).mj_model is env.mj_model, "a copy builds nothing"


def test_a_changed_task_is_not_pickled():
  env = registry.load("CartpoleBalance")
  with pytest.raises(ConfigError, match="Only a task as its config describes it can be pickled"):
    pickle.dumps(env.with_settings({"rewards.none.weight": jnp.ones(())}))
  with pytest.raises(ConfigError, match="Only a task as its config describes it can be pickled"):
    pickle.dumps(on_c_physics(env))


@pytest.mark.parametrize(
  ("name", "overrides", "message"),
  [
    ("CartpolBalance", {}, r"'CartpolBalance' does not exist.*Did you mean 'CartpoleBalance'\?"),
    ("joystick", {}, "'joystick' does not exist"),
    (None, {}, "Task None does not exist; `playground list`"),
    ("CartpoleBalance", ["ctrl_dt=1"], r"^overrides=\['ctrl_dt=1'\] must be a dict of dotted keys, such as \{'ep"),
    ("CartpoleBalance", {"episode_lenth": 1}, r"env\.episode_lenth does not exist.*'env\.episode_length'"),
    ("Go1JoystickFlatTerrain", {"rewards.joint_powr_l1.weight": 1}, "Did you mean 'joint_power_l1'"),
    ("CartpoleBalance", {"ctrl_dt": "slow"}, r"env\.ctrl_dt=slow .* must be a number"),
    ("CartpoleBalance", {"ctrl_dt": 0.015}, r"env\.ctrl_dt=0\.015 must be a whole multiple of env\.sim_dt=0\.01\."),
    ("CartpoleBalance", {"action_repeat": 9, "episode_length": 8}, r"env\.action_repeat=9 is longer than an episode: "),
    ("CartpoleBalance", {"vision.brightness": {}}, r"^env\.vision\.brightness=\{\}: Cannot merge"),
    ("CartpoleBalance", {"episode_length": 0}, r"env\.episode_length=0 must be a whole number from 1"),
  ],
)
def test_load_refuses(name: Any, overrides: Any, message: str):
  with pytest.raises(ConfigError, match=message):
    registry.load(name, overrides=overrides)


@pytest.mark.parametrize(
  ("task", "message"),
  [
    ("playground.envs.dm_control.cartpole:Cartpol", "has no Cartpol. Did you mean 'Cartpole'"),
    ("playground.envs.dm_control.cartpole", "not of the form module:name"),
    ("playground.envs.gone:Task", r"there is no module playground\.envs\.gone \(installed, or on PYTHONPATH\)"),
    ("gone.deep:Task", "may only name code of playground, which gone is not"),
    (":Task", "not of the form module:name"),
    ("playground.envs.base:Env", "is incomplete: the class lacks action_to_ctrl, post_step, reset."),
    ("playground.envs.base:State", "is no task"),
    ("playground.envs.wrappers:where_done", "is no task"),
  ],
)
def test_a_task_that_cannot_be_imported(task: str, message: str):
  with pytest.raises(ConfigError, match=message):
    registry.task_class(task)


def test_an_import_error_inside_a_tasks_module_is_not_hidden(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
  found = {
    "import os\nimport surely_not_installed": "2: ModuleNotFoundError: No module named 'surely_not_installed'",
    "\ndef broken(:": "2: SyntaxError: invalid syntax",
    "import os\n\nos.nothing": "3: AttributeError: module 'os' has no attribute 'nothing'",
  }
  monkeypatch.syspath_prepend(tmp_path)
  for number, (text, why) in enumerate(found.items()):
    name = f"needy_task_{number}"
    (tmp_path / f"{name}.py").write_text(f"{text}\n")
    monkeypatch.setattr(trust, "_named", {name})
    with pytest.raises(ConfigError) as error:
      registry.task_class(f"{name}:Task")
    assert str(error.value) == f"env.task={name}:Task: importing {name} fails in {name}.py:{why}."
    assert error.value.__cause__ is not None


def test_domain_randomizer():
  assert registry.get_domain_randomizer("CartpoleBalance") is None
  with pytest.raises(UnknownNameError):
    registry.get_domain_randomizer("Nothing")
  randomize = registry.get_domain_randomizer("Go1JoystickFlatTerrain")
  assert randomize is not None
  model = registry.load("Go1JoystickFlatTerrain").mjx_model
  batch, in_axes = randomize(model, jax.random.split(jax.random.PRNGKey(0), 3))
  assert batch.body_mass.shape == (3, *model.body_mass.shape)
  assert (in_axes.body_mass, in_axes.body_pos) == (0, None)


def test_lazy_package():
  assert playground.registry is registry
  assert playground.wrap_for_brax_training.__module__ == "playground.envs.wrappers"
  with pytest.raises(AttributeError, match="nothing"):
    _ = playground.nothing  # pyright: ignore[reportAttributeAccessIssue]


# Open terms


def built(*overrides: str, task: str = "Go1JoystickFlatTerrain") -> Any:
  return registry.build(compose([f"env={task}", *overrides, "tuned=null"]).env)


def test_terms_from_the_command_line() -> None:
  env = built(
    "env.rewards.joint_deviation_l2.weight=-0.1",
    "env.rewards.knees={func: joint_deviation_l1, weight: -0.5, params: {joints: .*_calf_joint}}",
    "env.rewards.feet_slip_l2=null",
    "env.rewards.pose_exp.weight=0",
    "env.terminations.base_height_below={params: {limit: 0.1}}",
    "env.terminations.power_above.params.limit=400",
    "env.observations.state.joint_vel.history=3",
    "env.observations.state.base_height={}",
    "env.events.reset_joints_by_scale={mode: reset, params: {scale: [0.9, 1.1]}}",
  )
  rewards = {term.name: term for term in env.rewards.terms}
  assert rewards["joint_deviation_l2"].options.weight == -0.1
  assert (rewards["knees"].func.__name__, rewards["knees"].params) == (
    "joint_deviation_l1",
    {"joints": ".*_calf_joint"},
  )
  assert not {"feet_slip_l2", "pose_exp"} & set(rewards)
  assert [term.name for term in env.terminations.terms] == ["fell_over", "base_height_below", "power_above"]
  assert env.observation_size == {"state": (48 + 24 + 1,), "privileged_state": (123 + 24 + 1,)}
  state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
  assert {"reward/knees", "termination/power_above"} <= set(state.metrics)


def test_terms_of_any_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  (tmp_path / "my_rewards.py").write_text("def mine(c, factor: float = 1.0):\n  return factor * c.base_height\n")
  monkeypatch.syspath_prepend(tmp_path)
  override = "env.rewards.mine={func: 'my_rewards:mine', weight: 0.5, params: {factor: 2}}"
  with pytest.raises(ConfigError, match=r"^env\.rewards\.mine\.func=my_rewards:mine is refused: .* trust=my_rewards"):
    built(override)
  monkeypatch.setattr(trust, "_named", {"my_rewards"})
  env = built(override)
  assert (env.rewards.terms[-1].name, env.rewards.terms[-1].params) == ("mine", {"factor": 2})
  assert "reward/mine" in jax.eval_shape(env.reset, jax.random.PRNGKey(0)).metrics


@pytest.mark.parametrize(
  ("method", "message"),
  [
    (
      "def step(self, *args):\n    after = super().step(*args)\n    return after.replace(obs=after.obs[1:])",
      "Wrong: obs of the state is float32[5] at the start of an episode, and float32[4] after a step: make",
    ),
    (
      "def step(self, *args):\n    s = super().step(*args)\n    return s.replace(info={**s.info, 'age': s.done})",
      "Wrong: info/age of the state is missing at the start of an episode, and float32[] after a step: make them the",
    ),
    (
      "def action_to_ctrl(self, state, action):\n    return self.gain * action",
      "env.task=wrong_task:Wrong: wrong_task.py:6: AttributeError: 'Wrong' object has no attribute 'gain'",
    ),
    (
      "def action_to_ctrl(self, state, action):\n    return jnp.zeros(3)",
      "Wrong.action_to_ctrl returns shape [3], and",
    ),
  ],
)
def test_mistakes_of_a_task_of_any_package_show_before_anything_is_compiled(
  method: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  begin = (
    "import jax.numpy as jnp\nfrom playground.envs.dm_control.cartpole import Cartpole\n\nclass Wrong(Cartpole):\n"
  )
  (tmp_path / "wrong_task.py").write_text(f"{begin}  {method}\n")
  monkeypatch.syspath_prepend(tmp_path)
  monkeypatch.delitem(sys.modules, "wrong_task", raising=False)
  monkeypatch.setattr(trust, "_named", {"wrong_task"})
  env = registry.build(config_dict({**registry.config("CartpoleBalance").to_dict(), "task": "wrong_task:Wrong"}))
  with pytest.raises(ConfigError) as error:
    env.trace()
  assert str(error.value).startswith(message)


def test_a_task_of_any_package_limits_its_own_keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  (tmp_path / "my_task.py").write_text("""
from playground.envs.dm_control.cartpole import Cartpole
from playground.limits import Positive

class Keys:
  rail_length: Positive
  tags: list[str]

class Long(Cartpole):
  keys = Keys
""")
  monkeypatch.syspath_prepend(tmp_path)
  monkeypatch.setattr(trust, "_named", {"my_task"})
  config = {**registry.config("CartpoleBalance").to_dict(), "task": "my_task:Long", "tags": ["a"]}
  build: Any = lambda values: registry.build(config_dict(values))
  with pytest.raises(ConfigError, match=r"^env\.rail_length is missing: Long needs it"):
    build(config)
  with pytest.raises(ConfigError, match=r"^env\.rail_length=-1 must be a number above 0"):
    build(config | {"rail_length": -1})
  with pytest.raises(ConfigError, match=r"^env\.tags=3 must be a list of texts"):
    build(config | {"rail_length": 2.0, "tags": 3})
  assert build(config | {"rail_length": 2.0}).config.rail_length == 2.0
  with pytest.raises(UnknownNameError, match=r"^env\.rail_lenght is no key of Long: .* Did you mean 'rail_length'"):
    build(config | {"rail_length": 2.0, "rail_lenght": 3.0})


@pytest.mark.parametrize("wrong", ["terminatons", "episod_length", "njmaxx"])
def test_a_misspelt_key_of_a_tasks_file_is_one_sentence(wrong: str) -> None:
  config = registry.config("CartpoleBalance").to_dict() | {wrong: {}}
  with pytest.raises(UnknownNameError, match=rf"^env\.{wrong} is no key of Cartpole: .* Did you mean"):
    registry.build(config_dict(config))


def test_a_file_without_a_task_is_one_sentence() -> None:
  with pytest.raises(ConfigError, match=r"^env\.task is missing"):
    registry.build(config_dict({"ctrl_dt": 0.01}))


@pytest.mark.parametrize(
  ("override", "message"),
  [
    ("rewards.hip_splay.weight=-0.1", "no function 'hip_splay' is registered.* Did you mean 'joint_deviation_l2'?"),
    ("rewards.joint_devation_l2.weight=-0.1", "Did you mean 'joint_deviation_l"),
    ("rewards.action_l2={}", r"env\.rewards\.action_l2\.weight is missing: every term of env\.rewards has one"),
    ("rewards.action_l2={weight: {}}", r"env\.rewards\.action_l2\.weight=\{\} must be a number"),
    ("rewards.action_l2.weight=big", r"env\.rewards\.action_l2\.weight=big must be a number from"),
    ("rewards.feet_slip_l2.params.joints=a", r"params\.joints does not exist: feet_slip_l2 takes no parameters"),
    ("rewards.feet_clearance.params.targt=1", r"takes target\. Did you mean 'target'"),
    ("rewards.feet_clearance.params.target=-1", r"params\.target=-1 must be a number above 0 and at most"),
    ("rewards.joint_deviation_l1={weight: 1, params: {joints: knee}}", "'knee' matches no joint of the robot and is"),
    (
      "rewards.joint_deviation_l1={weight: 1, params: {joints: []}}",
      r"params\.joints=\[\] must name one joint or more",
    ),
    ("rewards.feet_slip_l2.when={command_abve: 1}", r"when\.command_abve does not exist.*'command_above'"),
    ("rewards.mine={func: 'math:sqrt', weight: 1}", r"env\.rewards\.mine\.func=math:sqrt is refused"),
    ("rewards.action_rate_l2.func=3", r"env\.rewards\.action_rate_l2\.func=3 must be text"),
    ("terminations.base_height_below={}", r"params\.limit is missing: base_height_below needs it"),
    ("observations.state.joint_vel.histry=3", r"joint_vel\.histry does not exist.*'history'"),
    ("observations.state.joint_vel.history=0", r"history=0 must be a whole number from 1"),
    ("observations.state.linvel.noise.uniform=[2,1]", "linvel.noise.uniform has 2 numbers, which do not divide its 3"),
    ("observations.state.linvel.scale=[2,1]", "linvel.scale has 2 numbers, which do not divide its 3"),
    ("observations.state.linvel.noise.uniform=-1", r"noise\.uniform=-1 must be a number or a list of numbers from 0"),
    ("observations.state.linvel.delay=[2,1]", r"delay=\[2, 1\] must be 2 whole numbers from 0 to 1000, the first not"),
    ("observations.state.last_act=[]", r"env\.observations\.state\.last_act=\[\] has the wrong type: it must be a map"),
    ("events.push.enabled=text", r"env\.events\.push\.enabled=text must be true or false"),
    ("events.payload.params.range={}", r"^env\.events\.payload\.params\.range=\{\}: Cannot merge"),
    ("observations.state.feet_ps={}", "no function 'feet_ps' is registered.* Did you mean 'feet_pos'"),
    ("events.pussh.enabled=false", r"events\.pussh: no function 'pussh' is registered.* Did you mean 'push'"),
    ("events.paylod.enabled=false", "Did you mean 'payload'"),
    ("commands.velocty.params.max=[1,1,1]", "Did you mean 'velocity'"),
    ("observations.state.gyroo.noise.uniform=1", "Did you mean 'gyro'"),
    ("events.push.mode=reset", r"env\.events\.push\.mode=reset: PushByForce is for mode: interval"),
    ("commands.velocity.params.max=[1,2]", r"params\.max=\[1, 2\] must be 3 numbers from"),
    ("rewards.object_lifted={weight: 1, params: {height: 0.1}}", r"object_lifted needs 'object_pos', which this task"),
    ("events.reset_cube_pose={mode: reset, params: {pos: [0, 0, 1], spread: 0}}", "reset_cube_pose needs 'cube_qpos'"),
  ],
)
def test_a_term_that_is_none_is_one_sentence(override: str, message: str) -> None:
  with pytest.raises(ConfigError, match=message) as caught:
    env = built(f"env.{override}")
    state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
    jax.eval_shape(env.step, state, jnp.zeros(env.action_size))
  assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
  ("overrides", "message"),
  [
    (["env=joystick", "robot=leap_hand"], r"env\.robot\.root is missing: robot=leap_hand is no robot on legs"),
    (["env=LeapCubeReorient", "robot=go1"], r"env\.robot\.cube is missing: robot=go1 is no hand"),
    (["env=PandaPickCube", "env.commands.gait={params: {modes: [walk]}}"], r"env\.commands\.gait needs 'gait'"),
    (["env=PointMass", "env.events.push.enabled=true"], r"env\.events\.push\.mode=null: DM Control's tasks take only"),
    (["env=PointMass", "env.rewards.joint_vel_l2.weight=1"], r"env\.rewards\.joint_vel_l2 needs 'qvel', which this"),
  ],
)
def test_a_robot_or_a_term_of_another_kind_of_task_is_one_sentence(overrides: list[str], message: str) -> None:
  with pytest.raises(ConfigError, match=message):
    jax.eval_shape(registry.build(compose([*overrides, "tuned=null"]).env).reset, jax.random.PRNGKey(0))


# Every key of an env config is read: one that nobody reads is a typo that nobody notices.


class Recorder(Mapping[str, Any]):
  """A config that notes the dotted names of the values that were read."""

  def __init__(self, config: Mapping[str, Any], read: set[str], prefix: str = ""):
    self._config, self._read, self._prefix = config, read, prefix

  def __getitem__(self, key: str) -> Any:
    value, name = self._config[key], f"{self._prefix}{key}"
    if isinstance(value, Mapping) and value:
      return Recorder(value, self._read, f"{name}.")
    self._read.add(name)
    return value

  def __getattr__(self, key: str) -> Any:
    if key.startswith("_") or key not in self._config:
      raise AttributeError(key)
    return self[key]

  def __iter__(self) -> Iterator[str]:
    return iter(self._config)

  def __len__(self) -> int:
    return len(self._config)

  def to_dict(self) -> dict[str, Any]:
    return {key: v.to_dict() if isinstance(v, Recorder) else v for key, v in self.items()}


def _leaves(config: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
  for key, value in config.items():
    if isinstance(value, Mapping) and value:
      yield from _leaves(value, f"{prefix}{key}.")
    else:
      yield f"{prefix}{key}"


OF_TASKS = [[f"env={name}"] for name in registry.names()]


@pytest.mark.parametrize("overrides", [*some(OF_TASKS, 3), *GENERIC], ids=" ".join)
def test_every_key_is_read_and_a_step_keeps_the_states_structure(overrides: list[str]):
  config = compose([*overrides, "tuned=null"]).resolved["env"]
  read: set[str] = set()
  recorder: Any = Recorder(config, read)
  env: Any = registry.build(recorder)
  Randomizer(env.mj_model, recorder.get("events"))
  assert env.mj_model.ncam  # for env.vision
  env.physics = env.physics.without_dynamics()
  settings = env.settings_of(config_dict(config))  # as arguments: no branch in Python may depend on one
  episodes = lambda values: wrap_for_evaluation(env.with_settings(values))
  keys, actions = jax.random.split(jax.random.PRNGKey(0), 2), jnp.zeros((2, env.action_size))
  state = jax.eval_shape(lambda keys, values: episodes(values).reset(keys), keys, settings)
  after = jax.eval_shape(lambda state, values: episodes(values).step(state, actions), state, settings)
  assert jax.tree.structure(after) == jax.tree.structure(state)
  assert jax.tree.map(lambda x: (x.shape, x.dtype), after) == jax.tree.map(lambda x: (x.shape, x.dtype), state)
  # The robot's description serves many tasks, none of which needs all of it; a task without a camera has no image.
  others = ("robot.",) if config["vision"]["enable"] else ("robot.", "vision.")
  unread = [key for key in _leaves(config) if key not in read and key != "task" and not key.startswith(others)]
  assert not unread


# Outside packages


@pytest.fixture
def site(tmp_path: Path) -> Path:
  """A folder of installed packages: one with a task, one that is broken, one without tasks."""
  site = tmp_path / "it's a site"
  files = {
    "tiny/__init__.py": "import pathlib\ndef configs():\n  return pathlib.Path(__file__).parent / 'configs'\n",
    "tiny/task.py": """
      from playground.envs.dm_control.cartpole import Cartpole
      class Keys:
        bonus: float
      class Tiny(Cartpole):
        keys = Keys
        def __init__(self, config):
          super().__init__(config)
          self.bonus = config.bonus
      """,
    "tiny/configs/env/TinyBalance.yaml": """
      defaults:
        - CartpoleBalance
        - _self_
      task: tiny.task:Tiny
      bonus: 1.5
      """,
    "tiny/configs/env/TinyWalk.yaml": """
      defaults:
        - joystick
        - override /robot@_global_.robot: go1
        - _self_
      """,
    "tiny/configs/robot/bare_go1.yaml": """
      # @package env.robot
      defaults:
        - go1
        - _self_
      pd: null
      """,
    "tiny/configs/tuned/ppo/TinyBalance.yaml": "# @package _global_\nagent: {num_evals: 3}\n",
    "tiny/configs/experiment/tiny.yaml": "# @package _global_\ndefaults:\n  - override /env: TinyBalance\n",
    "empty.py": "HERE = '/nowhere'\n",
    "tiny-1.0.dist-info/entry_points.txt": """
      [playground.tasks]
      tiny = tiny:configs
      broken = not_there:CONFIGS
      empty = empty:HERE
      """,
    "tiny-1.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: tiny\nVersion: 1.0\n",
  }
  for name, text in files.items():
    path = site / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(textwrap.dedent(text).lstrip("\n"))
  return site


def test_an_outside_package_adds_tasks(site: Path):
  code = f"""
    import sys, warnings
    sys.path.append({str(site)!r})
    with warnings.catch_warnings(record=True) as caught:
      warnings.simplefilter("always")
      import playground
      names = playground.registry.names("tiny")
      assert names == playground.registry.names("Tiny") == ["TinyBalance", "TinyWalk"], names
    messages = sorted(str(warning.message) for warning in caught)
    assert len(messages) == 2, messages  # each once
    assert "'broken'" in messages[0] and "not_there" in messages[0], messages
    assert "'empty'" in messages[1] and "holds no file such as env/<TaskName>.yaml" in messages[1], messages
    from playground.config import compose
    run = compose(["experiment=tiny", "env.bonus=2"])
    assert (run.name, run.choices["tuned"], run.agent.num_evals) == ("tiny", "ppo/TinyBalance", 3), run
    assert run.env.bonus == 2.0 and run.env.episode_length == 1000
    assert compose(["env=TinyWalk"]).env.robot.name == "go1"
    assert playground.load("TinyBalance", overrides={{"bonus": 2.5}}).bonus == 2.5
    bare = playground.registry.build(compose(["env=joystick", "robot=bare_go1"]).env).mj_model
    assert (bare.actuator_gainprm[:, 0] == 35).all(), "pd: null keeps the gains of the MJCF"
    from playground.cli.list_tasks import list_tasks
    list_tasks(names, {{}}, as_json=True)
    sys.argv = ["playground-run", "experiment=tiny", "--cfg", "job", "--package", "env"]
    from playground.cli.run import main
    main()
    """
  env = os.environ | WITHOUT_WARP
  done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], env=env, capture_output=True, text=True)
  assert done.returncode == 0, done.stderr
  assert "bonus: 1.5" in done.stdout
  listed, _ = json.JSONDecoder().raw_decode(done.stdout)
  assert [(row["task"], row["robot"], row["agent"], row["backend"]) for row in listed] == [
    ("TinyBalance", "", "ppo", "jax"), ("TinyWalk", "go1", "ppo", "jax"),
  ]  # fmt: skip


def test_a_file_of_an_outside_package_with_a_name_of_ours_is_told(tmp_path: Path) -> None:
  file = tmp_path / "site/env/CartpoleBalance.yaml"
  file.parent.mkdir(parents=True)
  file.write_text("task: mine:Mine\n")
  (tmp_path / "mine.py").write_text(f"CONFIGS = {str(tmp_path / 'site')!r}\n")
  info = tmp_path / "mine-1.0.dist-info"
  info.mkdir()
  (info / "entry_points.txt").write_text("[playground.tasks]\nmine = mine:CONFIGS\n")
  (info / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
  code = f"import sys; sys.path.append({str(tmp_path)!r}); import playground; print(playground.registry.names('Cart'))"
  done = subprocess.run([sys.executable, "-c", code], env=os.environ | WITHOUT_WARP, capture_output=True, text=True)
  assert done.returncode == 0, done.stderr
  assert "'mine' of playground.tasks: env/CartpoleBalance.yaml is not used, since another package has" in done.stderr
