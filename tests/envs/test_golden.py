"""Every task with a recording reproduces Playground 0.2.0: its functions exactly, one step of physics to rounding."""

import jax
import numpy as np
import pytest

from playground.envs.base import State
from tests.envs.golden import TASKS, Golden, golden

# Ten times what a change of qpos, qvel and qacc_warmstart by one rounding moves one step, relative to max(1, largest
# entry). Obs, metrics and info mix these; the sensors' bound holds for them.
STEP_BOUNDS = {"data/qpos": 2e-5, "data/qvel": 1e-3, "data/qacc": 1e-2, "data/qacc_warmstart": 1e-2}
OTHER_BOUND = 2e-3
# Reset runs many steps of physics, which carry a rounding of the start as far as one step may (3e-5 in qvel, measured).
SETTLED_AT_RESET = {"CheetahRun", "Go1Getup", "SpotGetup"}
# The heights of upstream's rough ground are in a file that has no name; but for them these tasks are the flat ones.
ON_ROUGH_GROUND = {name for name in TASKS if name.endswith("RoughTerrain")}
# Compiling a legged robot's or a gripper's physics takes a minute. One of them is stepped always, the others by `make
# test-slow`; that their models are right, tests/robots shows without compiling anything.
LEGGED = ("Apollo", "Barkour", "Berkeley", "G1", "Go1", "H1", "Op3", "Spot", "T1")
HANDS = ("Aero", "Aloha", "Leap", "Panda")  # 0.2.0 resets them without physics
SLOW = {name for name in TASKS if name.startswith((*LEGGED, *HANDS))} - {"Go1JoystickFlatTerrain"}
SIMULATED = [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in TASKS]
STARTED = [
  pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW and not name.startswith(HANDS))) for name in TASKS
]
# Corners of boxes that rest on the floor touch or not as roundings have it: here the median step counts.
RESTING = {"PandaPickCube", "PandaPickCubeOrientation", "PandaPickCubeCartesian"}
# So do those of a cube between fingers, in all steps: here what counts is that most positions agree.
IN_HAND = ("Aero", "Leap")


@pytest.fixture(params=TASKS, scope="module")
def recording(request: pytest.FixtureRequest) -> Golden:
  return golden(request.param)


def on_known_ground(name: str) -> Golden:
  if name in ON_ROUGH_GROUND:
    pytest.skip("the ground is another, and all else is the flat task")
  return golden(name)


@pytest.fixture(params=STARTED, scope="module")
def started(request: pytest.FixtureRequest) -> Golden:
  """A recording whose reset is computed, too."""
  return on_known_ground(request.param)


@pytest.fixture(params=SIMULATED, scope="module")
def simulated(request: pytest.FixtureRequest) -> Golden:
  """A recording whose physics is computed, too."""
  return on_known_ground(request.param)


def before(recording: Golden) -> State:
  return jax.tree.map(lambda x: x[:-1], recording.states)


def after(recording: Golden) -> State:
  return jax.tree.map(lambda x: x[1:], recording.states)


def test_nothing_recorded_is_left_out(recording: Golden) -> None:
  assert recording.missing() == []


def test_reset(started: Golden) -> None:
  start = jax.tree.map(lambda x: x[0], started.states)
  if started.name in SETTLED_AT_RESET:
    assert_same_physics(started, started.first, start)
    return
  for name, actual, expected in started.pairs(started.first, start):
    # Forces are rounded differences of joint positions times a stiffness: some 1e-6 N m where 0 is meant.
    atol = 2e-6 * max(1.0, np.nanmax(np.abs(expected), initial=0.0))
    np.testing.assert_allclose(actual, expected, atol=atol, rtol=1e-5, err_msg=name)


def test_functions(recording: Golden) -> None:
  expected = after(recording)
  disturbed = jax.vmap(recording.env.disturb)(before(recording))  # draws from rng
  state = jax.vmap(recording.env.evaluate)(expected.data, disturbed.info, recording.actions)
  for name, ours, theirs in recording.pairs(state, expected):
    np.testing.assert_allclose(ours, theirs, atol=1e-5, rtol=1e-4, err_msg=name)


def test_control(recording: Golden) -> None:
  disturbed = jax.vmap(recording.env.disturb)(before(recording))
  ctrl = jax.vmap(recording.env.control)(disturbed, recording.actions)
  np.testing.assert_allclose(ctrl, after(recording).data.ctrl, atol=1e-5, rtol=1e-5)


def test_one_step_of_physics(simulated: Golden) -> None:
  state = jax.vmap(simulated.env.step)(before(simulated), simulated.actions)
  assert_same_physics(simulated, state, after(simulated))


def assert_same_physics(recording: Golden, state: State, expected: State) -> None:
  for name, ours, theirs in recording.pairs(state, expected):
    bound = STEP_BOUNDS.get(name, OTHER_BOUND) * max(1.0, np.nanmax(np.abs(theirs), initial=0.0))
    if recording.name.startswith(IN_HAND):
      assert name != "data/qpos" or np.median(np.abs(ours - theirs)) < bound
      continue
    if recording.name in RESTING:
      ours, theirs = (x[np.argsort(worst(ours, theirs))[: len(ours) // 2]] for x in (ours, theirs))
    np.testing.assert_allclose(ours, theirs, atol=bound, rtol=0, err_msg=name)


def worst(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
  """The largest difference in each step, shape [T]."""
  return np.abs(ours - theirs).reshape(len(ours), -1).max(axis=1, initial=0.0)
