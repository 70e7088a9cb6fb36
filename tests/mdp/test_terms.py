"""Terms of a config: the functions that they name, what they may say, and those of the shipped tasks."""

import copy
import functools
import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import pytest
import yaml
from ml_collections import ConfigDict

import playground
from playground import registry
from playground.errors import ConfigError, UnknownNameError
from playground.mdp.manipulators import ArmContext, ArmRobot
from playground.mdp.options import RewardOptions, is_model_field
from playground.mdp.rewards import action_rate_l2
from playground.mdp.terms import MODULES, Term, bind, find, registered
from playground.physics.backend import mjx
from playground.robots.tabletop import build_tabletop
from playground.trust import trust
from tests.mdp.context import context


@pytest.fixture(scope="module")
def arm() -> ArmContext:
  """The Panda and a cube: seven joints, eight actuators; contact sensors of the floor, the fingers and the cube."""
  spec = build_tabletop("panda_single_cube")
  spec.body("mocap_target").geoms[0].name = "target"  # which no sensor watches
  model = spec.compile()
  env: Any = SimpleNamespace(robot=ArmRobot(model, "home", r"joint\d"), mj_model=model, dt=0.02)
  data: Any = mjx.make_data(model, impl="jax")
  return ArmContext(env, data, {}, jnp.zeros(8))


def rewards(section: Any) -> list[Term]:
  return bind("rewards", section)


def test_a_terms_name_is_its_functions_name_unless_it_says_another() -> None:
  terms = rewards(
    {
      "action_rate_l2": {"weight": -0.01},
      "hips": {"func": "joint_deviation_l1", "weight": 2, "params": {"joints": ["a", "b"]}, "when": {"x": 1}},
      "knees": {"func": "joint_deviation_l1", "weight": 0, "params": {"joints": "knees"}},
      "feet_slip_l2": None,
    }
  )
  assert [term.name for term in terms] == ["action_rate_l2", "hips", "knees"]  # in their order, without what is null
  assert terms[0].func is action_rate_l2 and terms[0].params == {}
  assert terms[1].func is terms[2].func
  assert (terms[1].params, terms[1].options) == ({"joints": ("a", "b")}, RewardOptions(2, {"x": 1}))
  assert rewards(None) == []


def test_classes_are_named_in_snake_case_and_their_fields_are_parameters() -> None:
  entry = {"func": "uniform_velocity", "params": {"max": [1, 1, 1], "min": None}}
  (term,) = bind("commands", {"velocity": entry})
  assert term().max == (1, 1, 1)


@pytest.mark.parametrize(
  ("entry", "message"),
  [
    ({"weight": 1, "func": "enrgy"}, r"env\.rewards\.x: no function 'enrgy' is registered .* module:function"),
    ({"weight": 1, "func": "action_rate"}, r"'action_rate'.*Did you mean 'action_rate_l2'\?"),
    ({"wieght": 1}, r"env\.rewards\.x\.wieght does not exist: a term has .*Did you mean 'weight'\?"),
    (
      {"func": "base_height_l2", "weight": 1, "params": {"targt": 1}},
      r"env\.rewards\.x\.params\.targt does not exist: base_height_l2 takes target\. Did you mean 'target'\?",
    ),
    ({"func": "action_l2", "weight": 1, "params": {"a": 1}}, "params.a does not exist: action_l2 takes no parameters"),
  ],
)
def test_unknown_names(entry: Any, message: str) -> None:
  with pytest.raises(UnknownNameError, match=message) as error:
    rewards({"x": entry})
  assert "\n" not in str(error.value)


