"""Observations: parts and their noise, histories and frames, and what a config may get wrong."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ml_collections import ConfigDict

from playground.errors import ConfigError, UnknownNameError
from playground.mdp.legged import Context
from playground.mdp.observer import Observer

KEY = jax.random.PRNGKey(0)


def moment(q: float = 0.5, command: float = 3.0) -> Context:
  """Two joints at `q` and -`q`, with targets 0.1 and 0.2 and default pose 0."""
  robot: Any = SimpleNamespace(default_pose=jnp.zeros(2))
  data: Any = SimpleNamespace(
    qpos=jnp.array([0, 0, 0, 1, 0, 0, 0, q, -q]), qvel=jnp.array([0.0] * 6 + [q, 2 * q]), ctrl=jnp.array([0.1, 0.2])
  )
  no = jnp.zeros(2, bool)
  return Context(robot, data, {"command": jnp.full(3, command)}, jnp.zeros(2), no, no, jnp.array(False))


def observer(parity: bool = False, noise: Any = None, **config: Any) -> Observer:
  defaults = {"obs": {"state": ["joint_pos"]}, "parity_obs": {}}
  noise = {"level": 1.0, "scales": {}, **(noise or {})}
  return Observer(ConfigDict({**defaults, "noise": noise, **config}), parity)


def roll(of: Observer, *moments: Context) -> list[np.ndarray]:
  """The observations of an episode."""
  seen, last = [], None
  for now in moments:
    last = of.observe(now, KEY, last)[1]
    seen.append(np.asarray(last))
  return seen


def test_parts_stand_in_the_order_listed() -> None:
  both = observer(obs={"critic": ["joint_vel", "state"], "state": ["command", "joint_pos"]})
  obs = both.observe(moment(), KEY)[1]
  np.testing.assert_allclose(obs["state"], [3, 3, 3, 0.5, -0.5])
  np.testing.assert_allclose(obs["critic"], [0.5, 1, 3, 3, 3, 0.5, -0.5])
  assert not both.looks_back
  assert both.sizes(moment()) == {"state": {"command": 3, "joint_pos": 2}, "critic": {"joint_vel": 2, "state": 5}}


def test_factors_on_parts() -> None:
  (obs,) = roll(observer(obs={"state": ["command", "joint_pos"]}, obs_scales={"command": [2, 2, 0.25]}), moment())
  np.testing.assert_allclose(obs, [6, 6, 0.75, 0.5, -0.5])


@pytest.mark.parametrize("parity", [False, True])
def test_parity_replaces_and_leaves_out(parity: bool) -> None:
  config = {"obs": {"state": ["joint_pos", "command"]}, "parity_obs": {"joint_pos": "joint_vel", "command": None}}
  (obs,) = roll(observer(parity, **config), moment())
  np.testing.assert_allclose(obs, [0.5, 1] if parity else [0.5, -0.5, 3, 3, 3])


def test_a_history_is_newest_first_and_begins_with_zeros() -> None:
  of = observer(obs={"state": ["command", "target_error_history", "target_error"]}, history={"target_error": 3})
  assert of.looks_back
  assert of.sizes(moment())["state"] == {"command": 3, "target_error_history": 6, "target_error": 2}
  errors = [slice(3, 5), slice(5, 7), slice(7, 9)]
  seen = roll(of, *(moment(q) for q in (0.1, 0.2, 0.3, 0.4)))
  expected = [[q - 0.1, -q - 0.2] for q in (0.1, 0.2, 0.3, 0.4)]
  np.testing.assert_allclose(seen[0][3:9], [*expected[0], 0, 0, 0, 0], atol=1e-7)
  for step in (2, 3):
    np.testing.assert_allclose([seen[step][e] for e in errors], expected[step::-1][:3], atol=1e-7)


def test_frames_are_newest_first_and_begin_with_zeros() -> None:
  of = observer(obs={"state": ["joint_pos"], "critic": ["state", "joint_vel"]}, frames=3)
  first = of.observe(moment(0.1), KEY)[1]
  np.testing.assert_allclose(first["state"], [0.1, -0.1, 0, 0, 0, 0])
  second = of.observe(moment(0.2), KEY, first)[1]
  third = of.observe(moment(0.3), KEY, second)[1]
  np.testing.assert_allclose(third["state"], [0.3, -0.3, 0.2, -0.2, 0.1, -0.1])
  np.testing.assert_allclose(third["critic"], [*third["state"], 0.3, 0.6])
  assert of.sizes(moment()) == {"state": {"joint_pos": 2, "past_frames": 4}, "critic": {"state": 6, "joint_vel": 2}}


@pytest.mark.parametrize("noisy", [False, True])
def test_what_is_computed_from_a_part_carries_its_noise(noisy: bool) -> None:
  config = {"obs": {"state": ["joint_pos", "target_error_history"]}, "history": {"target_error": 2}}
  of = observer(**config, noise={"scales": {"joint_pos": 0.3}, "in_histories": noisy})
  (obs,) = roll(of, moment())
  noise = obs[:2] - [0.5, -0.5]
  assert (np.abs(noise) > 0).all()
  np.testing.assert_allclose(obs[2:4], [0.4, -0.7] + noisy * noise, atol=1e-6)


def test_noise_is_on_the_actors_parts_only() -> None:
  of = observer(obs={"state": ["joint_pos"], "critic": ["joint_pos"]}, noise={"scales": {"joint_pos": 0.3}})
  obs = of.observe(moment(), KEY)[1]
  np.testing.assert_allclose(obs["critic"], [0.5, -0.5])
  assert (obs["state"] != obs["critic"]).all()


@pytest.mark.parametrize(
  ("config", "message"),
  [
    ({"obs": {"state": ["joint_poss"]}}, r"env\.obs\.state: 'joint_poss'.*Did you mean 'joint_pos'"),
    ({"obs": {"state": ["joint_pos_history"]}}, r"env\.obs\.state: 'joint_pos_history' is unknown"),
    ({"history": {"joint_poss": 2}}, r"env\.history: 'joint_poss'.*Did you mean 'joint_pos'"),
    ({"obs_scales": {"comand": 2}}, r"env\.obs_scales: 'comand'.*Did you mean 'command'"),
    ({"parity_obs": {"comand": None}}, r"env\.parity_obs: 'comand'.*Did you mean 'command'"),
    ({"parity_obs": {"command": "gravty"}}, r"env\.parity_obs: 'gravty'.*Did you mean 'gravity'"),
  ],
)
def test_unknown_parts(config: dict[str, Any], message: str) -> None:
  with pytest.raises(UnknownNameError, match=message):
    observer(**config)


@pytest.mark.parametrize("config", [{"frames": 0}, {"history": {"joint_pos": 0}}])
def test_no_step_at_all(config: dict[str, Any]) -> None:
  with pytest.raises(ConfigError, match="=0 must be a number of steps, 1 or more"):
    observer(**config)
