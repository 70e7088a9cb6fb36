"""The bridge to RSL-RL: nothing is copied, time-outs are no terminations, and RSL-RL's own runner trains on it."""

# pyright: reportPossiblyUnboundVariable=false
# Loops of a constant length run at least once.

# torch is in an extra, which the type checker may not find
# pyright: reportMissingImports=false

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from playground.envs.base import State
from playground.envs.c_physics import on_c_physics
from playground.errors import ConfigError, UnknownNameError
from playground.registry import load
from tests.dummy import Point

torch = pytest.importorskip("torch", reason="needs the extra rsl-rl: `make test-rsl-rl`")
runners = pytest.importorskip("rsl_rl.runners", reason="needs the extra rsl-rl: `make test-rsl-rl`")

from playground.adapters.rsl_rl import OBS_GROUPS, VecEnv, group_entries, to_jax, to_torch, vec_env  # noqa: E402

NUM_ENVS, LENGTH = 4, 40
MODEL = {"class_name": "MLPModel", "hidden_dims": [8], "activation": "elu", "obs_normalization": True}
RUNNER: dict[str, Any] = {
  "num_steps_per_env": 5,
  "save_interval": 10,
  "actor": MODEL | {"distribution_cfg": {"class_name": "GaussianDistribution"}},
  "critic": MODEL,
  "algorithm": {"class_name": "PPO", "num_mini_batches": 2},
}


@pytest.fixture(scope="module")
def made() -> tuple[VecEnv, State]:
  env = vec_env(Point(episode_length=LENGTH), NUM_ENVS)
  return env, env.state


@pytest.fixture
def env(made: tuple[VecEnv, State]) -> VecEnv:
  """Environments at the beginning of their first episodes."""
  env, env.state = made
  return env


def test_nothing_is_copied_either_way(env: VecEnv) -> None:
  array, tensor = jnp.arange(6.0).reshape(2, 3), torch.rand(2, 3)
  assert to_torch(array).data_ptr() == array.unsafe_buffer_pointer()
  assert to_jax(tensor).unsafe_buffer_pointer() == tensor.data_ptr()
  obs, rewards, dones, extras = env.step(torch.zeros(NUM_ENVS, 2))
  state: Any = env.state
  for seen, array in (
    (obs["policy"], state.obs["state"]),
    (obs["critic"], state.obs["privileged_state"]),
    (rewards, state.reward),
    (dones, state.done),
    (extras["time_outs"], state.info["truncation"]),
    (extras["final_obs"]["critic"], state.info["final_obs"]["privileged_state"]),
  ):
    assert seen.data_ptr() == array.unsafe_buffer_pointer()


def test_time_outs_are_no_terminations(env: VecEnv) -> None:
  """Two points stay where they are until time is up, two leave the field before."""
  actions = torch.tensor([[0.0, 0.0], [0.0, 0.0], [5.0, 5.0], [5.0, 5.0]])  # clipped to 1
  ends, logs = torch.zeros(0, NUM_ENVS), []
  timed_out = ends.clone()
  for _ in range(LENGTH):
    _, _, dones, extras = env.step(actions)
    ends, timed_out = torch.vstack([ends, dones]), torch.vstack([timed_out, extras["time_outs"]])
    logs.append(extras.get("log"))
  assert ends.sum(0).tolist()[:2] == timed_out.sum(0).tolist()[:2] == [1, 1]
  assert ends[-1, :2].all()
  assert (ends.sum(0)[2:] > 0).all() and not timed_out[:, 2:].any()
  assert [log is not None for log in logs] == ends.any(1).tolist()
  first = int(ends.any(1).int().argmax())
  assert set(logs[first]) == {"Episode/reward", "Episode/length", "Episode/distance", "Episode/nonfinite"}
  assert logs[first]["Episode/nonfinite"] == 0
  assert logs[first]["Episode/length"] == first + 1 < LENGTH


def test_the_last_observation_of_an_episode_is_there(env: VecEnv) -> None:
  first, actions = env.get_observations()["policy"], torch.tensor([[0.5, -1.0]]).repeat(NUM_ENVS, 1)
  env.episode_length_buf = torch.tensor([LENGTH - 1, 0, LENGTH - 1, 0])
  obs, _, dones, extras = env.step(actions)
  moved = first + 0.1 * actions
  torch.testing.assert_close(extras["final_obs"]["policy"], moved)
  torch.testing.assert_close(extras["final_obs"]["critic"], torch.hstack([moved, actions]))
  torch.testing.assert_close(obs["policy"], torch.where(dones[:, None] > 0, first, moved))


def test_episodes_can_begin_at_any_length(env: VecEnv) -> None:
  env.episode_length_buf = torch.tensor([LENGTH - 1, 0, 1, 2])
  _, _, dones, extras = env.step(torch.zeros(NUM_ENVS, 2))
  assert dones.tolist() == extras["time_outs"].tolist() == [1, 0, 0, 0]
  assert env.episode_length_buf.tolist() == [0, 1, 2, 3]