@pytest.mark.parametrize(
  ("entry", "message"),
  [
    (-0.1, r"env\.rewards\.x=-0\.1 is no mapping"),
    ({"func": "action_l2"}, r"env\.rewards\.x\.weight is missing"),
    ({"func": "action_l2", "weight": 1, "params": 3}, "params=3 is no mapping of parameters"),
    ({"func": "base_height_l2", "weight": 1}, r"params\.target is missing: base_height_l2 needs it"),
    ({"func": "base_height_l2", "weight": 1, "params": {"target": None}}, r"params\.target is missing"),
    ({"func": "base_height_l2", "weight": 1, "params": {"target": "high"}}, r"target=.* must be a number"),
    ({"func": "base_height_l2", "weight": 1, "params": {"target": float("nan")}}, r"target=nan must be a number"),
    ({"func": "feet_clearance", "weight": 1, "params": {"target": -0.1}}, r"target=-0\.1 must be a number above 0"),
    ({"func": "orientation_l2", "weight": 1, "params": {"target": [0, 1]}}, r"target=.* must be 3 numbers"),
    ({"func": ConfigDict({"a": {"b": 1}}), "weight": 1}, r"env\.rewards\.x\.func=\{a: \{b: 1\}\} must be text"),
    ({"func": "joint_deviation_l1", "weight": 1, "params": {"joints": 3}}, r"joints=3 must be text or a list of texts"),
    ({"func": "ang_vel_xy_l2", "weight": 1, "params": {"sensor": 3}}, r"sensor=3 must be text"),
  ],
)
def test_refusals(entry: Any, message: str) -> None:
  with pytest.raises(ConfigError, match=message):
    rewards({"x": entry})


def test_events_need_a_mode() -> None:
  with pytest.raises(ConfigError, match=r"env\.events\.reset_root_xy\.mode is missing"):
    bind("events", {"reset_root_xy": {"params": {"distance": 1.0}}})


def test_functions_of_other_packages_are_trusted_by_name_only(monkeypatch: pytest.MonkeyPatch) -> None:
  module: Any = ModuleType("elsewhere")

  def mine(c: Any, gain: "float") -> Any:  # as with `from __future__ import annotations`
    return gain * c

  mine.__module__, module.mine, module.seven = "elsewhere", mine, 7
  monkeypatch.setitem(sys.modules, "elsewhere", module)
  entry = {"func": "elsewhere:mine", "weight": 1.0, "params": {"gain": 2.0}}
  with pytest.raises(ConfigError, match=r"env\.rewards\.x\.func=elsewhere:mine is refused.*trust=elsewhere"):
    rewards({"x": entry})
  monkeypatch.setattr("playground.trust._named", set())
  trust("elsewhere")
  (term,) = rewards({"x": entry})
  assert term(3.0) == 6.0
  with pytest.raises(ConfigError, match=r"params\.gain=.* must be a number"):
    rewards({"x": {**entry, "params": {"gain": "much"}}})
  with pytest.raises(ConfigError, match=r"func=elsewhere:miine: elsewhere has no miine.*Did you mean 'mine'\?"):
    rewards({"x": {**entry, "func": "elsewhere:miine"}})


