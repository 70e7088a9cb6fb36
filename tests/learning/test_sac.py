"""What is SAC's own; what it shares with the other algorithms is in test_trainer.py."""

import dataclasses
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from jax.sharding import PartitionSpec as P

from playground.envs.base import State
from playground.errors import CheckpointError, ConfigError
from playground.hardware.mesh import jit_on_mesh, make_mesh
from playground.learning import trainer as trainer_module
from playground.learning.checkpoints import Checkpoint, CheckpointStore, find_checkpoints
from playground.learning.off_policy import groups_inside
from playground.learning.rollout import Environments
from playground.learning.sac import SAC
from playground.learning.trainer import Trainer
from tests.dummy import SMALL_SAC, PointTask, numbers, point_trainer

PREFILL = 4  # steps of 16 environments that make up min_replay_size
MODEL: dict[str, Any] = {}


@cache
def built() -> Trainer:
  return point_trainer(SMALL_SAC)


def algorithm(trainer: Trainer) -> SAC:
  assert isinstance(trainer.algorithm, SAC)
  return trainer.algorithm


@cache
def other() -> Trainer:
  """A second set of hyperparameters, shared because compiling it takes seconds."""
  return point_trainer(
    dataclasses.replace(SMALL_SAC, alpha_learning_rate=1e-5, grad_updates_per_step=1, checkpoint_replay=False)
  )


def trained(updates: int, trainer: Trainer | None = None) -> Any:
  trainer = trainer or built()
  state, _ = trainer.train(trainer.init(jax.random.PRNGKey(0), MODEL, None, trainer.settings), MODEL, np.int32(updates))
  return state


class PointInParts(PointTask):
  """The point, which says that `privileged_state` begins with `state`."""

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    return {"state": {"place": 2}, "privileged_state": {"state": 2, "velocity": 2}}


def test_groups_that_another_one_begins_with() -> None:
  sizes = {"state": (2,), "privileged_state": (4,)}
  assert groups_inside(PointInParts(), sizes) == {"state": ("privileged_state", 2)}
  assert groups_inside(PointInParts(), {"state": (6,), "privileged_state": (4,)}) == {}, "frames: it is longer"
  parts = {"state": {"linvel": 3, "gyro": 3}, "linvel": {"linvel": 3}}
  with pytest.MonkeyPatch.context() as patch:  # a term of `state` has noise, and may have the name of an exact group
    patch.setattr(PointTask, "observation_parts", parts)
    assert groups_inside(PointTask(), {"state": (6,), "linvel": (3,)}) == {}
  assert groups_inside(PointInParts(), {"privileged_state": (4,)}) == groups_inside(PointTask(), sizes) == {}


@pytest.mark.slow
def test_the_buffer_keeps_a_group_within_another_once() -> None:
  parts = Trainer(PointInParts(), SMALL_SAC, make_mesh(1))
  assert algorithm(parts).buffer.width == algorithm(built()).buffer.width - 2 * 2
  ours, whole = (trained(PREFILL + 2, trainer).algorithm for trainer in (parts, built()))
  for a, b in zip(numbers((ours.params, ours.target_q)), numbers((whole.params, whole.target_q)), strict=True):
    np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_an_episode_begins_where_all_environments_are_reset() -> None:
  trainer = point_trainer(dataclasses.replace(SMALL_SAC, num_steps=2))
  state = trained(2, trainer)
  state = trainer.reset(state, jax.random.PRNGKey(1), MODEL)
  state, _ = trainer.train(state, MODEL, np.int32(2))
  first = algorithm(trainer).buffer.sample_windows(state.replay, jax.random.PRNGKey(2), (8,), 4).first
  np.testing.assert_array_equal(first.T, [[1, 0, 1, 0]] * 8)


def test_nothing_is_learned_before_there_is_enough_to_learn_from() -> None:
  states = trained(0), trained(PREFILL), trained(PREFILL + 1)
  start, filled, later = (state.algorithm for state in states)
  for a, b in zip(numbers(start.params), numbers(filled.params), strict=True):
    np.testing.assert_array_equal(a, b)
  assert all((a != b).any() for a, b in zip(numbers(filled.params), numbers(later.params), strict=True))
  assert int(later.opt_state.count) == SMALL_SAC.grad_updates_per_step
  moved = ravel_pytree(later.params.q)[0] - ravel_pytree(filled.params.q)[0]
  followed = ravel_pytree(later.target_q)[0] - ravel_pytree(filled.target_q)[0]
  assert 0 < jnp.abs(followed).max() < 3 * SMALL_SAC.tau * jnp.abs(moved).max()


