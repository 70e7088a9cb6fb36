"""RSL-RL's networks in JAX: what torch computes, drawn as torch draws them; errors that come before anything else."""

# torch is in an extra, which the type checker may not find
# pyright: reportMissingImports=false

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pandas as pd
import pytest

from playground.cli.main import main as playground
from playground.cli.run import main
from playground.deploy.graph import policy_graph
from playground.errors import ConfigError
from playground.learning.rsl_rl import GaussianActorCritic, RslRlNetworkConfig
from playground.runs.run_dir import RunDirectory
from tests.command import caller
from tests.deploy.test_graph import exported
from tests.dummy import SMALL_RSL_RL, needs_rsl_rl, point_learner

TASK = ["env=CartpoleBalance", "agent=rsl_rl_ppo", "debug=fast", "hardware=cpu", "tracking=csv"]


@needs_rsl_rl
def test_jax_torch_and_onnx_act_alike() -> None:
  import torch
  from tensordict import TensorDict

  from playground.adapters.rsl_rl import to_torch

  learner: Any = point_learner(SMALL_RSL_RL)
  state, _ = learner.train(learner.init(jax.random.PRNGKey(0), {}), {}, 3)
  policy = learner.policy(state)
  obs = jax.random.normal(jax.random.PRNGKey(1), (50, 2))
  ours = learner.act(policy, {"state": obs, "privileged_state": None}, jax.random.PRNGKey(2), deterministic=True)
  with torch.inference_mode():
    actor = learner._torch._models["policy"]
    theirs = actor(TensorDict({"policy": to_torch(obs)}, [50])).clamp(-1, 1)
  assert 0 < np.abs(theirs.numpy()).max() <= 1
  np.testing.assert_allclose(ours, theirs, atol=1e-6)
  networks = learner.networks
  params, seen = networks.mlp(policy.params.policy, policy.normalizer)
  graph = policy_graph(params, networks.policy_inputs, SMALL_RSL_RL.network.activation, seen, networks.squashed)
  np.testing.assert_allclose(ours, exported(graph, networks.policy_inputs).actions(np.asarray(obs)), atol=1e-6)


@needs_rsl_rl
def test_cartpole_from_the_command_to_the_exported_policy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
  run = RunDirectory(tmp_path / "run")
  assert caller(monkeypatch, "playground-run", main)(*TASK, "agent.num_timesteps=1600", f"run_dir={run.path}") == 0
  assert run.status["status"] == "finished"
  assert {"final_return", "best_return", "steps_per_second", "wall_clock_s", "params_sha256"} < set(run.summary)
  assert run.summary["steps"] == 1600
  assert run.manifest["versions"]["rsl-rl-lib"].startswith("5.")
  table = pd.read_csv(run.metrics_csv)
  assert len(table) == 21 and np.isfinite(table["eval/episode_reward"].to_numpy()[[0, -1]]).all()
  assert np.isfinite(table[["training/value_loss", "time/steps_per_second"]].to_numpy()[1:]).all()
  assert sorted(run.plots.iterdir())
  assert caller(monkeypatch, "playground", playground)("export", str(run.path)) == 0
  assert (run.path / "export" / "policy.onnx").is_file()


@needs_rsl_rl
def test_parameters_are_drawn_as_torch_draws_them() -> None:
  import torch

  ours = GaussianActorCritic(64, 3, RslRlNetworkConfig((256,), (8,))).init(jax.random.PRNGKey(0)).policy
  theirs = torch.nn.Linear(64, 256)
  for name, tensor in (("weight", theirs.weight), ("bias", theirs.bias)):
    array, tensor = ours[f"mlp.0.{name}"], tensor.detach().numpy()
    assert array.shape == tensor.shape
    np.testing.assert_allclose([array.min(), array.max()], [tensor.min(), tensor.max()], rtol=0.05)
    np.testing.assert_allclose(array.std(), tensor.std(), rtol=0.1)
  assert ours["distribution.std_param"].tolist() == [1.0, 1.0, 1.0]


def test_a_sampled_action_is_within_bounds_and_noisy() -> None:
  networks = GaussianActorCritic({"state": (4,)}, 3, RslRlNetworkConfig((8,), (8,)))
  policy, normalizer = networks.init(jax.random.PRNGKey(0)).policy, networks.init_normalizer()
  obs = {"state": jax.numpy.zeros((100, 4))}
  actions = np.asarray(networks.act(policy, normalizer, obs, jax.random.PRNGKey(1)))
  assert np.abs(actions).max() == 1.0, "a deviation of 1 is clipped"
  assert actions.std() > 0.5
  again = np.asarray(networks.act(policy, normalizer, obs, jax.random.PRNGKey(1), deterministic=True))
  assert (again == again[0]).all()


def test_the_critic_sees_what_is_for_it() -> None:
  both = {"state": (4,), "privileged_state": (7,)}
  network = RslRlNetworkConfig((8,), (8,))
  assert GaussianActorCritic(both, 1, network).inputs == {"policy": 4, "value": 7}
  assert GaussianActorCritic({"state": (4,)}, 1, network).inputs == {"policy": 4, "value": 4}
  assert GaussianActorCritic(both, 1, RslRlNetworkConfig((8,), (8,), value_obs_key="state")).inputs["value"] == 4


@pytest.mark.parametrize(
  ("size", "network", "sentence"),
  [
    (4, {"activation": "gelu"}, r"activation='gelu' must be one of elu, relu, swish, tanh"),
    (4, {"policy_obs_key": "stat"}, r"policy_obs_key='stat' must be an entry .* Did you mean 'state'"),
    ({"state": (4,), "pixels/view": (8, 8, 3)}, {}, r"agent=rsl_rl_ppo reads no pictures: choose agent=ppo"),
  ],
)
def test_networks_that_cannot_be(size: Any, network: dict[str, Any], sentence: str) -> None:
  with pytest.raises(ConfigError, match=sentence):
    GaussianActorCritic(size, 1, RslRlNetworkConfig(**network))


@needs_rsl_rl
def test_torch_without_the_gpu_that_jax_has_is_one_sentence() -> None:
  learner: Any = point_learner(SMALL_RSL_RL)
  assert learner.notices()[0].endswith("on the CPU.")
  learner.mesh = SimpleNamespace(devices=np.array([SimpleNamespace(platform="gpu")]))
  with pytest.raises(ConfigError, match=r"JAX trains on a GPU that torch .* cannot use: install torch's CUDA build"):
    learner.notices()


def test_without_the_extra_it_is_one_sentence(
  monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
  find = importlib.util.find_spec
  monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name in ("torch", "rsl_rl") else find(name))
  assert caller(monkeypatch, "playground-run", main)(*TASK, f"run_dir={tmp_path / 'run'}") == 2
  sentence = "error: This needs torch, rsl_rl: pip install 'playground-run[rsl-rl]'."
  assert re.search(re.escape(sentence), capsys.readouterr().err)
  assert not (tmp_path / "run").exists()


def test_nothing_else_imports_torch() -> None:
  code = "import sys, playground.runs.train, playground.cli.main; assert not {'torch', 'rsl_rl'} & set(sys.modules)"
  subprocess.run([sys.executable, "-c", code], check=True)
