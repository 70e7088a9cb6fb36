"""The left-right mirror: twice is nothing, and the mirror image of a step is a step of the mirror image."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground import registry
from playground.envs.base import State
from playground.envs.c_physics import on_c_physics
from playground.envs.symmetry import Mirror, Reflection, joint_reflection, mirror_of
from playground.errors import ConfigError
from playground.mdp import observations
from playground.mdp.options import mirrors_as
from playground.mdp.terms import find
from tests.dummy import PointTask

ROBOTS = ["Go1JoystickFlatTerrain", pytest.param("G1JoystickFlatTerrain", marks=pytest.mark.slow)]
OTHERS = ["T1JoystickFlatTerrain", "BerkeleyHumanoidJoystickFlatTerrain", "H1JoystickGaitTracking", "Op3Joystick"]
OTHERS += ["ApolloJoystickFlatTerrain", "SpotFlatTerrainJoystick", "BarkourJoystick"]
POLAR, AXIAL, QUATERNION = np.array([1, -1, 1]), np.array([-1, 1, -1]), np.array([1, -1, 1, -1])
TOLERANCE = 0.1  # of a term's length: drawn robots are not quite symmetric, and contacts amplify that


@cache
def load(name: str) -> Any:
  """A task without noise and pushes on C MuJoCo, whose solver converges: one iteration favours the first contacts.

  The Go1's inertial sensor and the trunk's centre of mass are moved into the plane of the mirror, by 6.6 and 0.2 cm.
  """
  env: Any = registry.load(name, overrides={"impl": "jax", "noise_level": 0.0, "events.push.enabled": False})
  env.mj_model.opt.iterations = env.mj_model.opt.ls_iterations = 100
  env.mj_model.site_pos[env.robot.base_site, 1] = env.mj_model.body_ipos[env.robot.root, 1] = 0
  return on_c_physics(env)


@cache
def mirror(name: str) -> Mirror:
  return mirror_of(load(name))


def mirrored(state: State, joints: Reflection, feet: np.ndarray) -> State:
  """The mirror image of a state, written out by hand: positions, velocities, and what the task carries."""
  data, info = state.data, state.info
  qpos = jnp.concatenate([data.qpos[:3] * POLAR, data.qpos[3:7] * QUATERNION, joints(data.qpos[7:])])
  velocity = lambda v: jnp.concatenate([v[:3] * POLAR, v[3:6] * AXIAL, joints(v[6:])])
  changed: dict[str, Any] = {"command": info["command"] * np.array([1, -1, -1])}
  changed |= {name: joints(info[name]) for name in ("last_act", "last_last_act")}
  for name in ("phase", "feet_air_time", "swing_peak", "last_contact"):
    changed |= {name: info[name][feet]} if name in info else {}
  data = data.replace(
    qpos=qpos, qvel=velocity(data.qvel), ctrl=joints(data.ctrl), qacc_warmstart=velocity(data.qacc_warmstart)
  )
  return state.replace(data=data, info=info | changed)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_step_of_the_mirror_image_is_the_mirror_image_of_the_step(name: str) -> None:
  env, of = load(name), mirror(name)
  sides = {"FL": "FR", "FR": "FL", "RL": "RR", "RR": "RL", "left_foot": "right_foot", "right_foot": "left_foot"}
  feet = np.array([env.robot.foot_names.index(sides[foot]) for foot in env.robot.foot_names])
  step = jax.jit(env.step)
  state = jax.jit(env.reset)(jax.random.PRNGKey(1))
  draw = lambda i: 0.2 * jax.random.uniform(jax.random.PRNGKey(i), (env.action_size,), minval=-1)
  for _ in range(20):  # until it stands: the moment of an impact differs by more than the tolerance
    state = step(state, jnp.zeros(env.action_size))
  image = step(mirrored(state, of.action, feet), of.action(draw(1)))
  state = step(state, draw(1))
  for group, sizes in env.observation_parts.items():
    parts = np.cumsum(list(sizes.values()))[:-1]
    found, expected = (np.split(np.asarray(x), parts) for x in (image.obs[group], of.obs[group](state.obs[group])))
    for term, ours, theirs in zip(sizes, found, expected, strict=True):
      apart, length = np.linalg.norm(ours - theirs), np.linalg.norm(theirs)
      assert apart <= TOLERANCE * max(length, 0.1), (group, term, ours, theirs)


@pytest.mark.parametrize("name", ROBOTS)
def test_mirroring_twice_changes_nothing(name: str) -> None:
  of = mirror(name)
  for reflection in (of.action, *of.obs.values()):
    x = jnp.arange(1.0, len(reflection.sign) + 1)
    np.testing.assert_array_equal(reflection(reflection(x)), x)
    assert not np.array_equal(reflection(x), x)


def test_the_vectors_of_a_go1() -> None:
  env, of = load("Go1JoystickFlatTerrain"), mirror("Go1JoystickFlatTerrain")
  np.testing.assert_array_equal(of.action.source, [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8])
  np.testing.assert_array_equal(of.action.sign, [-1, 1, 1] * 4)
  starts = np.cumsum([0, *env.observation_parts["state"].values()])
  sign = dict(zip(env.observation_parts["state"], np.split(of.obs["state"].sign, starts[1:-1]), strict=True))
  for term, signs in (("linvel", POLAR), ("gyro", AXIAL), ("gravity", POLAR), ("command", [1, -1, -1])):
    np.testing.assert_array_equal(sign[term], signs, err_msg=term)


@pytest.mark.slow
@pytest.mark.parametrize("name", OTHERS)
def test_the_joints_of_other_robots_mirror(name: str) -> None:
  joints = joint_reflection(registry.load(name, overrides={"impl": "jax"}).robot)
  np.testing.assert_array_equal(joints.source[joints.source], np.arange(len(joints.source)))
  np.testing.assert_array_equal(joints.sign[joints.source], joints.sign)


def test_every_observation_of_legged_robots_says_how_it_mirrors() -> None:
  tasks = [
    "Go1JoystickFlatTerrain",
    "G1JoystickFlatTerrain",
    "Go1Getup",
    "Go1Handstand",
    "H1InplaceGaitTracking",
    *OTHERS,
  ]
  groups = [group for task in tasks for group in registry.config(task).observations.values() if group]
  terms = [(name, entry) for group in groups for name, entry in group.items() if entry is not None]
  names = {entry.get("func") or name for name, entry in terms} - {"state"}
  assert len(names) > 20
  assert [name for name in names if not hasattr(find("observations", name, name), "mirror")] == []


def test_what_has_no_mirror_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
  with pytest.raises(ConfigError, match="only tasks of robots on legs have a left-right mirror"):
    mirror_of(PointTask())
  env = load("Go1JoystickFlatTerrain")
  monkeypatch.delattr(observations.gyro, "mirror")
  with pytest.raises(ConfigError, match=r"env.observations.state.gyro does not say how it mirrors: .*:gyro"):
    mirror_of(env)
  mirrors_as("axial")(observations.gyro)
  for pairs, sentence in (({}, "no `mirror`"), ({"F": "X"}, "would be"), ({"FR": "RL"}, "not mirror images")):
    monkeypatch.setattr(env.robot, "left_to_right", pairs)
    with pytest.raises(ConfigError, match=sentence):
      joint_reflection(env.robot)


@pytest.mark.parametrize(("scale", "even"), [(-2.0, True), ([1.0, 2.0] * 2, False), ([1.0, -1.0] * 2, False)], ids=str)
def test_a_scale_is_the_same_on_both_sides(scale: Any, even: bool) -> None:
  """Of the feet FR, FL, RR, RL."""
  key = "observations.state"
  env = registry.load("Go1JoystickFlatTerrain", overrides={key: None, f"{key}.last_contact": {"scale": scale}})
  if even:
    np.testing.assert_array_equal(mirror_of(env).obs["state"](np.arange(4.0)), [1, 0, 3, 2])  # pyright: ignore
  else:
    with pytest.raises(ConfigError, match=r"last_contact: its scale or clip is not the same on the left and"):
      mirror_of(env)