def test_transitions_are_what_the_environments_did() -> None:
  state = trained(25)  # the 20th step of the point is cut by the time limit
  rows = jax.device_get(state.replay.data)[:25]
  example = algorithm(built()).buffer.sample(state.replay, jax.random.PRNGKey(0), (1,))
  _, unravel = ravel_pytree(jax.tree.map(lambda x: x[0], example))
  steps = jax.vmap(jax.vmap(unravel))(rows)
  position, after = steps.obs["state"], steps.next_obs["state"]
  goes_on = np.arange(1, 25) != 20
  np.testing.assert_array_equal(position[1:][goes_on], after[:-1][goes_on])
  np.testing.assert_array_equal(position[20], position[0])
  np.testing.assert_array_equal(steps.nonfinite, 0)
  np.testing.assert_array_equal(steps.discount, 1)
  moved = position + 0.1 * steps.action
  np.testing.assert_allclose(after, moved, atol=1e-6)
  np.testing.assert_allclose(steps.reward, -np.linalg.norm(moved, axis=-1), atol=1e-6)


class Dying(PointTask):
  """Terminates in every third step."""

  def post_step(self, data: Any, info: Any, action: jax.Array) -> State:
    state = super().post_step(data, info, action)
    return state.replace(done=(state.info["age"] % 3 == 0).astype(jnp.float32))


@pytest.mark.parametrize("length", [2, 3, 20])
def test_what_comes_after_a_termination_is_worth_nothing_whatever_the_time(length: int) -> None:
  trainer = Trainer(Dying(episode_length=length), SMALL_SAC, make_mesh(1))

  @jax.jit
  def transition(state: Any, key: jax.Array) -> Any:
    envs = Environments(state.env_state, state.capture, MODEL, {}, trainer.env)
    envs, step = algorithm(trainer).collect(state.algorithm, envs, key)
    return envs.state, step

  state, discounts = trainer.init(jax.random.PRNGKey(0), MODEL, None, trainer.settings), []
  for i in range(6):
    env_state, step = transition(state, jax.random.PRNGKey(i))
    np.testing.assert_allclose(step.next_obs["state"], step.obs["state"] + 0.1 * step.action, atol=1e-6)
    np.testing.assert_array_equal(step.nonfinite, 0)
    discounts.append(step.discount)
    state = state.replace(env_state=env_state)
  np.testing.assert_array_equal(np.array(discounts).T, [[1, 1, 0, 1, 1, 0]] * 16)


def test_a_step_that_went_nan_teaches_the_critics_nothing() -> None:
  state = trained(3, point_trainer(SMALL_SAC, nan_at=3))
  assert np.isfinite(state.replay.data).all()
  reward, discount, nonfinite = np.moveaxis(np.asarray(state.replay.data)[2, :, -3:], -1, 0)
  assert (reward == 0).all()
  assert (discount == 0).all()
  assert (nonfinite == 1).all()


def test_a_bad_gradient_is_left_out() -> None:
  sac, state = algorithm(built()), trained(PREFILL + 1)
  batches = sac.buffer.sample(state.replay, jax.random.PRNGKey(0), (1, 32))
  batches = batches.replace(reward=batches.reward * np.nan)
  start = (state.algorithm.params, state.algorithm.target_q, state.algorithm.opt_state)
  new, parts = jit_on_mesh(sac.learn, built().mesh, (P(),) * 4, P())(
    start, batches, jax.random.PRNGKey(0), np.int32(PREFILL)
  )
  assert parts[-1] == 1
  assert np.isfinite(parts).all()
  for a, b in zip(numbers(start), numbers(new), strict=True):
    np.testing.assert_array_equal(a, b)


def test_each_learns_at_its_own_rate() -> None:
  before, after = trained(PREFILL, other()), trained(PREFILL + 1, other())
  step = jax.tree.map(lambda a, b: jnp.abs(a - b).max(), after.algorithm.params, before.algorithm.params)
  np.testing.assert_allclose(step.log_alpha, 1e-5, rtol=1e-3)  # Adam's first step is the rate
  for change in jax.tree.leaves((step.q, step.policy)):
    np.testing.assert_allclose(change, SMALL_SAC.learning_rate, rtol=0.05)


# Checkpoints


def save(folder: Path, trainer: Trainer, *states: Any) -> list[Path]:
  """Saves states as a run does, at steps 10, 20, ...; returns the checkpoints, newest first."""
  store = CheckpointStore(folder / "checkpoints")
  for i, state in enumerate(states):
    policy, rest = trainer.split(state)
    meta = {"update": i, "wall_clock_s": 0.0, "env": "Point", "config": {}}
    store.save(10 * (i + 1), policy, rest, meta, trainer.experience(state))
  store.close()
  return find_checkpoints(folder)


@pytest.mark.parametrize(
  ("updates", "dtype"),
  [(7, "float32"), (40, "float32"), pytest.param(7, "bfloat16", marks=pytest.mark.slow)],
  ids=["half full", "full", "in bfloat16"],
)
def test_the_newest_checkpoint_restores_everything(tmp_path: Path, updates: int, dtype: Any) -> None:
  trainer = built() if dtype == "float32" else point_trainer(dataclasses.replace(SMALL_SAC, replay_dtype=dtype))
  state = trained(updates, trainer)
  newest, older = save(tmp_path, trainer, trained(3, trainer), state)
  assert Checkpoint(newest).has("replay")
  assert not Checkpoint(older).has("replay")
  template = trainer.template(MODEL)
  restored, said = trainer.restore(Checkpoint(newest), template)
  assert said == f"Resuming the whole training state of {newest} (20 steps)."
  restored = trainer.place(restored)
  assert jax.tree.structure(restored) == jax.tree.structure(state)
  for a, b in zip(numbers(state), numbers(restored), strict=True):
    np.testing.assert_array_equal(a, b)


