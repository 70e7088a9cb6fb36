"""gymnasium's view of tasks: its own checker, its registry, and a batch whose episodes begin anew."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from playground.adapters.gym import GymEnv, GymVectorEnv, observation_space
from playground.errors import UnknownNameError
from playground.registry import names
from tests.dummy import Point

SHORT = {"episode_length": 5}


@pytest.fixture(scope="module")
def env() -> GymEnv:
  made = gymnasium.make("playground/CartpoleBalance", overrides=SHORT)
  assert isinstance(made.unwrapped, GymEnv)
  return made.unwrapped


def test_gymnasium_finds_nothing_to_complain_about(env: GymEnv) -> None:
  with warnings.catch_warnings():
    warnings.filterwarnings("error", module="gymnasium")
    warnings.filterwarnings("ignore", message=".*infinity.*")  # velocities have no bounds
    check_env(env, skip_render_check=True, skip_close_check=True)


def test_every_task_is_registered() -> None:
  assert {name for name in gymnasium.registry if name.startswith("playground/")} == {f"playground/{n}" for n in names()}


def test_time_truncates(env: GymEnv) -> None:
  env.reset(seed=1)
  steps = [env.step(np.zeros(1, np.float32)) for _ in range(SHORT["episode_length"])]
  assert [truncated for *_, truncated, _ in steps] == [False] * 4 + [True]
  assert not any(terminated for _, _, terminated, _, _ in steps)
  assert set(steps[0][-1]) == {f"reward/{name}" for name in ("upright", "centered", "small_control", "small_velocity")}


def test_a_batch_begins_anew_in_the_step_after_an_end() -> None:
  envs = gymnasium.make_vec("playground/CartpoleBalance", num_envs=3, overrides=SHORT, physics="c")
  assert isinstance(envs, GymVectorEnv)
  first, _ = envs.reset(seed=0)
  assert first.shape == (3, 5) and first in envs.observation_space
  for _ in range(5):
    obs, rewards, terminated, truncated, info = envs.step(np.ones((3, 1), np.float32))
  assert truncated.all() and not terminated.any()
  assert rewards.shape == info["reward/upright"].shape == (3,)
  began, rewards, terminated, truncated, _ = envs.step(np.ones((3, 1), np.float32))
  assert not rewards.any() and not terminated.any() and not truncated.any()
  assert np.abs(began[:, 3:]).max() < 0.1 < np.abs(obs[:, 3:]).max()  # at rest again
  assert not np.allclose(began, first)  # and drawn anew
  again, _ = envs.reset(seed=0)
  np.testing.assert_array_equal(again, first)


def test_one_entry_of_a_dict_observation() -> None:
  task = Point()
  assert set(observation_space(task)) == {"state", "privileged_state"}  # pyright: ignore[reportArgumentType]
  assert observation_space(task, "state").shape == (2,)
  with pytest.raises(UnknownNameError, match=r"entry: 'stat' is unknown.*Did you mean 'state'"):
    observation_space(task, "stat")


def test_a_wrong_name_is_one_sentence() -> None:
  with pytest.raises(UnknownNameError, match="physics: 'mj' is unknown"):
    gymnasium.make("playground/CartpoleBalance", physics="mj")
