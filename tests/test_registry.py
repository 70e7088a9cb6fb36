"""Task names to tasks: ours, and those of an outside package."""

import subprocess
import sys
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import pytest
from ml_collections import ConfigDict

import playground
from playground import registry
from playground.config import compose
from playground.errors import ConfigError, UnknownNameError

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


def test_config_is_a_fresh_unlocked_copy():
  config: Any = registry.config("Go1JoystickFlatTerrain")
  assert config.robot.name == "go1"
  config.reward.scales.energy = 5.0
  config.new = 1
  again: Any = registry.get_default_config("Go1JoystickFlatTerrain")
  assert again.reward.scales.energy != 5.0
  assert isinstance(registry.config("CartpoleBalance"), ConfigDict)


def test_config_is_the_tasks_own_whatever_an_algorithm_is_tuned_for():
  assert registry.config("CartpoleBalance").to_dict() == compose(["env=CartpoleBalance", "tuned=null"]).env.to_dict()


def test_load():
  env = playground.load("CartpoleBalance", overrides={"episode_length": 10, "sim_dt": 0.005})
  assert (env.episode_length, env.n_substeps, env.action_size) == (10, 2, 1)
  assert registry.load("CartpoleBalance", config_overrides={"episode_length": 11}).episode_length == 11


def test_load_with_a_config_leaves_it_alone():
  config = registry.config("CartpoleBalance")
  config.episode_length = 12
  env = registry.load("CartpoleBalance", config, overrides={"ctrl_dt": 0.02})
  assert (env.episode_length, env.dt, config.ctrl_dt) == (12, 0.02, 0.01)


@pytest.mark.parametrize(
  ("name", "overrides", "message"),
  [
    ("CartpolBalance", {}, r"'CartpolBalance' does not exist.*Did you mean 'CartpoleBalance'\?"),
    ("joystick", {}, "'joystick' does not exist"),
    ("CartpoleBalance", {"episode_lenth": 1}, r"env\.episode_lenth does not exist.*'env\.episode_length'"),
    ("Go1JoystickFlatTerrain", {"reward.scales.enrgy": 1}, r"Did you mean 'env\.reward\.scales\.energy'"),
    ("CartpoleBalance", {"ctrl_dt": "slow"}, r"env\.ctrl_dt=slow .* must be a number"),
    ("CartpoleBalance", {"episode_length": 0}, r"env\.episode_length=0 must be a number above 0"),
  ],
)
def test_load_refuses(name: str, overrides: dict[str, Any], message: str):
  with pytest.raises(ConfigError, match=message):
    registry.load(name, overrides=overrides)


@pytest.mark.parametrize(
  ("task", "message"),
  [
    ("playground.envs.dm_control.cartpole:Cartpol", "has no class Cartpol. Did you mean 'Cartpole'"),
    ("playground.envs.dm_control.cartpole", "has no class"),
    ("playground.envs.gone:Task", "there is no module playground.envs.gone"),
    ("gone.deep:Task", "there is no module gone"),
    (":Task", "not of the form module:Class"),
  ],
)
def test_a_task_that_cannot_be_imported(task: str, message: str):
  with pytest.raises(ConfigError, match=message):
    registry.task_class(task)


def test_an_import_error_inside_a_tasks_module_is_not_hidden(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
  (tmp_path / "needy_task.py").write_text("import surely_not_installed\n")
  monkeypatch.syspath_prepend(tmp_path)
  with pytest.raises(ModuleNotFoundError, match="surely_not_installed"):
    registry.task_class("needy_task:Task")


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


@pytest.mark.parametrize("overrides", [*([f"env={name}"] for name in registry.names()), *GENERIC], ids=" ".join)
def test_every_key_is_read_and_a_step_keeps_the_states_structure(overrides: list[str]):
  config = compose([*overrides, "tuned=null"]).resolved["env"]
  read: set[str] = set()
  recorder: Any = Recorder(config, read)
  env = registry.build(recorder)
  assert env.mj_model.ncam  # for env.vision
  state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
  after = jax.eval_shape(env.step, state, jnp.zeros(env.action_size))
  assert jax.tree.structure(after) == jax.tree.structure(state)
  assert jax.tree.map(lambda x: (x.shape, x.dtype), after) == jax.tree.map(lambda x: (x.shape, x.dtype), state)
  # The robot's description serves many tasks, none of which needs all of it; a task without a camera has no picture.
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
      class Tiny(Cartpole):
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
    assert "'empty'" in messages[1] and "holds no env/<TaskName>.yaml" in messages[1], messages
    from playground.config import compose
    run = compose(["experiment=tiny", "env.bonus=2"])
    assert (run.name, run.choices["tuned"], run.agent.num_evals) == ("tiny", "ppo/TinyBalance", 3), run
    assert run.env.bonus == 2.0 and run.env.episode_length == 1000
    assert compose(["env=TinyWalk"]).env.robot.name == "go1"
    assert playground.load("TinyBalance", overrides={{"bonus": 2.5}}).bonus == 2.5
    sys.argv = ["playground-run", "experiment=tiny", "--cfg", "job", "--package", "env"]
    from playground.cli.run import main
    main()
    """
  done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True)
  assert done.returncode == 0, done.stderr
  assert "bonus: 1.5" in done.stdout
