"""Limits of numbers: every key that takes one has them, and they allow what they say."""

import dataclasses
import inspect
import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import pytest
import yaml

from playground.config import compose, compose_settings, config_roots, override_section
from playground.config.definitions import RunSettings, defined, definition
from playground.config.schema import is_of_terms
from playground.config.sweep_options import SweepConfig
from playground.envs.options import VisionConfig
from playground.errors import ConfigError
from playground.limits import MOST, SEED, Limit, count, positive, span
from playground.mdp.terms import MODULES, registered
from playground.settings import defaults, plain, settings

# Folders of configs/ whose files define keys, and the section that they are of; the other keys are classes'.
SECTIONS = {"env": "env", "robot": "env.robot"}


def leaves(node: Mapping[str, Any], key: str) -> Iterator[tuple[str, Any]]:
  for name, value in node.items():
    inner = f"{key}.{name}" if key else str(name)
    if isinstance(value, Mapping) and value:
      yield from leaves(value, inner)
    elif name != "defaults":
      yield inner, value


def takes_a_number(value: Any) -> bool:
  """Whether a default is a number, has numbers or says nothing of what may stand there (null, an empty list)."""
  if isinstance(value, list):
    return not value or any(map(takes_a_number, value))
  return value is None or (isinstance(value, int | float) and not isinstance(value, bool))


def test_every_number_of_a_file_has_limits() -> None:
  root, missing = config_roots()[0], []
  for path, section in ((path, section) for folder, section in SECTIONS.items() for path in (root / folder).glob("*")):
    for key, value in leaves(yaml.safe_load(path.read_text()) or {}, section) if path.suffix == ".yaml" else ():
      setting = definition(key, {})
      known = setting is not None and (setting.limit or setting.text_depth is not None)
      if takes_a_number(value) and not is_of_terms(key) and not known:
        missing.append(f"{path.name}: {key}={value}")
  assert not missing, "give these a limit in playground/envs/options.py, or say text there"


def classes() -> dict[str, type]:
  grouped = {f"{g}={name}": cls for g, options in defined().items() for name, cls in options.items()}
  return {**grouped, "run": RunSettings, "sweep": SweepConfig}


@pytest.mark.parametrize("name", classes())
def test_every_setting_of_a_class_has_limits_and_help(name: str) -> None:
  for setting in settings(classes()[name]).values():
    if isinstance(setting.default, dict) and setting.default:
      continue  # a nested class
    text = setting.choices is not None or setting.text_depth is not None
    assert text or setting.limit or not takes_a_number(setting.default), f"{setting.name} has no limit"
    unset = setting.default is None or setting.default is dataclasses.MISSING
    assert setting.limit is None or unset or setting.limit.allows(setting.default), setting.name
    assert setting.choices is None or setting.default in setting.choices, setting.name
    assert setting.help and len(setting.help) <= 110, f"{setting.name} has no line of help"


def run(option: str) -> dict[str, Any]:
  return compose([option, "env=CartpoleBalance", "tuned=null"]).resolved


@pytest.mark.parametrize("option", [f"{g}={name}" for g, found in defined().items() for name in found])
def test_the_command_line_has_the_defaults_of_the_classes(option: str) -> None:
  group, _, name = option.partition("=")
  if group in ("launcher", "search"):
    assert plain(getattr(compose_settings([option]), group)) == defaults(defined()[group][name])
  else:
    section = {key: value for key, value in run(option)[group].items() if key != "name"}
    assert section == defaults(defined()[group][name])


def test_a_run_has_the_defaults_of_its_class() -> None:
  resolved = compose(["env=CartpoleBalance"]).resolved
  expected = defaults(RunSettings)
  assert {key: resolved[key] for key in expected if key != "env"} == {k: v for k, v in expected.items() if k != "env"}
  assert resolved["env"]["vision"] == defaults(VisionConfig)
  assert plain(compose_settings([])).items() >= defaults(SweepConfig).items()


