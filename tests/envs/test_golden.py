"""Every task with a recording reproduces Playground 0.2.0, as `v020/<Task>` where it differs on purpose.

Its functions are compared exactly, one step of physics to rounding. What a reset draws is ours, so that the comparisons
start from the recorded states.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.envs.base import State
from playground.envs.task import Task
from playground.physics import backend
from tests.envs.dm_control.suite import COSTLY, DOMAIN
from tests.envs.golden import KEYS, TASKS, Golden, golden

# Ten times what a change of qpos, qvel and qacc_warmstart by one rounding moves one step, relative to max(1, largest
# entry). Obs, metrics and info mix these; the sensors' bound holds for them.
STEP_BOUNDS = {"data/qpos": 2e-5, "data/qvel": 1e-3, "data/qacc": 1e-2, "data/qacc_warmstart": 1e-2}
OTHER_BOUND = 2e-3
# The heights of upstream's rough ground are in a file that has no name; but for them these tasks are the flat ones.
ON_ROUGH_GROUND = {name for name in TASKS if name.endswith("RoughTerrain")}
# What differs between a rough task and its flat one is not recorded: one is compared always, all by `make test-slow`.
RECORDED = [
  pytest.param(name, marks=[pytest.mark.slow] * (name in ON_ROUGH_GROUND - {"Go1JoystickRoughTerrain"}))
  for name in TASKS
]
# Compiling a legged robot's or a gripper's physics takes a minute. One of them is stepped always, the others by `make
# test-slow`, as are the costly ones of the suite; that their models are right, tests/robots and
# tests/envs/dm_control/test_models.py show without compiling anything.
LEGGED = ("Apollo", "Barkour", "Berkeley", "G1", "Go1", "H1", "Op3", "Spot", "T1")
HANDS = ("Aero", "Aloha", "Leap", "Panda")
SLOW = {name for name in TASKS if name.startswith((*LEGGED, *HANDS))} - {"Go1JoystickFlatTerrain"}
SLOW |= {name for name in TASKS if DOMAIN.get(name) in COSTLY}
SIMULATED = [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in TASKS]
# Corners of boxes that rest on the floor touch or not as roundings have it: here the median step counts.
RESTING = {"PandaPickCube", "PandaPickCubeOrientation", "PandaPickCubeCartesian"}
# So do those of a cube between fingers, in all steps: here what counts is that most positions agree.
IN_HAND = ("Aero", "Leap")


@pytest.fixture(params=RECORDED, scope="module")
def recording(request: pytest.FixtureRequest) -> Golden:
  return golden(request.param)


@pytest.fixture(params=SIMULATED, scope="module")
def simulated(request: pytest.FixtureRequest) -> Golden:
  """A recording whose physics is computed, too."""
  if request.param in ON_ROUGH_GROUND:
    pytest.skip("the ground is another, and all else is the flat task")
  return golden(request.param)


def before(recording: Golden) -> State:
  """The states that the recorded actions were applied in."""
  return jax.vmap(recording.env.pre_step)(jax.tree.map(lambda x: x[:-1], recording.states))


def after(recording: Golden) -> State:
  return jax.tree.map(lambda x: x[1:], recording.states)


def test_nothing_recorded_is_left_out(recording: Golden) -> None:
  assert recording.missing() == []


def test_functions(recording: Golden) -> None:
  expected = after(recording)
  state = jax.vmap(recording.env.post_step)(expected.data, before(recording).info, recording.actions)
  for name, ours, theirs in recording.pairs(state, expected):
    np.testing.assert_allclose(ours, theirs, atol=1e-5, rtol=1e-4, err_msg=name)


def test_control(recording: Golden) -> None:
  ctrl = jax.vmap(recording.env.action_to_ctrl)(before(recording), recording.actions)
  np.testing.assert_allclose(ctrl, after(recording).data.ctrl, atol=1e-5, rtol=1e-5)


def test_first_observation(recording: Golden) -> None:
  """That of a recorded start: histories and frames have no past."""
  env, start = recording.env, jax.tree.map(lambda x: x[0], recording.states)
  if not isinstance(env, Task):
    pytest.skip("observes the state alone")
  c = env.context(env, start.data, start.info, jnp.zeros(env.action_size), dt=0.0)
  obs, _ = env.observations.compute(c, KEYS[0])
  for ours, theirs in zip(jax.tree.leaves(obs), jax.tree.leaves(start.obs), strict=True):
    np.testing.assert_allclose(ours, theirs, atol=1e-5, rtol=1e-4)


def test_one_step_of_physics(simulated: Golden, monkeypatch: pytest.MonkeyPatch) -> None:
  # MJX damped servos at their limits for 0.2.0; tests/physics/test_backend.py compares ours with C MuJoCo.
  monkeypatch.setattr(backend, "_without_saturated", lambda model, data: model)
  state = jax.vmap(simulated.env.step)(jax.tree.map(lambda x: x[:-1], simulated.states), simulated.actions)
  expected = after(simulated)
  for name, ours, theirs in simulated.pairs(state, expected):
    bound = STEP_BOUNDS.get(name, OTHER_BOUND) * max(1.0, np.nanmax(np.abs(theirs), initial=0.0))
    if simulated.name.startswith(IN_HAND):
      assert name != "data/qpos" or np.median(np.abs(ours - theirs)) < bound
      continue
    if simulated.name in RESTING:
      ours, theirs = (x[np.argsort(worst(ours, theirs))[: len(ours) // 2]] for x in (ours, theirs))
    np.testing.assert_allclose(ours, theirs, atol=bound, rtol=0, err_msg=name)


def worst(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
  """The largest difference in each step, shape [T]."""
  return np.abs(ours - theirs).reshape(len(ours), -1).max(axis=1, initial=0.0)


def test_apollos_one_term_of_tracking_is_our_two() -> None:
  recording = golden("ApolloJoystickFlatTerrain")
  state = jax.vmap(recording.env.post_step)(after(recording).data, before(recording).info, recording.actions)
  terms = [state.metrics[f"reward/track_{what}_velocity_exp"] for what in ("linear", "angular")]
  np.testing.assert_allclose(sum(terms), recording.recorded("metrics/reward/tracking")[1:], rtol=1e-4)
