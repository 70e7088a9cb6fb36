"""Metrics of a gait, on feet and actions that are given."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ml_collections import ConfigDict

from playground.envs.base import State
from playground.envs.locomotion.gait_metrics import GaitMetrics, with_gait_metrics
from playground.envs.wrappers import wrap_for_evaluation
from tests.dummy import PointTask

TOUCHES = np.array([[1, 0], [1, 1], [1, 0], [0, 0]], np.float32)  # left and right foot, by step
SPEEDS = np.array([[0.2, 9.0], [0.1, 0.5], [0.0, 9.0], [9.0, 9.0]], np.float32)
ACTIONS = np.array([[0.3, -0.1], [0.3, 0.96], [-1.0, 1.0], [0.0, 0.0]], np.float32)
SATURATION = 0.5  # of the second joint; 0.25 of the first


class Walker(PointTask):
  """Has the feet of the tables above."""

  def __init__(self, **robot: Any):
    repeat = robot.pop("action_repeat", 1)
    super().__init__(episode_length=len(TOUCHES) * repeat, action_repeat=repeat)
    self.config = ConfigDict({"robot": {"foot_linvel": ["left", "right"]} | robot})
    names = robot.pop("left_to_right", {"left": "right"})
    self.robot = SimpleNamespace(foot_names=("left_foot", "right_foot"), left_to_right=names)

  def reset(self, rng: jax.Array, model: Any = None) -> State:
    state = super().reset(rng, model)
    return state.replace(info=state.info | {"last_act": jnp.zeros(2)})

  def step(self, state: State, action: jax.Array, model: Any = None) -> State:
    after = super().step(state, action, model)
    return after.replace(info=after.info | {"last_act": action})

  def context(self, env: Any, data: Any, info: Any, action: jax.Array) -> Any:
    assert env is self and not any(name.startswith("gait") for name in info), "as the task knows it"
    step = info["age"].astype(int)
    velocity = jnp.array(SPEEDS)[step][:, None] * jnp.array([0.6, 0.8, 5.0])
    return SimpleNamespace(contact=jnp.array(TOUCHES)[step] > 0, feet_velocity=velocity, last_act=info["last_act"])


def measured(env: Any) -> dict[str, float]:
  """Metrics of one episode."""
  wrapped = wrap_for_evaluation(env)
  state = wrapped.reset(jax.random.split(jax.random.PRNGKey(0), 1), {})
  step = jax.jit(wrapped.step)
  for action in ACTIONS:
    state = step(state, jnp.array(action)[None], {})
  return {name: float(value[0]) for name, value in state.info["episode_metrics"].items() if name.startswith("gait")}


def test_the_gait_of_an_episode() -> None:
  change = np.diff(ACTIONS, axis=0, prepend=0)
  slip = (TOUCHES * SPEEDS).sum(1) / np.maximum(TOUCHES.sum(1), 1)
  assert measured(GaitMetrics(Walker())) == {
    "gait/action_rate": pytest.approx(np.sqrt((change**2).mean(1)).mean(), rel=1e-5),
    "gait/saturation": SATURATION,
    "gait/foot_slip": pytest.approx(slip.mean(), rel=1e-5),
    "gait/duty_asymmetry": pytest.approx(3 / 4 - 1 / 4),
  }


def test_the_change_of_an_action_that_repeats() -> None:
  change = np.sqrt((np.diff(ACTIONS, axis=0, prepend=0) ** 2).mean(1)).mean()
  env = Walker(action_repeat=2, foot_linvel=[], left_to_right={})
  assert measured(GaitMetrics(env)) == {
    "gait/action_rate": pytest.approx(change, rel=1e-5),
    "gait/saturation": SATURATION,
  }


def test_a_robot_without_sensors_or_a_mirror_has_the_others() -> None:
  assert set(measured(GaitMetrics(Walker(foot_linvel=[], left_to_right={})))) == {"gait/action_rate", "gait/saturation"}


def test_other_tasks_stay_as_they_are() -> None:
  env = PointTask()
  assert with_gait_metrics(env) is env
