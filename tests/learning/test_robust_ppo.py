"""PPO's options for robust training, each against its formula."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.sharding import PartitionSpec as P

from playground.errors import ConfigError
from playground.hardware.mesh import AXIS, make_mesh
from playground.learning.networks import ActorCritic
from playground.learning.ppo import KL, Batch, adapted_rate, count_targets, gae, ppo_loss
from tests.dummy import SMALL_PPO, PointTask, Recorder, point_trainer
from tests.learning.test_trainer import run

ROBUST = dataclasses.replace(
  SMALL_PPO, targets="epoch", clip_advantages=5.0, normalize_value_targets=True, value_huber_delta=1.0,
  desired_kl=0.01, max_learning_rate=1e-2, max_kl=0.1, bootstrap_on_timeout=True, max_grad_norm=1.0,
  dual_clip=3.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def networks() -> ActorCritic:
  return ActorCritic(PointTask().observation_size, 2, SMALL_PPO.network)


def batch(networks: ActorCritic, **changes: Any) -> Batch:
  draw = lambda i, *shape: jax.random.normal(jax.random.PRNGKey(i), shape)
  obs = {key: draw(i, 6, 4, *shape) for i, (key, shape) in enumerate(networks.obs_sizes.items())}
  last = {key: draw(9, 4, *shape) for key, shape in networks.obs_sizes.items()}
  zero = jnp.zeros((6, 4))
  return Batch(obs, last, draw(2, 6, 4, 2), draw(3, 6, 4), 10 * draw(4, 6, 4), zero, zero).replace(**changes)


@pytest.mark.parametrize(
  ("kl", "expected"),
  [(0.03, 1e-3 / 1.5), (0.02, 1e-3), (0.01, 1e-3), (0.005, 1e-3), (0.004, 1.5e-3), (1e-8, 1e-3), (0.0, 1e-3)],
)
def test_the_learning_rate_follows_the_divergence(kl: float, expected: float) -> None:
  config = dataclasses.replace(SMALL_PPO, desired_kl=0.01)
  assert float(adapted_rate(jnp.float32(1e-3), jnp.float32(kl), config)) == pytest.approx(expected, rel=1e-5)


def test_the_learning_rate_has_limits() -> None:
  config = dataclasses.replace(SMALL_PPO, desired_kl=0.01, min_learning_rate=9e-4, max_learning_rate=1.1e-3)
  assert float(adapted_rate(jnp.float32(1e-3), jnp.float32(1.0), config)) == pytest.approx(9e-4)
  assert float(adapted_rate(jnp.float32(1e-3), jnp.float32(1e-3), config)) == pytest.approx(1.1e-3)


@pytest.mark.parametrize("rates", [(0.1, 1e-3, 0.01), (1e-5, 1.0, 1e-2), (1e-2, 1e-3, 1e-1)])
def test_an_adapted_rate_begins_within_its_limits(rates: tuple[float, float, float]) -> None:
  low, rate, high = rates
  config = dataclasses.replace(SMALL_PPO, learning_rate=rate, min_learning_rate=low, max_learning_rate=high)
  config.check(1)
  with pytest.raises(ConfigError, match=r"agent\.learning_rate=.* must be from agent\.min_learning_rate="):
    dataclasses.replace(config, desired_kl=0.01).check(1)


def test_the_divergence_is_that_of_the_two_gaussians(networks: ActorCritic) -> None:
  raw = lambda mean, std: jnp.array([[mean, jnp.log(jnp.expm1(std - 0.001))]])  # as Brax's distribution reads them
  one = ActorCritic(2, 1, dataclasses.replace(SMALL_PPO.network, value_obs_key="state"))
  assert float(one.kl(raw(0.0, 1.0), raw(0.1, 0.9))[0]) == pytest.approx(0.018096, abs=1e-5)
  params = networks.init(jax.random.PRNGKey(0))
  data = batch(networks)
  data = data.replace(old_logits=networks.logits(params.policy, data.obs))
  loss = lambda data: ppo_loss(params, data, jax.random.PRNGKey(1), networks, SMALL_PPO)[1]
  assert float(loss(data)[KL]) == pytest.approx(0, abs=1e-6)
  assert KL not in loss(batch(networks))


@pytest.mark.parametrize("devices", [1, 2])
def test_targets_are_counted_as_if_they_came_at_once(devices: int) -> None:
  parts = [np.random.default_rng(i).normal(i, 1 + i, (6, 4)).astype(np.float32) for i in range(3)]
  count = jax.jit(
    jax.shard_map(count_targets, mesh=make_mesh(devices), in_specs=(P(), P(None, AXIS)), out_specs=P(), check_vma=False)
  )
  seen = jnp.zeros(3)
  for part in parts:
    seen = count(seen, part)
  together = np.concatenate(parts)
  assert float(seen[0]) == together.size
  assert float(seen[1]) == pytest.approx(together.mean(), rel=1e-4)
  assert float(jnp.sqrt(seen[2] / seen[0])) == pytest.approx(together.std(), rel=1e-4)


def value_loss(networks: ActorCritic, scale: float | None = None, **changes: Any) -> tuple[float, np.ndarray]:
  """The critic's loss, and its errors."""
  config = dataclasses.replace(SMALL_PPO, **changes)
  params, data = networks.init(jax.random.PRNGKey(0)), batch(networks)
  obs = jax.tree.map(lambda x, last: jnp.concatenate([x, last[None]]), data.obs, data.last_obs)
  values = networks.value(params.value, obs)
  errors = np.asarray(gae(data, values, config)[0] - values[:-1])
  value_scale = None if scale is None else jnp.float32(scale)
  return float(ppo_loss(params, data, jax.random.PRNGKey(1), networks, config, value_scale)[1]["value_loss"]), errors


