"""Humanoid: rewards and observation by hand, and where episodes start; nothing needs the long compile."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from playground.envs.dm_control.humanoid import Humanoid
from tests.envs.dm_control.states import state_at
from tests.envs.golden import load_task

REST = jnp.zeros(21)
HEAD = 0.19  # m above the torso


@pytest.fixture(scope="module")
def tasks() -> dict[str, Humanoid]:
  return {name: load_task(name) for name in ("HumanoidStand", "HumanoidWalk", "HumanoidRun")}


def pose(head: float = 1.4, roll: float = 0.0) -> np.ndarray:
  """`qpos` with straight limbs, the head's centre at a height and the torso turned about x, the forward axis."""
  torso = head - HEAD * np.cos(roll)
  return np.array([3, -2, torso, np.cos(roll / 2), np.sin(roll / 2), 0, 0, *[0.0] * 21])


STANDING = [  # pose, standing, upright
  (pose(), 1, 1),
  (pose(head=1.05), 0.1, 1),
  (pose(roll=np.pi / 2), 1, 1 - 0.9 / 1.9),
  (pose(roll=np.pi), 1, 0),
]


@pytest.mark.parametrize(("qpos", "standing", "upright"), STANDING)
def test_standing(tasks: dict[str, Humanoid], qpos: np.ndarray, standing: float, upright: float) -> None:
  for name, factor in [("HumanoidStand", 1), ("HumanoidWalk", 1 / 6), ("HumanoidRun", 1 / 6)]:  # at rest
    state = tasks[name].post_step(state_at(tasks[name], qpos=qpos), {}, REST)
    np.testing.assert_allclose(state.reward, standing * upright * factor, atol=1e-5)


@pytest.mark.parametrize(
  ("name", "velocity", "move"),
  [
    ("HumanoidStand", (2, 0), 0.55),  # one of two directions at the margin of 2 m/s
    ("HumanoidWalk", (0.3, -0.4), 3.5 / 6),
    ("HumanoidWalk", (-1, 0), 1),
    ("HumanoidRun", (0, 2), 2 / 6),
    ("HumanoidRun", (8, 8), 1),
  ],
)
def test_moving_in_any_direction(
  tasks: dict[str, Humanoid], name: str, velocity: tuple[float, float], move: float
) -> None:
  data = state_at(tasks[name], qpos=pose(), qvel=[*velocity, *[0.0] * 25])
  state = tasks[name].post_step(data, {}, REST)
  np.testing.assert_allclose(state.reward, move, atol=1e-5)
  np.testing.assert_allclose(state.metrics["reward/move"], move, atol=1e-5)


def test_control_costs_a_fifth_at_most(tasks: dict[str, Humanoid]) -> None:
  env = tasks["HumanoidStand"]
  data = state_at(env, qpos=pose())
  rewards = [env.post_step(data, {}, jnp.full(21, action)).reward for action in (0.5, -1, 2)]
  np.testing.assert_allclose(rewards, [0.95, 0.8, 0.8], atol=1e-6)


def test_observation(tasks: dict[str, Humanoid]) -> None:
  env = tasks["HumanoidRun"]
  qpos, qvel = pose(roll=0.6), np.zeros(27)
  qpos[7:] = np.linspace(-0.2, 0.2, 21)
  qpos[22:] = 0  # arms as modelled
  qvel[:3] = [1, 2, 3]
  obs = np.array(env.observe(state_at(env, qpos=qpos, qvel=qvel)))
  parts = env.observation_parts["state"]
  joints, head, extremities, vertical, com_velocity, velocity = np.split(obs, np.cumsum([*parts.values()])[:-1])
  np.testing.assert_allclose(joints, qpos[7:], atol=1e-6)
  np.testing.assert_allclose(head, [1.4], atol=1e-6)
  hands = extremities.reshape(4, 3)[[0, 2]]  # left, right: seen from the torso, wherever that is
  np.testing.assert_allclose(hands, [[0.36, 0.17, 0.06], [0.36, -0.17, 0.06]], atol=1e-6)
  feet = extremities.reshape(4, 3)[[1, 3]]
  assert (feet[:, 2] < -1).all() and feet[0, 1] > feet[1, 1]
  np.testing.assert_allclose(vertical, [0, np.sin(0.6), np.cos(0.6)], atol=1e-6)
  np.testing.assert_allclose(com_velocity, [1, 2, 3], atol=1e-5)
  np.testing.assert_allclose(velocity, qvel, atol=1e-6)


def test_episodes_start_upright_above_the_floor(tasks: dict[str, Humanoid]) -> None:
  env = tasks["HumanoidRun"]
  data = mujoco.MjData(env.mj_model)
  data.qpos[:] = env.physics.make(**env.initial(jax.random.PRNGKey(3))).qpos
  mujoco.mj_forward(env.mj_model, data)
  assert data.ncon == 0
  soles = [data.geom(f"{side}_{side}_foot").xpos[2] - 0.027 for side in ("left", "right")]
  np.testing.assert_allclose(soles, 0.215, atol=1e-3)
  np.testing.assert_allclose(data.body("head").xpos, [0, 0, 1.5 + HEAD], atol=1e-6)
