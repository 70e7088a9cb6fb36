"""gymnasium's view of tasks: its own checker, its registry, and a batch whose episodes begin anew."""

# pyright: reportPossiblyUnboundVariable=false
# Loops of a constant length run at least once.

import os
import subprocess
import sys
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from playground.adapters.gym import GymEnv, GymVectorEnv, observation_space
from playground.envs.wrappers import PRESERVE_INFO
from playground.errors import ConfigError, PlaygroundError, UnknownNameError
from playground.registry import names
from playground.rendering.gl import NO_GL_REMEDY, find_gl
from tests.dummy import Point
from tests.processes import WITHOUT_WARP

SHORT = {"episode_length": 5}

# In a process of its own: MuJoCo chooses its OpenGL when it is imported. Whoever forgets to close gets no traceback.
RENDER = """
import gymnasium, playground.adapters.gym
env = gymnasium.make("playground/PendulumSwingup", render_mode="rgb_array")
env.reset(seed=0)
first = env.render()
for _ in range(20): env.step(env.action_space.sample())
image = env.render()
assert image.shape == (480, 640, 3) and image.std() > 10 and (image != first).any()
"""


@pytest.fixture(scope="module")
def env() -> GymEnv:
  made = gymnasium.make("playground/CartpoleBalance", overrides=SHORT)
  assert isinstance(made.unwrapped, GymEnv)
  return made.unwrapped


def test_gymnasium_finds_nothing_to_complain_about(env: GymEnv) -> None:
  with warnings.catch_warnings():
    warnings.filterwarnings("error", module="gymnasium")
    warnings.filterwarnings("ignore", message=".*infinity.*")  # velocities have no bounds
    check_env(env, skip_render_check=find_gl() is None)


@pytest.mark.parametrize("end", ["env.close(); env.close()", pytest.param("", marks=pytest.mark.slow)])
def test_renders_without_a_screen(end: str) -> None:
  if find_gl() is None:
    pytest.skip(NO_GL_REMEDY)
  others = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "DISPLAY")}
  headless = others | WITHOUT_WARP | {"JAX_PLATFORMS": "cpu"}
  done = subprocess.run([sys.executable, "-c", RENDER + end], env=headless, capture_output=True, text=True)
  assert (done.returncode, done.stderr) == (0, "")


def test_without_opengl_rendering_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setattr("playground.adapters.gym.find_gl", lambda: None)
  env = gymnasium.make("playground/CartpoleBalance", render_mode="rgb_array").unwrapped
  env.reset(seed=0)
  with pytest.raises(PlaygroundError, match=r"No working OpenGL was found: install one"):
    env.render()
  env.close()


def test_every_task_is_registered() -> None:
  assert {name for name in gymnasium.registry if name.startswith("playground/")} == {f"playground/{n}" for n in names()}


def test_time_truncates(env: GymEnv) -> None:
  env.reset(seed=1)
  steps = [env.step(np.zeros(1, np.float32)) for _ in range(SHORT["episode_length"])]
  assert [truncated for *_, truncated, _ in steps] == [False] * 4 + [True]
  assert not any(terminated for _, _, terminated, _, _ in steps)
  rewards = {f"reward/{name}" for name in ("upright", "centered", "small_control", "small_velocity")}
  assert {name for name in steps[0][-1] if name.startswith("reward/")} == rewards


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