def test_rsl_rls_own_runner_trains(env: VecEnv, capsys: pytest.CaptureFixture[str]) -> None:
  runner = runners.OnPolicyRunner(env, {**RUNNER, "obs_groups": dict(OBS_GROUPS)})
  assert [model.obs_dim for model in (runner.alg.actor, runner.alg.critic)] == [2, 4]
  before = [p.clone() for p in runner.alg.actor.parameters()]
  runner.learn(2, init_at_random_ep_len=True)
  assert all((a != b).any() for a, b in zip(before, runner.alg.actor.parameters(), strict=True))


def test_the_script_of_the_page_trains(tmp_path: Path) -> None:
  page = (Path(__file__).parents[2] / "docs/rsl-rl.md").read_text(encoding="utf-8")
  (script,) = re.findall(r"^```python\n(.*?)^```$", page, re.S | re.M)
  small = '"CartpoleBalance", 4, 2'
  assert script.count('"Go1JoystickFlatTerrain", 4096, 1000') == 1
  (tmp_path / "train_rsl_rl.py").write_text(script.replace('"Go1JoystickFlatTerrain", 4096, 1000', small))
  done = subprocess.run([sys.executable, "train_rsl_rl.py"], cwd=tmp_path, capture_output=True, text=True)
  assert done.returncode == 0, done.stdout + done.stderr
  assert list((tmp_path / "logs").glob("*.pt"))


def test_groups_of_go1() -> None:
  env = vec_env(on_c_physics(load("Go1JoystickFlatTerrain")), 2)
  obs = env.get_observations()
  assert {name: tuple(group.shape) for name, group in obs.items()} == {"policy": (2, 48), "critic": (2, 123)}
  assert env.cfg.to_dict()["robot"]["name"] == "go1", "RSL-RL's logger of W&B calls it"
  assert env.unwrapped.step_dt == pytest.approx(0.02), "RSL-RL's curiosity reads it"


def test_shapes_and_numbers_are_checked(env: VecEnv) -> None:
  with pytest.raises(ConfigError, match=rf"^actions has the shape \[{NUM_ENVS}, 3\], and must have \[{NUM_ENVS}, 2\]"):
    env.step(torch.zeros(NUM_ENVS, 3))
  with pytest.raises(ConfigError, match=r"^episode_length_buf has the shape .*, and must have"):
    env.episode_length_buf = torch.zeros(NUM_ENVS, 1)
  with pytest.raises(ConfigError, match=r"^num_envs=0 must be at least 1"):
    vec_env(Point(episode_length=LENGTH), 0)


def test_the_log_has_the_share_of_non_finite_ends(env: VecEnv) -> None:
  """Beside one that time ends."""
  env.episode_length_buf = torch.tensor([0, 0, LENGTH - 1, 0])
  *_, extras = env.step(torch.tensor([[0.0, 0.0], [torch.nan, 0.0], [0.0, 0.0], [0.0, 0.0]]))
  assert extras["log"]["Episode/nonfinite"] == 0.5


@pytest.mark.parametrize("groups", [OBS_GROUPS, ["state"], "state", {}])
def test_groups_are_names_by_name(groups: Any) -> None:
  with pytest.raises(ConfigError, match=r"^groups=.* must name a group of the task .*'policy': 'state'"):
    vec_env(Point(episode_length=LENGTH), NUM_ENVS, groups=groups)


def test_a_group_that_the_task_lacks_is_named() -> None:
  with pytest.raises(UnknownNameError, match=r"groups\['policy'\]: 'stat' is unknown; .* Did you mean 'state'"):
    vec_env(Point(episode_length=LENGTH), NUM_ENVS, groups={"policy": "stat"})


@pytest.mark.slow  # compiles a task's physics
def test_each_environment_has_a_model_of_its_own() -> None:
  params = {"field": "dof_damping", "target": "all", "operation": "set", "range": [0.0, 5.0]}
  events = {"damping": {"mode": "startup", "func": "model_field", "params": params}}
  env = vec_env(load("CartpoleBalance"), 2, events=events)
  assert env.groups == {"policy": "state", "critic": "state"}, "a task without privileged observations"
  env.state = jax.tree.map(lambda x: jnp.stack([x[0], x[0]]), env.state)
  for _ in range(3):
    obs, *_ = env.step(torch.ones(2, 1))
  assert (obs["policy"][0] != obs["policy"][1]).any()


def test_images_are_refused() -> None:
  class Camera(Point):
    @property
    def observation_size(self) -> dict[str, tuple[int, ...]]:
      return {"state": (2,), "pixels/view": (8, 8, 3)}

  for groups in (None, {"policy": "pixels/view"}):
    with pytest.raises(ConfigError, match="RSL-RL gets no images from here"):
      group_entries(Camera(), groups)
  assert group_entries(Camera(), {"policy": "state"}) == {"policy": "state"}