def test_without_the_buffer_it_is_filled_again(tmp_path: Path) -> None:
  trainer = built()
  _, older = save(tmp_path, trainer, trained(30), trained(31))
  template = trainer.template(MODEL)
  state, said = trainer.restore(Checkpoint(older), template)
  assert "without its replay buffer (64 transitions are collected before it learns on)" in said
  ends_before = point_trainer(dataclasses.replace(SMALL_SAC, num_timesteps=70))
  nothing = "before it learns on, and no steps are left then: it learns nothing more) of"
  assert nothing in ends_before.restore(Checkpoint(older), template)[1]
  before, state = numbers(state.algorithm.params), trainer.place(state)
  state, _ = trainer.train(state, MODEL, np.int32(PREFILL))
  for a, b in zip(before, numbers(state.algorithm.params), strict=True):
    np.testing.assert_array_equal(a, b)
  state, metrics = trainer.train(state, MODEL, np.int32(1))
  assert int(state.replay.inserted) == PREFILL + 1
  assert all((a != b).any() for a, b in zip(before, numbers(state.algorithm.params), strict=True))
  assert np.isfinite(metrics["critic_loss"])


def test_a_buffer_that_is_not_to_be_saved_is_not_even_fetched(tmp_path: Path) -> None:
  trainer = other()
  state = trained(6, trainer)
  saved = trainer.gather(state)
  assert saved.replay.data is None
  for kept in (saved, state):
    assert trainer.experience(kept) is None
  (path,) = save(tmp_path, trainer, saved)
  restored: Any = trainer.restore(Checkpoint(path), jax.eval_shape(lambda: state))[0]
  assert not restored.replay.inserted
  for a, b in zip(numbers(state.algorithm.opt_state), numbers(restored.algorithm.opt_state), strict=True):
    np.testing.assert_array_equal(a, b)


def test_new_weights_come_with_their_target() -> None:
  trainer = built()
  policy = jax.device_get(trainer.policy(trained(20)))
  state = trainer.init(jax.random.PRNGKey(0), MODEL, policy, trainer.settings)
  for ours, theirs in ((state.algorithm.params, policy.params), (state.algorithm.target_q, policy.params.q)):
    for a, b in zip(numbers(ours), numbers(theirs), strict=True):
      np.testing.assert_array_equal(a, b)


def test_another_buffer_is_refused(tmp_path: Path) -> None:
  trainer = built()
  (path,) = save(tmp_path, trainer, trained(7))
  (path / "replay").rename(path / "elsewhere")
  (path / "replay").mkdir()
  with pytest.raises(CheckpointError, match="damaged: its 'replay' cannot be read"):
    trainer.restore(Checkpoint(path), trainer.template(MODEL))


# What is refused


def test_memory_is_stated_and_must_be_there(monkeypatch: pytest.MonkeyPatch) -> None:
  large = dataclasses.replace(SMALL_SAC, max_replay_size=10**8)
  monkeypatch.setattr(trainer_module, "device_memory", lambda mesh: None)
  (said,) = point_trainer(large).notices()
  assert said == "Replay buffer: 100,000,000 transitions of 17 numbers, 6.80 GB on each device."
  monkeypatch.setattr(trainer_module, "device_memory", lambda mesh: 5 * 10**9)
  with pytest.raises(ConfigError, match=r"agent.max_replay_size=100000000 is .* which has 5.00 GB: lower it"):
    point_trainer(large).notices()
  (said,) = point_trainer(dataclasses.replace(large, replay_dtype="bfloat16")).notices()
  assert "17 numbers, 4.00 GB" in said, "14 numbers of 2 bytes; reward, discount and nonfinite of 4"


@pytest.mark.parametrize(
  ("change", "words"),
  [
    ({"num_eval_envs": 15}, ["agent.num_eval_envs=15", "devices, 2"]),
    ({"batch_size": 15}, ["agent.batch_size=15", "devices, 2"]),
    ({"max_replay_size": 60}, ["agent.max_replay_size=60", "agent.min_replay_size=64"]),
    ({"max_replay_size": 10**10}, ["agent.max_replay_size=10000000000", "2147483647 for each device"]),
    ({"max_replay_size": 8, "min_replay_size": 0}, ["agent.max_replay_size=8", "agent.num_envs=16"]),
  ],
)
def test_sizes_that_do_not_go_together_are_refused(change: dict[str, Any], words: list[str]) -> None:
  with pytest.raises(ConfigError) as error:
    dataclasses.replace(SMALL_SAC, **change).check(num_devices=2)
  assert all(word in str(error.value) for word in words)


def test_a_budget_that_only_fills_the_buffer_is_refused() -> None:
  with pytest.raises(ConfigError, match=r"64 environment steps are over before agent.min_replay_size=64"):
    point_trainer(dataclasses.replace(SMALL_SAC, num_timesteps=64))
