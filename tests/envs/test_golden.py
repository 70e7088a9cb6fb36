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
# Compiling a legged robot's physics takes a minute. One of them is stepped always, the others by `make test-slow`; that
# their models are right, tests/robots shows without compiling anything.
LEGGED = ("Apollo", "Barkour", "Berkeley", "G1", "Go1", "H1", "Op3", "Spot", "T1")
SLOW = {name for name in TASKS if name.startswith(LEGGED)} - {"Go1JoystickFlatTerrain"}
SIMULATED = [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in TASKS]


@pytest.fixture(params=TASKS, scope="module")
def recording(request: pytest.FixtureRequest) -> Golden:
  return golden(request.param)


@pytest.fixture(params=SIMULATED, scope="module")
def simulated(request: pytest.FixtureRequest) -> Golden:
  """A recording whose physics is computed, too."""
  if request.param in ON_ROUGH_GROUND:
    pytest.skip("the ground is another, and all else is the flat task")
  return golden(request.param)


def before(recording: Golden) -> State:
  return jax.tree.map(lambda x: x[:-1], recording.states)


def after(recording: Golden) -> State:
  return jax.tree.map(lambda x: x[1:], recording.states)


def test_nothing_recorded_is_left_out(recording: Golden) -> None:
  assert recording.missing() == []


def test_reset(simulated: Golden) -> None:
  start = jax.tree.map(lambda x: x[0], simulated.states)
  if simulated.name in SETTLED_AT_RESET:
    assert_same_physics(simulated, simulated.first, start)
    return
  for name, actual, expected in simulated.pairs(simulated.first, start):
    atol = 1e-6 * max(1.0, np.nanmax(np.abs(expected), initial=0.0))
    np.testing.assert_allclose(actual, expected, atol=atol, rtol=1e-5, err_msg=name)


def test_functions(recording: Golden) -> None:
  expected = after(recording)
  disturbed = jax.vmap(recording.env.disturb)(before(recording))  # draws from rng
  state = jax.vmap(recording.env.evaluate)(expected.data, disturbed.info, recording.actions)
  for name, ours, theirs in recording.pairs(state, expected):
    np.testing.assert_allclose(ours, theirs, atol=1e-5, rtol=1e-4, err_msg=name)


def test_one_step_of_physics(simulated: Golden) -> None:
  state = jax.vmap(simulated.env.step)(before(simulated), simulated.actions)
  assert_same_physics(simulated, state, after(simulated))


def assert_same_physics(recording: Golden, state: State, expected: State) -> None:
  for name, ours, theirs in recording.pairs(state, expected):
    bound = STEP_BOUNDS.get(name, OTHER_BOUND) * max(1.0, np.nanmax(np.abs(theirs), initial=0.0))
    np.testing.assert_allclose(ours, theirs, atol=bound, rtol=0, err_msg=name)