def test_the_critics_loss_is_divided_and_linear_far_away(networks: ActorCritic) -> None:
  plain, errors = value_loss(networks)
  assert plain == pytest.approx(0.25 * np.square(errors).mean(), rel=1e-4)
  assert value_loss(networks, scale=4.0)[0] == pytest.approx(plain / 16, rel=1e-4)
  far = np.abs(errors / 4)
  assert far.min() < 1 < far.max()
  huber = np.where(far < 1, 0.5 * far**2, far - 0.5)
  assert value_loss(networks, scale=4.0, value_huber_delta=1.0)[0] == pytest.approx(0.5 * huber.mean(), rel=1e-4)


def test_advantages_are_clipped(networks: ActorCritic) -> None:
  params, data = networks.init(jax.random.PRNGKey(0)), batch(networks)
  advantages = jnp.linspace(-3, 3, 24).reshape(6, 4)
  loss = lambda a, **changes: ppo_loss(
    params, data.replace(targets=a, advantages=a), jax.random.PRNGKey(1), networks,
    dataclasses.replace(SMALL_PPO, **changes),
  )[1]["policy_loss"]  # fmt: skip
  assert float(loss(advantages, clip_advantages=1.0)) == pytest.approx(float(loss(jnp.clip(advantages, -1, 1))))
  assert float(loss(advantages, clip_advantages=1.0)) != pytest.approx(float(loss(advantages)))


def test_a_far_ratio_counts_no_more_with_dual_clip(networks: ActorCritic) -> None:
  """A ratio of e^30 with a negative advantage has that much of the gradient, and one of e^100 is not finite."""
  params, data = networks.init(jax.random.PRNGKey(0)), batch(networks)
  now = networks.distribution.log_prob(networks.logits(params.policy, data.obs), data.raw_action)

  def gradient(far: float, advantage: float = -1.0, dual_clip: float | None = None) -> float:
    """Norm of the policy's gradient on a batch whose first sample was `far` less likely when it was drawn."""
    advantages = jnp.ones((6, 4)).at[0, 0].set(advantage)
    known = data.replace(targets=advantages, advantages=advantages, log_prob=now.at[0, 0].add(-far))
    config = dataclasses.replace(SMALL_PPO, dual_clip=dual_clip)
    loss = lambda policy: ppo_loss(
      params.replace(policy=policy), known, jax.random.PRNGKey(1), networks, config
    )[1]["policy_loss"]  # fmt: skip
    return float(optax.global_norm(jax.grad(loss)(params.policy)))

  assert gradient(30.0) > 1e9 * gradient(0.0)
  assert not np.isfinite(gradient(100.0))
  assert gradient(100.0, dual_clip=3.0) == gradient(30.0, dual_clip=3.0) == pytest.approx(gradient(0.0), rel=2)
  near = 0.05  # of the ratio below the limit, and of a positive advantage, the gradient is the same
  assert gradient(near, dual_clip=3.0) == gradient(near)
  assert gradient(30.0, advantage=1.0, dual_clip=3.0) == gradient(30.0, advantage=1.0)


def test_the_mirror_image_counts_as_much_as_what_was_experienced(networks: ActorCritic) -> None:
  """The loss on a batch and its mirror image is that on both, one beside the other (RSL-RL's augmentation)."""
  params, data = networks.init(jax.random.PRNGKey(0)), batch(networks)
  obs, action = jax.tree.map(lambda x: -x, data.obs), -data.raw_action
  advantages = jnp.linspace(-3, 3, 24).reshape(6, 4)
  known = {"targets": advantages + 1, "advantages": advantages}
  beside = lambda x, y: jnp.concatenate([x, y], axis=1)
  same = {**known, "log_prob": data.log_prob, "truncation": data.truncation}
  twice = {name: beside(value, value) for name, value in same.items()}
  both = data.replace(obs=jax.tree.map(beside, data.obs, obs), raw_action=beside(data.raw_action, action), **twice)
  parts = lambda batch: ppo_loss(params, batch, jax.random.PRNGKey(1), networks, SMALL_PPO)[1]
  ours, theirs = parts(data.replace(mirrored_obs=obs, mirrored_action=action, **known)), parts(both)
  alone = parts(data.replace(**known))
  for name in ("policy_loss", "value_loss"):
    assert float(ours[name]) == pytest.approx(float(theirs[name]), rel=1e-5)
    assert float(ours[name]) != pytest.approx(float(alone[name]), rel=1e-3)
  for name in ("entropy", "approx_kl"):
    assert float(ours[name]) == float(alone[name]), "of what was experienced"


