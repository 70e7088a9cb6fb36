"""Builds tasks by name: a file `configs/env/<TaskName>.yaml` registers a task, its `task: module:Class` the code.

Outside packages add tasks through an entry point of the group `playground.tasks`:

```toml
[project.entry-points."playground.tasks"]
my_pkg = "my_pkg:CONFIGS"     # CONFIGS = Path(__file__).parent / "configs", or a function that returns it
```

The folder is laid out like our `configs/`: `env/MyTask.yaml`, and whatever else belongs to it (`tuned/ppo/MyTask.yaml`,
`robot/my_robot.yaml`, `experiment/...`). Its files may use our groups and options in their defaults lists.

Classes of any other package are refused unless the user trusts it (`playground.trust`).
"""

import dataclasses
import functools
import typing
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Protocol, cast

from ml_collections import ConfigDict

from playground.config import (
  RunConfig,
  TaskConfig,
  compose,
  config_dict,
  in_order_of,
  options,
  override_section,
  task_names,
)
from playground.envs.options import EnvConfig, TaskKeys, TermsConfig, uses_vision
from playground.errors import ConfigError, UnknownNameError, nearest
from playground.settings import Section, plain, problem
from playground.text import format_value
from playground.trust import trusted_object

if TYPE_CHECKING:
  import jax
  from mujoco import mjx

  from playground.envs.base import Env

ALL_ENVS: tuple[str, ...]  # names of all tasks, read on access


def __getattr__(name: str) -> tuple[str, ...]:
  if name == "ALL_ENVS":
    return tuple(names())
  raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def names(word: str | None = None) -> list[str]:
  """Returns the names of all tasks, sorted; with a word, only names that contain it (ignoring case)."""
  return [name for name in task_names() if word is None or word.lower() in name.lower()]


def config(name: str) -> TaskConfig:
  """Returns a copy of the configuration that a task's file defines, with the robot's under `robot`.

  Raises:
    UnknownNameError: no such task.
  """
  return config_dict(_composed(name).env)


get_default_config = config


def load(
  name: str,
  config: ConfigDict | Section | None = None,
  overrides: Section | None = None,
  config_overrides: Section | None = None,
) -> "Env":
  """Builds a task.

  Args:
    name: one of `names()`.
    config: a whole configuration to use in place of the task's own; it is not changed.
    overrides: values by dotted key, `{"rewards.joint_power_l1.weight": -0.002}`; numbers may be NumPy's or JAX's.
    config_overrides: the same, under the name that Playground 0.2.0 had for it.

  Raises:
    UnknownNameError: no such task or key.
    ConfigError: an invalid value.
  """
  for given in (overrides, config_overrides):
    if not isinstance(given, Mapping | ConfigDict | None):
      raise ConfigError(f"overrides={given!r} must be a dict of dotted keys, such as {{'episode_length': 500}}.")
  default = _composed(name).env if config is None else config
  if isinstance(config, ConfigDict) and list(config) == sorted(config):  # a copy of a ConfigDict has its keys sorted
    default = in_order_of(_composed(name).env, config)
  section = override_section("env", default, plain({**(overrides or {}), **(config_overrides or {})}))
  return build(config_dict(section))


def build(env_config: TaskConfig) -> "Env":
  """Builds the task that a composed env section describes, with a camera if `env.vision` enables it.

  Raises:
    ConfigError: as `check`, and what only the task's model shows, such as the name of a joint that it lacks.
  """
  try:
    env = cast("Callable[[ConfigDict], Env]", check(env_config))(env_config)
  except ValueError as error:  # MuJoCo's, for a file of the task's own
    if not str(error).startswith(("XML Error", "ParseXML")):
      raise
    raise ConfigError(f"env.task={env_config.task}: {' '.join(str(error).split())}.") from error
  if not uses_vision(env_config):
    return env
  from playground.rendering.vision import Vision

  return cast("Env", Vision(env))  # it has the interface of `Env`, without being a subclass


def check(env_config: TaskConfig) -> "type[Env]":
  """Checks keys, terms and numbers of a composed env section, and returns the task's class; it builds no model.

  Raises:
    ConfigError: a key that is unknown or missing, or an invalid value.
  """
  if "task" not in env_config:
    raise ConfigError("env.task is missing: the task's file names its class, task: module:Class.")
  cls = task_class(str(env_config.task))
  own = typing.get_type_hints(cls.keys, include_extras=True)
  shared = [field.name for keys in (EnvConfig, TermsConfig, TaskKeys) for field in dataclasses.fields(keys)]
  known = [*own, *shared, "observations"]
  for name in env_config:
    if name not in known:
      remedy = f"a task's own key has its type in its class's `keys`.{nearest(name, known)}"
      raise UnknownNameError(f"env.{name} is no key of {cls.__name__}: {remedy}")
  for name, hint in own.items():
    if name not in env_config:
      raise ConfigError(f"env.{name} is missing: {cls.__name__} needs it.")
    if wanted := problem(env_config[name], hint):
      raise ConfigError(f"env.{name}={format_value(env_config[name])} must be {wanted}.")
  cls.settings_of(env_config)
  return cls


def task_class(task: str) -> "type[Env]":
  """Imports the task that `module:Class` names.

  Raises:
    ConfigError: there is none, or its package is not trusted (`playground.trust`).
  """
  found = trusted_object("env.task", task)
  from playground.envs.base import Env

  if not (isinstance(found, type) and issubclass(found, Env)):
    raise ConfigError(f"env.task={task} is no task: it must be a class that completes playground.envs.base:Env.")
  if missing := sorted(found.__abstractmethods__):
    raise ConfigError(f"env.task={task} is incomplete: the class lacks {', '.join(missing)}.")
  return found


class DomainRandomizer(Protocol):
  """Draws randomised models for Brax's wrappers."""

  def __call__(self, mjx_model: "mjx.Model", rng: "jax.Array") -> "tuple[mjx.Model, mjx.Model]":
    """Returns the model with drawn fields, [N, ...], and the axes of `vmap` of all its fields."""
    ...


def get_domain_randomizer(name: str) -> DomainRandomizer | None:
  """Returns the task's randomisation as a function like those of Playground 0.2.0; None if the task has none.

  Returns:
    A function of a model and keys [N], which returns the model with a leading axis N on every randomised field, and the
    same structure with 0 at those fields and None elsewhere.
  """
  from playground.randomization import domain_randomizer, model_fields

  events = config(name).events
  if not model_fields(events, "startup"):
    return None

  @functools.cache
  def randomizer() -> "Callable[[mjx.Model, jax.Array], tuple[mjx.Model, mjx.Model]]":
    env = load(name)
    return domain_randomizer(env.mj_model, events, env.unwrapped.impl)

  return lambda mjx_model, rng: randomizer()(mjx_model, rng)


def _composed(name: str) -> RunConfig:
  """Composes a task without a tuned set, whose values for the task belong to an algorithm."""
  if name not in (options("env") if "/" in str(name) else task_names()):
    near = nearest(str(name), task_names())
    raise UnknownNameError(f"Task {name!r} does not exist; `playground list` shows all.{near}")
  return compose([f"env={name}", "tuned=null"])