@pytest.mark.parametrize("kind", MODULES)
def test_every_parameter_of_a_term_says_what_it_is(kind: str) -> None:
  """Its annotation is its limit (`playground.mdp.terms`)."""
  skip = {"events": 3, "commands": 0}.get(kind, 1)
  for name, func in registered(kind).items():
    arguments = list(inspect.signature(func).parameters.values())[0 if isinstance(func, type) else skip :]
    assert all(argument.annotation is not argument.empty for argument in arguments), name


def test_a_key_without_limits_of_its_own_takes_finite_numbers() -> None:
  section = {"new": {"key": 1.0, "list": [1.0]}}
  assert override_section("env", section, {"new.key": -5, "new.list": [2, 1]})["new"] == {"key": -5.0, "list": [2, 1]}
  for key, value in {"new.key": math.inf, "new.list": [1, math.inf]}.items():
    with pytest.raises(ConfigError, match=rf"env.{key}=.* must be a number or a list of numbers from -10+ to 10+\."):
      override_section("env", section, {key: value})


@pytest.mark.parametrize(
  ("limit", "good", "bad", "said"),
  [
    (
      Limit(),
      [0, -MOST, 1.5],
      [math.inf, math.nan, 1e39, 10**400, "1", True, None, [1]],
      "a number from -1000000000 to",
    ),
    (positive(1), [1, 1e-9], [0, -1, 1.1], "a number above 0 and at most 1"),
    (SEED, [0, 2**32 - 1], [-1, 2**32, 0.5], "a whole number from 0 to 4294967295"),
    (count(1, 3), [1, 3], [0, 4, 2.5, 2.0], "a whole number from 1 to 3"),
    (
      span(),
      [[0, 0], [1, 2]],
      [[2, 1], [1], [1, 2, 3], [-1, 1], 1, []],
      "2 numbers from 0 to 1000000000, the first not",
    ),
    (positive().each, [1, [1, 2]], [0, [], [0], [[1]], ["a"]], "a number or a list of numbers above 0 and at most"),
  ],
)
def test_limits(limit: Limit, good: list[Any], bad: list[Any], said: str) -> None:
  assert [value for value in good if not limit.allows(value)] == []
  assert [value for value in bad if limit.allows(value)] == []
  assert str(limit).startswith(said)


@pytest.mark.parametrize(
  "line",
  [
    "env.noise_level=-1",
    "env.noise_level=inf",
    "env.observation_frames=0",
    "env.robot.pd.kp=-1",
    "env.robot.pd.kp=inf",
    "env.robot.pd.damping=text",
    "agent.reward_scaling=0",
    "agent.reward_scaling=-1",
    "agent.reward_scaling=inf",
    "agent.learning_rate=1e39",
    "agent.num_evals=1e9",
    "agent.num_envs=1e400",
    "hardware.distributed.lost_after=1e7",  # ms in a C integer
    "seed=4294967296",
    "seed=1e30",
    f"seed={10**400}",
    f"agent.reward_scaling={10**400}",
  ],
)
def test_numbers_that_cannot_work_are_refused(line: str) -> None:
  with pytest.raises(ConfigError) as caught:
    compose(["env=Go1JoystickFlatTerrain", *line.split()])
  assert line.split("=")[0] in str(caught.value)


def test_a_sweeps_numbers_have_limits() -> None:
  for line in ("search=optuna search.seed=4294967296", "launcher.grace=-1", "search=optuna search.trials=1e30"):
    with pytest.raises(ConfigError, match="must be a"):
      compose_settings(line.split())


def test_a_field_that_only_changes_a_default_inherits_limit_and_help() -> None:
  @dataclasses.dataclass(frozen=True)
  class Base:
    width: Annotated[int, count(1, 64), "pixels"] = 8
    height: Annotated[int, count(1, 64), "pixels"] = 8

  @dataclasses.dataclass(frozen=True)
  class Wide(Base):
    width: int = 64
    height: Annotated[int, count(0, 8), "rows"] = 4

  width, height = settings(Wide).values()
  assert (width.default, width.limit, width.help) == (64, count(1, 64), "pixels")
  assert (height.default, height.limit, height.help) == (4, count(0, 8), "rows")
