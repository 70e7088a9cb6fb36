"""What managers do with terms: weights and conditions, noise, clips, scales, delays, histories, frames."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ml_collections import ConfigDict

from playground.envs.locomotion.legged import LeggedTask
from playground.errors import ConfigError, UnknownNameError
from playground.mdp.context import StepContext
from playground.mdp.managers import EventManager, ObservationManager, RewardManager, TerminationManager
from tests.mdp.context import context

KEY = jax.random.PRNGKey(0)
MANY = jax.random.split(KEY, 4000)

# Rewards and terminations


def values(command: tuple[float, float, float] = (1.0, 0.0, 0.0), **section: Any) -> dict[str, float]:
  return {name: float(value) for name, value in RewardManager(section).compute(context(command)).items()}


def test_rewards_are_weighted() -> None:
  terms = values(action_l2={"weight": -2.0}, hard={"func": "pose_l2", "weight": 10}, joint_acc_l2={"weight": 0})
  assert list(terms) == ["action_l2", "hard"]  # a weight of 0 computes and logs nothing
  np.testing.assert_allclose(list(terms.values()), [-0.2, 0.688], rtol=1e-5)


@pytest.mark.parametrize(("speed", "moving", "still"), [(0.11, 1.0, 0.0), (0.09, 0.0, 1.0)])
def test_rewards_may_count_only_when_moving_or_still(speed: float, moving: float, still: float) -> None:
  section = {
    "moving": {"func": "constant", "weight": 1, "when": {"command_above": 0.1}},
    "still": {"func": "constant", "weight": 1, "when": {"command_below": 0.1}},
    "between": {"func": "constant", "weight": 1, "when": {"command_above": 0.05, "command_below": 0.1}},
    "always": {"func": "constant", "weight": 1},
  }
  expected = {"moving": moving, "still": still, "between": still, "always": 1.0}
  assert values((0.0, 0.0, speed), **section) == values((-speed, 0.0, 0.0), **section) == expected


@pytest.mark.parametrize(
  ("entry", "message"),
  [
    ({"weight": "1"}, r"env\.rewards\.constant\.weight=1 must be a number from"),
    ({"weight": float("inf")}, r"weight=inf must be a number from"),
    ({"weight": 1, "when": {"command_over": 1}}, r"when\.command_over does not exist.*Did you mean 'command_above'\?"),
    ({"weight": 1, "when": {"command_above": "x"}}, r"when\.command_above=x must be a number"),
  ],
)
def test_rewards_that_cannot_be(entry: Any, message: str) -> None:
  with pytest.raises(ConfigError, match=message):
    values(constant=entry)


def test_a_term_that_needs_what_the_task_does_not_have() -> None:
  c = context()
  del c.info["command"]  # pyright: ignore[reportIndexIssue]
  with pytest.raises(
    ConfigError, match=r"^env\.rewards\.constant: .*reads info\['command'\], which this task does not have"
  ):
    RewardManager({"constant": {"weight": 1, "when": {"command_above": 1}}}).compute(c)


def test_an_error_within_a_term_names_the_term() -> None:
  c, section = context(), {"low": {"func": "base_height_below", "params": {"limit": 0.2}}}

  def find_joints(name: str) -> np.ndarray:
    raise UnknownNameError(f"joints={name!r} matches no joint of the robot.")

  c.robot.find_joints = find_joints
  with pytest.raises(UnknownNameError, match=r"^env\.rewards\.hip_deviation_l1: joints='hip_rolls' matches no joint"):
    RewardManager({"hip_deviation_l1": {"weight": 1}}).compute(c)
  manager = TerminationManager({"hips": {"func": "playground.mdp.rewards:hip_deviation_l1"}} | section)
  c.env.terminations = manager  # pyright: ignore[reportAttributeAccessIssue]
  with pytest.raises(
    UnknownNameError, match=r"^env\.terminations\.hips: joints='hip_rolls'"
  ):  # once, of the inner term
    RewardManager({"is_terminated": {"weight": 1}}).compute(c)


def test_any_termination_ends_the_episode() -> None:
  section = {"low": {"func": "base_height_below", "params": {"limit": 0.2}}, "power_above": {"params": {"limit": 1}}}
  manager, c = TerminationManager(section), context()
  assert {name: bool(value) for name, value in manager.compute(c).items()} == {"low": False, "power_above": True}
  assert manager.any(c)
  assert not TerminationManager({**section, "power_above": None}).any(c)
  assert not TerminationManager({}).any(c)


def test_a_term_with_time_out_cuts_an_episode_unless_another_ends_it() -> None:
  low, power = {"func": "base_height_below", "params": {"limit": 9.0}}, {"params": {"limit": 1}}
  for sections, done, info in (
    ({"low": low}, 1, {}),
    ({"low": {**low, "time_out": True}}, 1, {"time_out": 1}),
    ({"low": {**low, "time_out": True}, "power_above": power}, 1, {"time_out": 0}),
    ({"low": {"func": "base_height_below", "params": {"limit": 0.2}, "time_out": True}}, 0, {"time_out": 0}),
  ):
    manager, c = TerminationManager(sections), context()
    c.env.terminations = manager  # pyright: ignore[reportAttributeAccessIssue]
    assert manager.end(c) == (done, info)
    assert manager.start().keys() == info.keys()


@pytest.mark.parametrize(
  ("manager", "value"),
  [
    (RewardManager({"mine": {"func": "joint_vel_l2", "weight": 1.0}}), 0.5),
    (TerminationManager({"mine": {"func": "nonfinite_state"}}), True),
  ],
)
def test_a_term_returns_one_number(manager: RewardManager | TerminationManager, value: float) -> None:
  def compute(func: Any) -> Any:
    manager.groups = {kind: [term._replace(func=func)]}
    return manager.compute(context())["mine"]

  ((kind, (term,)),) = manager.groups.items()
  assert compute(lambda c: value) == value
  with pytest.raises(ConfigError, match=rf"^env\.{kind}\.mine returns nothing: <lambda> lacks a `return`"):
    compute(lambda c: None)
  with pytest.raises(ConfigError, match=rf"^env\.{kind}\.mine must return one number, and returns 2 of them: add .sum"):
    compute(lambda c: c.joint_vel)


@pytest.mark.parametrize("value", [0.5, 1])
def test_a_termination_returns_a_bool(value: float) -> None:
  manager = TerminationManager({"mine": {"func": "nonfinite_state"}})
  manager.groups = {"terminations": [manager.terms[0]._replace(func=lambda c: value)]}
  with pytest.raises(ConfigError, match=r"^env\.terminations\.mine must return a bool, and returns (float|int)32: "):
    manager.compute(context())


@pytest.mark.parametrize(
  ("total", "clip", "value"),
  [
    ("sum", None, 0.02 * (3 - 1.5)),
    ("product", None, 0.02 * 3 * np.exp(-0.2 * 1.5)),
    ("sum", (-1.0, 0.01), 0.01),
  ],
)
def test_totals(total: str, clip: Any, value: float) -> None:
  task: Any = LeggedTask.__new__(LeggedTask)
  weights = {"upright_exp": 2.0, "constant": 1.0, "pose_l2": -1.0, "action_l2": -3.0}
  task.rewards = RewardManager({name: {"weight": weight} for name, weight in weights.items()})
  task.dt, task._reward_total, task._reward_clip = 0.02, total, clip
  rewards = {"upright_exp": 2.0, "constant": 1.0, "pose_l2": -1.0, "action_l2": -0.5}
  reward = task.clipped(task.total({name: jnp.array(v) for name, v in rewards.items()}))
  np.testing.assert_allclose(reward, value, rtol=1e-6)


# Observations


def moment(q: float = 0.5, command: float = 3.0) -> Any:
  """Two joints at `q` and -`q`, with targets 0.1 and 0.2 and default pose 0."""
  data = SimpleNamespace(qpos=jnp.array([q, -q]), qvel=jnp.array([q, 2 * q]), ctrl=jnp.array([0.1, 0.2]))
  robot = SimpleNamespace(qpos=slice(None), qvel=slice(None), default_pose=jnp.zeros(2))
  env: Any = SimpleNamespace(robot=robot, dt=0.02)
  return StepContext(env, data, {"command": jnp.full(3, command)}, jnp.zeros(2))  # pyright: ignore[reportArgumentType]


def manager(level: float = 1.0, frames: int = 1, order: Any = None, critic: Any = None, **state: Any):
  return bound({"critic": critic, "state": state or {"joint_pos": {}}}, level, frames, order)


def bound(groups: Any, level: float = 1.0, frames: int = 1, order: Any = None) -> ObservationManager:
  settings = {"noise_level": level, "observation_frames": frames, "observation_order": order}
  return ObservationManager(SimpleNamespace(observations=groups, **settings))


def observe(of: ObservationManager, now: Any, buffers: Any = None, key: jax.Array = KEY) -> tuple[Any, Any]:
  return of.compute(now, key, buffers)


def roll(of: ObservationManager, *moments: Any) -> list[Any]:
  """The observations of an episode."""
  seen, buffers = [], None
  for now in moments:
    obs, buffers = observe(of, now, buffers)
    seen.append(jax.tree.map(np.asarray, obs))
  return seen


def draws(**term: Any) -> np.ndarray:
  """Many observations of the joints, shape [draws, 2]."""
  of = manager(joint_pos=term)
  return np.asarray(jax.jit(jax.vmap(lambda key: of.compute(moment(), key)[0]))(MANY))


def test_groups_hold_terms_in_the_order_listed_the_first_as_the_policy_reads_it() -> None:
  both = manager(critic={"joint_vel": {}, "state": {}, "gone": None}, command={}, joint_pos={})
  (obs,) = roll(both, moment())
  np.testing.assert_allclose(obs["state"], [3, 3, 3, 0.5, -0.5])
  np.testing.assert_allclose(obs["critic"], [0.5, 1, 3, 3, 3, 0.5, -0.5])
  sizes = {"state": {"command": 3, "joint_pos": 2}, "critic": {"joint_vel": 2, "state": 5}}
  assert both.sizes(moment) == sizes
  (obs,) = roll(manager(command={}, joint_pos={}), moment())  # one group alone is no mapping
  assert obs.shape == (5,)


def test_the_order_may_be_given_apart() -> None:
  (obs,) = roll(manager(order={"state": ["joint_vel"]}, command={}, joint_pos={}, joint_vel={}), moment())
  np.testing.assert_allclose(obs, [0.5, 1, 3, 3, 3, 0.5, -0.5])
  with pytest.raises(UnknownNameError, match=r"env\.observation_order\.state: 'joint_vell'.*Did you mean 'joint_vel'"):
    manager(order={"state": ["joint_vell"]}, joint_vel={})
  with pytest.raises(UnknownNameError, match=r"env\.observation_order: 'stat' is unknown.*Did you mean 'state'"):
    manager(order={"stat": ["joint_vel"]}, joint_vel={})


def test_a_value_is_clipped_and_then_scaled() -> None:
  (obs,) = roll(manager(command={"clip": [0, 2], "scale": [2, 2, 0.25]}, joint_pos={"scale": 4}), moment())
  np.testing.assert_allclose(obs, [4, 4, 0.5, 2, -2])


def test_uniform_noise_fills_its_amplitude_on_each_element() -> None:
  noise = draws(noise={"uniform": [0.2, 0.1]}) - [0.5, -0.5]
  np.testing.assert_allclose(np.abs(noise).max(0), [0.2, 0.1], rtol=1e-2)
  np.testing.assert_allclose(noise.mean(0), 0, atol=0.01)
  assert abs((noise[:, 0] * noise[:, 1]).mean()) < 1e-3


def test_gaussian_noise() -> None:
  noise = draws(noise={"gaussian": 0.2}) - [0.5, -0.5]
  np.testing.assert_allclose(noise.std(0), 0.2, rtol=0.1)
  assert noise.max() > 0.5


def test_null_removes_a_kind_of_noise_or_a_condition() -> None:
  np.testing.assert_array_equal(draws(noise={"uniform": None, "gaussian": 0.2}), draws(noise={"gaussian": 0.2}))
  np.testing.assert_array_equal(draws(noise={"uniform": None}), draws())
  section = {"still": {"func": "constant", "weight": 1, "when": {"command_below": 0.1, "command_above": None}}}
  assert values((0.0, 0.0, 0.0), **section) == {"still": 1.0}


def test_noise_comes_before_clip_and_scale() -> None:
  obs = draws(noise={"uniform": 1.0}, clip=[0.4, 0.6], scale=10)
  assert (obs[:, 0].min(), obs[:, 0].max()) == (4, 6)


@pytest.mark.parametrize("level", [0.0, 0.5])
def test_the_level_is_a_factor_on_all_noise_and_leaves_the_draws_alone(level: float) -> None:
  term = {"noise": {"uniform": 1.0}}
  clean = np.array([3, 3, 3, 0.5, -0.5])
  loud, quiet = (roll(manager(of, command=term, joint_pos=term), moment())[0] - clean for of in (1.0, level))
  assert (loud != 0).all()
  np.testing.assert_allclose(quiet, level * loud, atol=1e-6)


def test_amplitudes_shorter_than_a_value_repeat() -> None:
  of = manager(history=dict(func="joint_pos", noise={"uniform": [0.0, 0.3]}, history=1), command={})
  (obs,) = roll(of, moment())
  assert obs[0] == 0.5 and obs[1] != -0.5


def test_what_is_computed_from_a_term_may_carry_its_noise() -> None:
  of = manager(joint_pos={"noise": {"uniform": 0.3}}, target_error={"noise": {"same_as": "joint_pos"}, "history": 2})
  (obs,) = roll(of, moment())
  noise = obs[:2] - [0.5, -0.5]
  assert (np.abs(noise) > 0).all()
  np.testing.assert_allclose(obs[2:4] - noise, [0.4, -0.7], atol=1e-6)
  assert not obs[4:].any()
  quiet = manager(0.0, joint_pos={"noise": {"uniform": 0.3}}, target_error={"noise": {"same_as": "joint_pos"}})
  np.testing.assert_allclose(roll(quiet, moment())[0], [0.5, -0.5, 0.4, -0.7])


def test_a_history_is_newest_first_and_begins_with_zeros() -> None:
  of = manager(command={}, past=dict(func="target_error", history=3), target_error={})
  assert of.sizes(moment)["state"] == {"command": 3, "past": 6, "target_error": 2}
  positions = (0.1, 0.2, 0.3, 0.4)
  seen = roll(of, *map(moment, positions))
  expected = np.array([[q - 0.1, -q - 0.2] for q in positions])
  np.testing.assert_allclose(seen[0][3:9], [*expected[0], 0, 0, 0, 0], atol=1e-7)
  np.testing.assert_allclose(seen[3][3:9], expected[3:0:-1].ravel(), atol=1e-7)


def test_a_delayed_term_has_read_the_start_for_long_and_then_what_was_steps_ago() -> None:
  of = manager(joint_pos={"delay": [2, 2], "history": 2})
  seen = roll(of, *map(moment, (0.1, 0.2, 0.3, 0.4, 0.5)))
  np.testing.assert_allclose([obs[0] for obs in seen], [0.1, 0.1, 0.1, 0.2, 0.3])
  np.testing.assert_allclose(seen[4], [0.3, -0.3, 0.2, -0.2])


def test_delays_are_drawn_in_every_step() -> None:
  of, buffers = manager(joint_pos={"delay": [0, 2]}), None
  for q in (0.1, 0.2, 0.3):
    _, buffers = observe(of, moment(q), buffers)
  seen = jax.jit(jax.vmap(lambda key: of.compute(moment(0.4), key, buffers)[0]))(MANY)
  found, counts = np.unique(np.asarray(seen)[:, 0], return_counts=True)
  np.testing.assert_allclose(found, [0.2, 0.3, 0.4])
  assert counts.min() > 1200


def test_frames_are_newest_first_and_begin_with_zeros() -> None:
  of = manager(frames=3, critic={"state": {}, "joint_vel": {}}, joint_pos={})
  first, _, third = roll(of, *map(moment, (0.1, 0.2, 0.3)))
  np.testing.assert_allclose(first["state"], [0.1, -0.1, 0, 0, 0, 0])
  np.testing.assert_allclose(third["state"], [0.3, -0.3, 0.2, -0.2, 0.1, -0.1])
  np.testing.assert_allclose(third["critic"], [*third["state"], 0.3, 0.6])
  sizes = {"state": {"joint_pos": 2, "past_frames": 4}, "critic": {"state": 6, "joint_vel": 2}}
  assert of.sizes(moment) == sizes


@pytest.mark.parametrize(
  ("entry", "message"),
  [
    ({"history": 0}, r"env\.observations\.state\.joint_pos\.history=0 must be a whole number from 1"),
    ({"delay": [2, 1]}, r"delay=\[2, 1\] must be 2 whole numbers"),
    ({"delay": 2}, r"delay=2 must be 2 whole numbers"),
    ({"clip": [1]}, r"clip=\[1\] must be 2 numbers"),
    ({"scale": "big"}, r"scale=big must be a number or a list of numbers"),
    ({"noise": 0.1}, r"noise=0\.1 must have one of the keys uniform, gaussian, same_as"),
    ({"noise": {"unifrm": 0.1}}, r"must have one of the keys uniform"),
    ({"noise": {"uniform": -0.1}}, r"noise\.uniform=-0\.1 must be a number or a list of numbers from 0"),
    ({"noise": {"same_as": "joint_vel"}}, r"noise\.same_as=joint_vel is no term with noise above it"),
  ],
)
def test_observations_that_cannot_be(entry: Any, message: str) -> None:
  with pytest.raises(ConfigError, match=message):
    manager(joint_pos=entry)


def test_noise_of_another_term_is_of_its_size() -> None:
  of = manager(gyro={"noise": {"uniform": 0.1}}, joint_pos={"noise": {"same_as": "gyro"}})
  message = r"^env\.observations\.state\.joint_pos\.noise\.same_as=gyro: that term has 3 elements, and this one has 2\."
  with pytest.raises(ConfigError, match=message):
    observe(of, context())


@pytest.mark.parametrize(
  "section", [{"critic": {"joint_pos": {}}}, {"state": None}, {"state": {"joint_pos": None}}], ids=str
)
def test_a_policy_reads_something(section: Any) -> None:
  with pytest.raises(ConfigError, match=r"env\.observations\.state is missing or empty"):
    bound(section)


@pytest.mark.parametrize("entry", [ConfigDict({"func": "qpos"}), {"func": "qpos"}, "{func: qpos}"], ids=type)
def test_the_entry_for_all_that_the_policy_reads_is_empty(entry: Any) -> None:
  with pytest.raises(ConfigError, match=r"^env\.observations\.critic\.state=\{func: qpos\} must be \{\}, for all of"):
    manager(critic={"state": entry})


# Events


@pytest.mark.parametrize(
  ("entry", "message"),
  [
    ({"func": "reset_root_xy", "mode": "interval", "params": {"distance": 1.0}}, "reset_root_xy is for mode: reset"),
    ({"func": "reset_root_xy", "mode": "startup", "params": {"distance": 1.0}}, "reset_root_xy is for mode: reset"),
    ({"func": "reset_root_xi", "mode": "reset"}, "Did you mean 'reset_root_xy'"),
    ({"func": "push_by_setting_velocity", "mode": "reset", "params": {"velocity": [0, 1], "interval_s": [1, 2]}},
     "PushBySettingVelocity is for mode: interval"),
    ({"func": "reset_root_xy", "mode": "reset", "params": {"distance": -1.0}}, "=-1.0 must be a number from 0"),
  ],
)  # fmt: skip
def test_events_that_cannot_be(entry: Any, message: str) -> None:
  with pytest.raises(ConfigError, match=message):
    EventManager({"x": entry}, None)


def test_an_interval_event_that_does_not_fit_the_task() -> None:
  robot = SimpleNamespace(root=1)
  jump = {"func": "push_by_setting_velocity", "mode": "interval", "params": {"velocity": [1, 1], "interval_s": [1, 1]}}
  events = EventManager({"jump": jump}, SimpleNamespace(dt=0.02, robot=robot))
  data: Any = SimpleNamespace(qvel=jnp.zeros(1), replace=None)
  with pytest.raises(ConfigError, match=r"^env\.events\.jump does not fit this task: "):
    events.step(data, {"rng": KEY, **events.reset(KEY, None)})
  with pytest.raises(ConfigError, match=r"^env\.events\.jump: the robot has no free root"):
    EventManager({"jump": jump}, SimpleNamespace(dt=0.02, robot=SimpleNamespace()))


def test_two_events_cannot_count_with_the_same_entries() -> None:
  params = {"velocity": [1.0, 1.0], "duration_s": [0.1, 0.1], "interval_s": [1.0, 1.0]}
  first = {"func": "push_by_force", "mode": "interval", "params": params}
  second = {**first, "params": params | {"interval_s": [2.0, 2.0]}}
  env = SimpleNamespace(dt=0.02, robot=SimpleNamespace(root=1, mass=lambda model: 1.0))
  with pytest.raises(ConfigError, match=r"^env\.events\.a and env\.events\.b both write info\['push_interval'\]: "):
    EventManager({"a": first, "b": second}, env).reset(KEY, None)
  off = {"enabled": False}
  for section in ({"a": first | off, "b": second}, {"b": second, "a": first | off}):
    assert EventManager(section, env).reset(KEY, None)["push_interval"] == 100


def test_events_that_are_switched_off_do_nothing_but_are_there() -> None:
  reset = {"func": "reset_root_xy", "mode": "reset", "enabled": False, "params": {"distance": 1.0}}
  jump = {"func": "push_by_setting_velocity", "params": {"velocity": [1.0, 1.0], "interval_s": [0.02, 0.02]}}
  model_field = {"mode": "startup", "params": {"field": "body_mass"}}
  section = {"a": reset, "b": {**jump, "mode": "interval", "enabled": False}, "model_field": model_field, "c": None}
  events = EventManager(section, SimpleNamespace(dt=0.02, robot=SimpleNamespace(root=1)))
  initial = object()
  assert events.start(KEY, None, initial) is initial
  info = {"rng": KEY, **events.reset(KEY, None)}
  assert set(info) == {"rng", "push", "push_step", "push_interval_steps", "pushing"}
  data: Any = SimpleNamespace(qvel=jnp.zeros(6))
  assert events.step(data, info) == (data, info)