def test_a_batch_can_begin_anew_in_the_step_that_ends() -> None:
  make = lambda **kwargs: gymnasium.make_vec(
    "playground/CartpoleBalance", num_envs=3, overrides=SHORT, physics="c", **kwargs
  )
  later, envs = make(), make(autoreset_mode="SameStep")
  theirs = SyncVectorEnv([lambda: GymEnv("CartpoleBalance", SHORT)] * 3, autoreset_mode=AutoresetMode.SAME_STEP)
  assert (later.metadata["autoreset_mode"], envs.metadata["autoreset_mode"]) == (
    AutoresetMode.NEXT_STEP,
    AutoresetMode.SAME_STEP,
  )
  first, _ = envs.reset(seed=0)
  later.reset(seed=0)
  theirs.reset(seed=0)
  right = np.ones((3, 1), np.float32)
  for i in range(5):
    obs, rewards, terminated, truncated, info = envs.step(right)
    last, *same, metrics = later.step(right)
    expected = theirs.step(right)[-1]
    for a, b in zip((rewards, terminated, truncated), same, strict=True):
      np.testing.assert_array_equal(a, b)
    finals = {name for name in info if "final" in name}
    assert finals == {name for name in expected if "final" in name}
    assert bool(finals) == (i == 4)
  # The last of the episode, as gymnasium's own batch of single environments has it:
  assert info["final_obs"].dtype == expected["final_obs"].dtype == object
  np.testing.assert_array_equal(np.stack(list(info["final_obs"])), last)
  assert info["_final_obs"].all() and info["_final_info"].all()
  assert set(info["final_info"]) == set(expected["final_info"])
  for name, values in metrics.items():
    np.testing.assert_array_equal(info["final_info"][name], values)
    np.testing.assert_array_equal(info["final_info"][f"_{name}"], True)
  # The first of the next, which goes on:
  assert np.abs(obs[:, 3:]).max() < 0.1 < np.abs(last[:, 3:]).max() and not np.allclose(obs, first)
  for i in range(5):
    *_, terminated, truncated, info = envs.step(right)
    assert truncated.all() == (i == 4) and not terminated.any()


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_the_level_of_a_curriculum_outlasts_an_episode(mode: AutoresetMode) -> None:
  envs: Any = GymVectorEnv(2, "PandaRobotiqPushCube", {"episode_length": 4}, "c", autoreset_mode=mode)
  envs.reset(seed=0)
  levels = {"curriculum_id": np.array([2, 1], np.int32)}
  envs._state = envs._state.replace(info=envs._state.info | {PRESERVE_INFO: levels})
  for _ in range(2):  # the first ends the episode: an action is repeated four times
    envs.step(np.zeros((2, 7), np.float32))
  assert envs._state.info[PRESERVE_INFO]["curriculum_id"].tolist() == [2, 1]
  assert envs._state.info["steps"].tolist() == [0, 0]
  envs.reset(seed=0)
  assert envs._state.info[PRESERVE_INFO]["curriculum_id"].tolist() == [0, 0]


@pytest.mark.parametrize(("mode", "level"), [(AutoresetMode.NEXT_STEP, 2), (AutoresetMode.SAME_STEP, 4)])
def test_a_step_that_is_ignored_raises_no_level(mode: AutoresetMode, level: int) -> None:
  always = {
    "success_distance": 100.0,
    "success_angle": None,
    "success_steps": 0,
    "episode_length": 1,
    "action_repeat": 1,
  }
  envs: Any = GymVectorEnv(2, "PandaRobotiqPushCube", always, "c", autoreset_mode=mode)
  envs.reset(seed=0)
  for _ in range(4):
    envs.step(np.zeros((2, 7), np.float32))
  assert envs._state.info[PRESERVE_INFO]["curriculum_id"].tolist() == [level, level]


def test_only_who_ended_has_a_last_observation() -> None:
  envs: Any = GymVectorEnv(3, "CartpoleBalance", SHORT, "c", autoreset_mode=AutoresetMode.SAME_STEP)
  envs.reset(seed=0)
  steps = envs._state.info["steps"].at[1].set(4)
  envs._state = envs._state.replace(info=envs._state.info | {"steps": steps})
  obs, _, _, truncated, info = envs.step(np.ones((3, 1), np.float32))
  assert truncated.tolist() == info["_final_obs"].tolist() == [False, True, False]
  assert [final is None for final in info["final_obs"]] == [True, False, True]
  assert info["final_obs"][1].shape == (5,) and (info["final_obs"][1] != obs[1]).any()
  upright = info["final_info"]["reward/upright"]
  assert upright[1] > 0 and upright[0] == upright[2] == 0