@pytest.mark.parametrize("kind", ["commands", "events"])
def test_a_class_without_the_methods_of_its_kind_is_not_called(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
  module: Any = ModuleType("elsewhere")
  module.Mine = type("Mine", (), {"__module__": "elsewhere", "__init__": pytest.fail})
  module.mine = lambda: pytest.fail("it was called")
  module.mine.__module__ = "elsewhere"
  monkeypatch.setitem(sys.modules, "elsewhere", module)
  monkeypatch.setattr("playground.trust._named", {"elsewhere"})
  for name in ("Mine", "mine") if kind == "commands" else ("Mine",):
    entry = {"func": f"elsewhere:{name}"} | ({"mode": "interval"} if kind == "events" else {})
    message = rf"env\.{kind}\.x\.func=elsewhere:{name} must be a class with the methods bind, reset, step"
    with pytest.raises(ConfigError, match=message):
      bind(kind, {"x": entry})


# The shipped tasks. Their files are merged here without Hydra, which takes a second for each.

ENVS = Path(playground.__file__).parents[1] / "configs/env"
KINDS = tuple(MODULES)


@functools.cache
def read(name: str) -> tuple[list[str], dict[str, Any]]:
  """The files that one inherits from, and the config with what it has of them."""
  config = yaml.load((ENVS / f"{name}.yaml").read_text(), yaml.CSafeLoader)
  above = [entry for entry in config.pop("defaults", []) if isinstance(entry, str) and entry != "_self_"]
  for family in above:
    config = merged(read(family)[1], config)
  return above, config


def merged(base: Any, change: Any) -> Any:
  if not isinstance(base, dict) or not isinstance(change, dict):
    return change
  return base | {key: merged(base.get(key), value) for key, value in change.items()}


def entries(task: str, kind: str) -> Iterator[tuple[str, Any]]:
  """Terms of a task's config by name."""
  for name, entry in (read(task)[1].get(kind) or {}).items():
    group = (entry or {}).items() if kind == "observations" else [(name, entry)]
    for term, own in group:
      stands_for_a_group = kind == "observations" and term == "state" != name
      if own is not None and not is_model_field(term, own) and not stands_for_a_group:
        yield term, own


@pytest.fixture(scope="module")
def shipped() -> dict[str, dict[str, dict[str, Any]]]:
  """Functions of all terms of the shipped tasks: by kind, name of the term, and task."""
  found: dict[str, dict[str, dict[str, Any]]] = {kind: {} for kind in KINDS}
  for task in registry.names():
    for kind in KINDS:
      for name, entry in entries(task, kind):
        found[kind].setdefault(name, {})[task] = find(kind, entry.get("func") or name, f"{task}.{kind}.{name}")
  return found


@pytest.mark.parametrize("kind", ["rewards", "terminations"])
def test_one_name_one_formula(kind: str, shipped: Any) -> None:
  """Tasks that log a value under the same name compute the same function."""
  assert len(shipped[kind]) > 5
  several = {name: tasks for name, tasks in shipped[kind].items() if len(set(tasks.values())) > 1}
  assert several == {}


@pytest.mark.parametrize("kind", KINDS)
def test_every_term_says_what_it_is(kind: str, shipped: Any) -> None:
  for func in {func for tasks in shipped[kind].values() for func in tasks.values()} | set(registered(kind).values()):
    line = (func.__doc__ or "").partition("\n")[0]
    assert line.endswith((".", ".)", ":")) and not line.startswith(f"{func.__name__}("), f"{func}: {line!r}"


@pytest.mark.parametrize("kind", KINDS)
def test_no_function_is_registered_twice(kind: str) -> None:
  table = registered(kind)
  module = sys.modules[MODULES[kind]]
  for name, value in vars(module).items():
    if inspect.isfunction(value) and value.__module__ == module.__name__ and not name.startswith("_"):
      assert table[name] is value


def test_a_task_inherits_from_one_family_or_from_one_task_that_it_varies() -> None:
  for task in registry.names():
    above = read(task)[0]
    assert len(above) <= 1, task
    for base in above:
      family = read(base)[0]
      assert not family or (base in registry.names() and read(family[0])[0] == []), f"{task} inherits from {base}"


def test_no_term_weighs_nothing() -> None:
  assert [(t, name) for t in registry.names() for name, term in entries(t, "rewards") if not term["weight"]] == []


@pytest.mark.parametrize("robot", ["Go1", "G1", "T1", "BerkeleyHumanoid"])
def test_a_robot_walks_on_rough_ground_as_on_flat_ground_but_for_the_ground(robot: str) -> None:
  flat, rough = (read(f"{robot}Joystick{terrain}Terrain")[1] for terrain in ("Flat", "Rough"))
  differ = {key for key in flat | rough if flat.get(key) != rough.get(key)}
  assert "scene" in differ <= {"scene", "cuda_impl", "naconmax_per_env", "njmax"}


def test_an_error_inside_a_term_is_its_own() -> None:
  (term,) = rewards({"joint_vel_l2": {"weight": 1.0}})
  with pytest.raises(ConfigError, match=r"env\.rewards\.joint_vel_l2 needs 'joint_vel', which this task does not have"):
    term(SimpleNamespace())
  with pytest.raises(
    ConfigError, match=r"joint_vel_l2: test_terms\.py:\d+: AttributeError: 'list' .* attribute 'shape'$"
  ):
    term._replace(func=lambda c: [].shape)(SimpleNamespace())  # pyright: ignore[reportAttributeAccessIssue]


def test_sizes_that_do_not_fit_are_an_error_of_the_config() -> None:
  c = context(data={"actuator_force": jnp.zeros(3)})  # of two joints
  (term,) = rewards({"power": {"func": "joint_power_l1", "weight": 1.0}})
  with pytest.raises(ConfigError, match=r"^env\.rewards\.power does not fit this task: .*\(2,\).*\(3,\)\.$") as raised:
    term(c)
  assert isinstance(raised.value.__cause__, TypeError)
  theirs = term._replace(func=lambda c: c.joint_vel + c.data.actuator_force)
  (ending,) = rewards({"is_terminated": {"weight": 1.0}})
  c.env.terminations.any = theirs  # pyright: ignore[reportAttributeAccessIssue]
  for func in (theirs, ending):
    with pytest.raises(
      ConfigError, match=r"^env\.rewards\.power: test_terms\.py:\d+: TypeError: .*incompatible shapes"
    ):
      func(c)


@pytest.mark.parametrize(
  ("kind", "entry", "message"),
  [
    ("rewards", {"func": "joint_power_l1", "weight": 1.0}, "does not fit this task: mul got incompatible shapes"),
    ("terminations", {"func": "power_above", "params": {"limit": 1.0}}, "does not fit this task: mul got"),
    ("observations", {"func": "target_error"}, "does not fit this task: sub got incompatible shapes"),
    (
      "rewards",
      {"func": "base_height_l2", "weight": 1.0, "params": {"target": 1.0}},
      "it needs a free joint as the first",
    ),
    ("observations", {"func": "root_quat"}, "it needs a free joint as the first of the model"),
    (
      "rewards",
      {"func": "joint_vel_within_limits", "weight": 1.0, "params": {"limits": [1.0, 2.0]}},
      "does not fit this task: .*incompatible shapes",
    ),
    (
      "terminations",
      {"func": "body_out_of_bounds", "params": {"body": "box", "low": [0.0, None], "high": [1.0, 1.0]}},
      r"low=\[0\.0, null\] and high=\[1\.0, 1\.0\] must have a number or null for each of x, y and z",
    ),
    (
      "terminations",
      {"func": "body_out_of_bounds", "params": {"body": "box", "low": 3, "high": ["a", None, None]}},
      r"low=3\.0 and high=\[a, null, null\] must have a number or null for each",
    ),
    (
      "terminations",
      {"func": "site_out_of_bounds", "params": {"site": "gripper", "low": [0], "high": [1]}},
      ".*each of x, y and z",
    ),
    ("rewards", {"func": "contact_normal_horizontal", "weight": 1.0}, "the scene has no contact sensor .*_normal"),
    (
      "rewards",
      {"func": "no_contact", "weight": 1.0, "params": {"geom": "target"}},
      "the scene has no contact sensor of geom 'target'",
    ),
    (
      "terminations",
      {"func": "illegal_contact", "params": {"geoms": ["target"]}},
      "the scene has no contact sensor of geom 'target'",
    ),
  ],
)
def test_terms_that_an_arm_has_not(kind: str, entry: Any, message: str, arm: ArmContext) -> None:
  with pytest.raises(ConfigError, match=rf"^env\.{kind}\.mine:? {message}"):
    bind(kind, {"mine": entry})[0](arm)


def test_functions_have_the_names_under_which_they_are_registered() -> None:
  for kind in ("rewards", "observations", "terminations"):
    assert {func.__name__ for func in registered(kind).values()} == set(registered(kind))


class Reward:
  """A class-based term, as elsewhere."""

  def __call__(self, c: Any) -> Any:
    return c


def no_step() -> None:
  """Takes nothing."""


def two_arguments(key: Any, initial: Any) -> Any:
  """Lacks the task."""
  return initial


@pytest.mark.parametrize(
  ("kind", "entry", "message"),
  [
    ("rewards", {"func": "Reward", "weight": 1.0}, "is a class: a term of env.rewards is a function."),
    ("rewards", {"func": "no_step", "weight": 1.0}, "must take the step `c` before its parameters."),
    ("events", {"func": "two_arguments", "mode": "reset"}, r"must take \(key, env, initial\) before its parameters."),
  ],
)
def test_functions_of_the_wrong_form(kind: str, entry: dict[str, Any], message: str) -> None:
  trust("tests")
  with pytest.raises(ConfigError, match=rf"env\.{kind}\.mine\.func=tests\.mdp\.test_terms:{entry['func']} {message}"):
    bind(kind, {"mine": entry | {"func": f"{__name__}:{entry['func']}"}})


@pytest.mark.parametrize(
  ("func", "message"),
  [
    (
      lambda c: 1.0 if c.data.qpos[0] > 0 else 0.0,
      r": test_terms.py:\d+: write jnp.where in place of `if`, and jnp in place of np and float\(\).",
    ),
    (lambda c: c.joint_poss[0], " needs 'joint_poss', which this task does not have. Did you mean 'joint_pos'?"),
    (lambda c: {"a": c.action[0]}, " must return an array of numbers, and returns dict."),
    (lambda _: "much", " must return an array of numbers, and returns str."),
  ],
)
def test_what_a_function_of_another_package_does_wrong(func: Any, message: str, arm: ArmContext) -> None:
  term = bind("rewards", {"action_rate_l2": {"weight": 1.0}})[0]._replace(func=func)
  at = lambda qpos: term.scalar(ArmContext(arm.env, arm.data.replace(qpos=qpos), {}, arm.action))
  with pytest.raises(ConfigError, match=rf"^env\.rewards\.action_rate_l2{message}"):
    jax.eval_shape(at, arm.data.qpos)


def test_another_error_of_a_function_of_another_package_is_one_sentence_with_its_place(arm: ArmContext) -> None:
  term = bind("rewards", {"action_rate_l2": {"weight": 1.0}})[0]._replace(func=lambda c: c.action / {}["missing"])
  with pytest.raises(
    ConfigError, match=r"^env\.rewards\.action_rate_l2: test_terms\.py:\d+: KeyError: 'missing'$"
  ) as error:
    term(arm)
  assert isinstance(error.value.__cause__, KeyError)


def test_a_bug_of_our_own_has_the_terms_key_as_a_note(arm: ArmContext) -> None:
  def ours(c: ArmContext) -> Any:
    return c.action / {}["missing"]

  ours.__module__ = "playground.mdp.rewards"
  term = bind("rewards", {"action_rate_l2": {"weight": 1.0}})[0]._replace(func=ours)
  with pytest.raises(KeyError, match="missing") as error:
    term(arm)
  assert error.value.__notes__ == ["in env.rewards.action_rate_l2"]


def test_a_task_whose_robot_is_of_another_type(arm: ArmContext) -> None:
  class Cart(NamedTuple):
    qpos: slice = slice(0, 1)

  other = copy.copy(arm)
  other.robot = Cart()
  term = bind("rewards", {"action_rate_l2": {"weight": 1.0}})[0]._replace(func=lambda c: c.sensor("gyro"))
  said = (
    r"needs 'sensor', which this task does not have\. It has a Cart, and no playground\.mdp\.context\.Robot, as its"
  )
  with pytest.raises(ConfigError, match=rf"^env\.rewards\.action_rate_l2 {said} robot\.$"):
    term(other)
  with pytest.raises(
    ConfigError, match=r"^env\.rewards\.action_rate_l2 needs 'rows', which this task does not have\.$"
  ):
    term._replace(func=lambda c: c.rows)(other)  # of the step, which has a robot


def test_nothing_is_registered_that_cannot_be_a_term_of_its_kind() -> None:
  methods = {"bind", "reset", "step"}
  for name, command in registered("commands").items():
    assert methods <= set(dir(command)), name
  for name, event in registered("events").items():
    leading = [*inspect.signature(event).parameters][:3]
    assert leading == ["key", "env", "initial"] or methods <= set(dir(event)) or name == "model_field", name
