"""What a task class gets wrong is one sentence that names the method and the entry."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
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


@pytest.mark.parametrize(
  ("wrong", "message"),
  [
    (lambda key, env, initial: 3, r"must return the state that an episode starts with, and returns int: return"),
    (lambda key, env, initial: initial.replace(qpos=jnp.zeros(2)), r"returns qpos of shape \[2\], and this task's is"),
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
