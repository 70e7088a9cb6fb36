"""What a task class gets wrong is one sentence that names the method and the entry."""

from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground import registry
from playground.errors import ConfigError

KEY = jax.random.PRNGKey(0)


@pytest.fixture(scope="module")
def task() -> Any:
  env: Any = registry.load("PandaPickCube")
  env.physics = env.physics.without_dynamics()
  return env, jax.eval_shape(env.reset, KEY)


@pytest.mark.parametrize(
  ("method", "wrong", "message"),
  [
    ("action_to_ctrl", lambda *_: jnp.zeros(2), r"action_to_ctrl returns shape \[2\], and the model has 8 actuators"),
    ("measure", lambda c: {"tilt": jnp.zeros(3)}, r"measure: 'tilt' has shape \[3\], and a metric is one number"),
    ("next_info", lambda c, key: {"more": 0}, r"next_info returns 'more', which first_info lacks: add it there"),
    ("next_info", lambda c, key: {"last_act": jnp.zeros(2)}, r"next_info .*last_act. as float32\[2\], where .*8\]"),
  ],
)
def test_wrong_results_of_its_methods(
  task: Any, method: str, wrong: Callable[..., Any], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
  env, state = task
  monkeypatch.setattr(env, method, wrong)
  with pytest.raises(ConfigError, match=rf"^{type(env).__name__}\.{message}"):
    jax.eval_shape(env.step, state, jnp.zeros(env.action_size))


def test_a_wrong_rest_ctrl(task: Any, monkeypatch: pytest.MonkeyPatch) -> None:
  env, _ = task
  monkeypatch.setattr(env, "rest_ctrl", lambda initial: jnp.zeros(2))
  with pytest.raises(ConfigError, match=r"\.rest_ctrl returns shape \[2\], .* has 8 actuators"):
    jax.eval_shape(env.reset, KEY)


@pytest.mark.parametrize(
  ("wrong", "message"),
  [
    (lambda key, env, initial: 3, r"must return the state that an episode starts with, and returns int: return"),
    (lambda key, env, initial: initial.replace(qpos=jnp.zeros(2)), r"returns qpos of shape \[2\], and this task's is"),
    (lambda key, env, initial: initial.replace(mocap_pos=jnp.zeros(3)), r"returns mocap_pos of shape \[3\], and this"),
    (lambda key, env, initial: None, r"returns nothing: <lambda> lacks a `return`"),
  ],
)
def test_wrong_results_of_a_reset_event(
  task: Any, wrong: Callable[..., Any], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
  env, _ = task
  term = env.events.groups["reset"][0]
  monkeypatch.setitem(env.events.groups, "reset", [term._replace(func=wrong, params={})])
  with pytest.raises(ConfigError, match=rf"^env\.events\.{term.name} {message}"):
    jax.eval_shape(env.reset, KEY)


class Spring:
  """An interval event that reads what the physics derives, and may return nonsense."""

  result: ClassVar[Any] = None

  def bind(self, env: Any) -> None:
    self.body = env.mj_model.body("box").id

  def reset(self, key: jax.Array, model: Any) -> dict[str, Any]:
    return {"stretch": jnp.zeros(3)}

  def step(self, data: Any, info: dict[str, Any]) -> Any:
    return (data, {"stretch": data.xpos[self.body]}) if self.result is None else self.result


class Follow:
  """A command of one number."""

  result: ClassVar[Any] = {"target": jnp.ones(())}

  def bind(self, env: Any) -> None: ...

  def reset(self, key: jax.Array) -> dict[str, Any]:
    return {"target": jnp.zeros(())}

  def step(self, c: Any, key: jax.Array) -> Any:
    return self.result


@pytest.fixture(scope="module")
def foreign() -> Any:
  with pytest.MonkeyPatch.context() as patched:
    patched.setattr("playground.trust._named", {__name__.partition(".")[0]})
    config = registry.config("PandaPickCube")
    with config.unlocked():
      config.events = {**config.get("events", {}), "spring": {"func": f"{__name__}:Spring", "mode": "interval"}}
      config.commands = {"follow": {"func": f"{__name__}:Follow"}}
    env: Any = registry.load("PandaPickCube", config=config)
  env.physics = env.physics.without_dynamics()
  return env, jax.eval_shape(env.reset, KEY)


def test_an_event_of_another_package_reads_what_the_physics_derives(foreign: Any) -> None:
  env, state = foreign
  assert jax.eval_shape(env.step, state, jnp.zeros(env.action_size)).info["stretch"].shape == (3,)


@pytest.mark.parametrize(
  ("kind", "result", "message"),
  [
    (Spring, "nothing", r"events\.spring\.step must return the physics and the entries of info that it changes\."),
    (Spring, (None, {"more": 0}), r"events\.spring\.step returns 'more', which reset lacks: add it there\."),
    (Follow, {"target": jnp.zeros(2)}, r"commands\.follow\.step returns 'target' as float32\[2\], where .*float32\[\]"),
    (Follow, {"goal": jnp.zeros(2)}, r"commands\.follow\.step returns 'goal', which reset lacks: add it there\."),
  ],
)
def test_wrong_results_of_a_command_and_an_interval_event(
  foreign: Any, kind: Any, result: Any, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
  env, state = foreign
  monkeypatch.setattr(kind, "result", result)
  with pytest.raises(ConfigError, match=rf"^env\.{message}"):
    jax.eval_shape(env.step, state, jnp.zeros(env.action_size))


@pytest.mark.parametrize(
  ("name", "size"), [("PandaPickCube", 8), ("Go1JoystickFlatTerrain", 12), ("LeapCubeRotateZAxis", 16)]
)
def test_a_list_of_action_scales_has_one_for_each_action(name: str, size: int) -> None:
  config = registry.config(name)
  with config.ignore_type():
    config.action_scale = [0.5] * (size - 1)
  with pytest.raises(ConfigError, match=rf"^env\.action_scale=\[.*\] has {size - 1} numbers, and this task {size} act"):
    registry.load(name, config=config)
  with config.ignore_type():
    config.action_scale = [0.5, *[0.25] * (size - 1)]
  env: Any = registry.load(name, config=config)
  np.testing.assert_array_equal(env._action_scale, config.action_scale)