def test_the_critic_learns_nothing_where_time_cut_an_episode(networks: ActorCritic) -> None:
  """Also with targets of an earlier critic, from which it has moved since."""
  params, data = networks.init(jax.random.PRNGKey(0)), batch(networks)
  known = {"targets": jnp.ones((6, 4)), "advantages": jnp.ones((6, 4))}
  loss = lambda cut: ppo_loss(
    params, data.replace(truncation=jnp.full((6, 4), cut), **known), jax.random.PRNGKey(1), networks, SMALL_PPO
  )[1]["value_loss"]
  assert loss(1.0) == 0 < loss(0.0)


def test_a_task_without_a_mirror_is_refused() -> None:
  with pytest.raises(ConfigError, match=r"agent\.mirror_augmentation=true: only tasks of robots on legs"):
    point_trainer(dataclasses.replace(SMALL_PPO, mirror_augmentation=True))


def test_observations_are_clipped_as_the_networks_read_them(networks: ActorCritic) -> None:
  limited = ActorCritic(PointTask().observation_size, 2, dataclasses.replace(SMALL_PPO.network, clip_observations=0.5))
  params, obs = networks.init(jax.random.PRNGKey(0)), batch(networks).obs
  clipped = jax.tree.map(lambda x: jnp.clip(x, -0.5, 0.5), obs)
  np.testing.assert_array_equal(limited.logits(params.policy, obs), networks.logits(params.policy, clipped))
  np.testing.assert_array_equal(limited.value(params.value, obs), networks.value(params.value, clipped))
  assert not np.array_equal(limited.logits(params.policy, obs), networks.logits(params.policy, obs))


def test_targets_of_the_first_epoch_are_those_of_the_first_minibatch(networks: ActorCritic) -> None:
  """With one minibatch, which is all of the data, both ways are the same."""
  config = dataclasses.replace(SMALL_PPO, num_minibatches=1, batch_size=32, num_updates_per_batch=1)
  ends = []
  for targets in ("minibatch", "epoch"):
    trainer = point_trainer(dataclasses.replace(config, targets=targets))
    state, _ = trainer.train(trainer.init(jax.random.PRNGKey(0), {}, None, trainer.settings), {}, np.int32(2))
    ends.append(jax.device_get(trainer.policy(state).params))
  jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-4, atol=2e-5), *ends)


def test_an_update_makes_no_step_beyond_the_limit() -> None:
  trainers = [
    point_trainer(dataclasses.replace(SMALL_PPO, num_updates_per_batch=3, learning_rate=0.05, max_kl=limit))
    for limit in (1e-6, 1e9)
  ]
  steps, moved, stopped = [], [], []
  for trainer in trainers:
    state = trainer.init(jax.random.PRNGKey(0), {}, None, trainer.settings)
    start = jax.device_get(trainer.policy(state).params)
    state, log = trainer.train(state, {}, np.int32(1))
    end = jax.device_get(trainer.policy(state).params)
    moved.append(max(np.abs(a - b).max() for a, b in zip(jax.tree.leaves(start), jax.tree.leaves(end), strict=True)))
    steps.append(float(log["gradient_steps"]))
    stopped.append(float(log["stopped_early"]))
  assert stopped == [1, 0] and steps == [1, 3 * SMALL_PPO.num_minibatches]
  assert moved[0] == pytest.approx(0.05, rel=1e-2), "Adam's first step, and no other"
  assert moved[1] > 0.06


def test_all_of_them_learn_and_resume_bit_for_bit() -> None:
  whole, first, second = Recorder(), Recorder(stop_after=2), Recorder()
  expected, _ = run(ROBUST, whole, updates=60)
  scores = [row["eval/episode_reward"] for _, row in whole.rows if "eval/episode_reward" in row]
  assert scores[-1] > 0.6 * scores[0]
  row = next(row for _, row in whole.rows if "training/kl" in row)
  assert 0 < row["training/kl"] < 0.2
  assert 1e-5 <= row["training/learning_rate"] <= 1e-2
  run(ROBUST, first, updates=60)
  update, saved = first.saved[-1]
  got, _ = run(ROBUST, second, updates=60, resumed=(point_trainer(ROBUST).place(saved), update))
  jax.tree.map(np.testing.assert_array_equal, jax.device_get(expected), jax.device_get(got))
