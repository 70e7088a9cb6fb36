"""Limits of numbers: every key that takes one has them, and they allow what they say."""

import inspect
import math
from collections.abc import Iterator, Mapping
from typing import Any

import pytest
import yaml

from playground.config import compose, compose_settings, config_roots, override_section
from playground.config.limits import _OF_TERMS as OF_TERMS
from playground.config.limits import limit_of, text_depth
from playground.errors import ConfigError
from playground.learning.hyperparameters import agent_names
from playground.limits import MOST, SEED, Limit, count, positive, span
from playground.mdp.terms import MODULES, registered

# Folders of configs/ and the section that their files are of.
SECTIONS = {"agent": "agent", "env": "env", "robot": "env.robot", "hardware": "hardware", "tracking": "tracking"}
SECTIONS |= {"launcher": "launcher", "search": "search"}


def leaves(node: Mapping[str, Any], key: str) -> Iterator[tuple[str, Any]]:
  for name, value in node.items():
    inner = f"{key}.{name}" if key else str(name)
    if isinstance(value, Mapping) and value:
      yield from leaves(value, inner)
    elif name != "defaults":
      yield inner, value


def defined() -> Iterator[tuple[str, str, Any]]:
  """File, dotted key and value of all that our files define."""
  root = config_roots()[0]
  files = [(root / "config.yaml", ""), (root / "sweep.yaml", ""), (root / "curriculum/none.yaml", "curriculum")]
  files += [(path, section) for folder, section in SECTIONS.items() for path in (root / folder).glob("*.yaml")]
  for path, section in files:
    for key, value in leaves(yaml.safe_load(path.read_text()) or {}, section):
      if not key.startswith(("hydra.", "defaults")) and not OF_TERMS.match(key):
        yield f"{path.parent.name}/{path.name}", key, value


def takes_a_number(value: Any) -> bool:
  """Whether a default is a number, has numbers or says nothing of what may stand there (null, an empty list)."""
  if isinstance(value, list):
    return not value or any(map(takes_a_number, value))
  return value is None or (isinstance(value, int | float) and not isinstance(value, bool))


def test_every_number_has_limits() -> None:
  missing = [
    f"{file}: {key}={value}"
    for file, key, value in defined()
    if takes_a_number(value) and text_depth(key) is None and not any(limit_of(key, agent) for agent in agent_names())
  ]
  assert not missing, "give these a limit, where they are defined or in playground/config/limits.py, or say text"


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