def test_what_a_batch_does_not_do_is_refused() -> None:
  with pytest.raises(ConfigError, match="autoreset_mode: 'Disabled' is unknown; choose from NextStep, SameStep"):
    GymVectorEnv(3, "CartpoleBalance", autoreset_mode="Disabled")
  with pytest.raises(ConfigError, match="render_mode='rgb_array': a batch renders nothing"):
    gymnasium.make_vec("playground/CartpoleBalance", num_envs=3, render_mode="rgb_array")
  for number in (0, 1.5, "2"):
    with pytest.raises(ConfigError, match=rf"^num_envs={number!r} must be a whole number, at least 1\.$"):
      GymVectorEnv(number, "CartpoleBalance")  # pyright: ignore[reportArgumentType]
  with pytest.raises(ConfigError, match="render_mode: 'human' is unknown; choose from rgb_array"):
    GymEnv("CartpoleBalance", render_mode="human")
  with pytest.raises(ConfigError, match=r"max_episode_steps=5: a batch has the task's own limit; overrides="):
    gymnasium.make_vec("playground/CartpoleBalance", num_envs=3, max_episode_steps=5)


def test_a_fork_of_a_process_with_jax_is_refused() -> None:
  """It would hang: gymnasium's AsyncVectorEnv forks by default."""
  code = """
import os
from playground.adapters.gym import GymEnv
from playground.errors import ConfigError
GymEnv("CartpoleBalance").reset(seed=0)
if child := os.fork():
  raise SystemExit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
try:
  GymEnv("CartpoleBalance")
except ConfigError as error:
  os._exit(7 * ("vector_kwargs={'context': 'spawn'}" in str(error)))
"""
  assert subprocess.run([sys.executable, "-c", code], timeout=120, check=False).returncode == 7


def test_a_mask_begins_some_episodes_anew() -> None:
  envs = GymVectorEnv(3, "CartpoleBalance", SHORT, "c")
  envs.reset(seed=0)
  before, *_ = envs.step(np.ones((3, 1), np.float32))
  after, _ = envs.reset(options={"reset_mask": np.array([False, True, False])})
  assert [np.array_equal(a, b) for a, b in zip(after, before, strict=True)] == [True, False, True]


def test_arrays_of_another_shape_are_refused(env: GymEnv) -> None:
  env.reset(seed=0)
  with pytest.raises(ConfigError, match=r"action has the shape \[2\], and must have \[1\]"):
    env.step(np.zeros(2, np.float32))
  envs = GymVectorEnv(2, "BallInCup", SHORT, "c")
  envs.reset(seed=0)
  with pytest.raises(ConfigError, match=r"actions has the shape \[2, 1\], and must have \[2, 2\]"):
    envs.step(np.zeros((2, 1), np.float32))  # which would move both motors of the cup
  with pytest.raises(ConfigError, match=r"reset_mask has the shape \[1\], and must have \[2\]"):
    envs.reset(options={"reset_mask": np.array([True])})


def test_one_entry_of_a_dict_observation() -> None:
  task = Point()
  assert set(observation_space(task)) == {"state", "privileged_state"}  # pyright: ignore[reportArgumentType]
  assert observation_space(task, "state").shape == (2,)
  with pytest.raises(UnknownNameError, match=r"entry: 'stat' is unknown.*Did you mean 'state'"):
    observation_space(task, "stat")


def test_the_only_entry_of_a_flat_observation(env: GymEnv) -> None:
  task = env._episodes.env
  assert observation_space(task) == observation_space(task, "state")
  with pytest.raises(UnknownNameError, match=r"entry: 'privileged_state' is unknown; choose from state"):
    gymnasium.make("playground/CartpoleBalance", entry="privileged_state")


def test_a_wrong_name_is_one_sentence() -> None:
  with pytest.raises(UnknownNameError, match="physics: 'mj' is unknown"):
    gymnasium.make("playground/CartpoleBalance", physics="mj")
