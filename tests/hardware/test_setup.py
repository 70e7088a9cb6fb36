"""From the hardware config to devices, and training on more than one (simulated on the CPU)."""

import dataclasses
import os
import subprocess
import sys
import warnings
from typing import Any
from unittest.mock import Mock

import jax
import pytest
import yaml

from playground.config import compose, config_roots, options
from playground.errors import HardwareError
from playground.hardware.gpus import MEMORY_VARIABLES
from playground.hardware.options import HardwareConfig
from playground.hardware.setup import setup
from tests.processes import ROOT, WITHOUT_WARP

TWO_DEVICES = """
import jax, numpy as np
from playground.learning.evaluation import make_evaluator
from tests.dummy import SMALL, PointTask, point_trainer

assert jax.device_count() == 2
for name in NAMES:
  config = SMALL[name]
  trainer = point_trainer(config, num_devices=2)
  state = trainer.init(jax.random.PRNGKey(0), {}, None, trainer.settings)
  state, metrics = trainer.train(state, {}, np.int32(30))
  alone = point_trainer(config)
  _, its = alone.train(alone.init(jax.random.PRNGKey(0), {}, None, alone.settings), {}, np.int32(30))
  norm = "critic_grad_norm" if "critic_grad_norm" in its else "grad_norm"
  ratio = float(metrics[norm]) / float(its[norm])
  assert 0.7 < ratio < 1.4, f"gradients are averaged, not added: {ratio}"
  for leaf in jax.tree.leaves((state.algorithm)):
    ours, theirs = (np.asarray(shard.data) for shard in leaf.addressable_shards)
    np.testing.assert_array_equal(ours, theirs)
  first, second = (np.asarray(shard.data) for shard in state.env_state.data.qpos.addressable_shards)
  assert first.shape == second.shape == (8, 2)
  assert not np.isin(first, second).any(), "devices must not live the same lives"
  count = state.algorithm.normalizer.count
  assert int(count.hi) == 0 and int(count.lo) == 30 * trainer.steps_per_update
  evaluate = make_evaluator(PointTask(), trainer.act, 16, trainer.mesh, 1)
  scores, recording = evaluate(trainer.policy(state), jax.random.PRNGKey(1), {}, trainer.settings)
  assert float(scores["episode_length"]) == 20 and recording["qpos"].shape == (20, 2, 2)
  assert float(scores["episode_reward"]) > -12 or name != "ppo", scores["episode_reward"]

if name != "ppo":
  first, second = (np.asarray(shard.data) for shard in state.replay.data.addressable_shards)
  assert first.shape == (31, 8, 17) and (first[:30] != 0).any() and not (first[:30, :, :2] == second[:30, :, :2]).any()
"""

AGENTS = """
import dataclasses
import jax, numpy as np
from playground.hardware.mesh import make_mesh
from playground.learning.trainer import Trainer, trainer_settings
from tests.dummy import SMALL_PPO, PointTask

for count, devices in ((2, 1), (3, 2)):  # one agent on each device; all of them on both
  agents = [dataclasses.replace(SMALL_PPO, learning_rate=(i + 1) * 1e-3) for i in range(count)]
  settings = [trainer_settings(agent, {}) for agent in agents]
  trainer = Trainer(PointTask(), SMALL_PPO, make_mesh(2), agents=settings)
  assert trainer.num_devices == devices
  state = trainer.init(np.stack([jax.random.PRNGKey(i) for i in range(count)]), {}, None, trainer.settings)
  state, _ = trainer.train(state, {}, np.int32(10))
  for i, config in enumerate(agents):
    alone = Trainer(PointTask(), config, make_mesh(devices))
    expected, _ = alone.train(alone.init(jax.random.PRNGKey(i), {}, None, alone.settings), {}, np.int32(10))
    params, theirs = jax.device_get((state.algorithm.params, expected.algorithm.params))
    for a, b in zip(jax.tree.leaves(trainer.agent(params, i)), jax.tree.leaves(theirs), strict=True):
      np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3)
  state = trainer.inherit(state, np.zeros(count, int), trainer.settings)
  for leaf in jax.tree.leaves(jax.device_get(state.algorithm)):
    np.testing.assert_array_equal(leaf[-1], leaf[0])
  trainer.train(state, {}, np.int32(1))
"""


def hardware(**changes: Any) -> HardwareConfig:
  return dataclasses.replace(compose(["experiment=quickstart"]).hardware, **changes)


@pytest.mark.parametrize(
  ("changes", "error", "words"),
  [
    ({"devices": 99}, HardwareError, ["hardware.devices=99", "this machine has 1"]),
    ({"kind": "H100"}, HardwareError, ["hardware.kind=H100", "this machine has cpu", "hardware=gpu takes any GPU"]),
  ],
)
def test_what_cannot_be_had_is_one_sentence(changes: dict[str, Any], error: type[Exception], words: list[str]) -> None:
  with pytest.raises(error) as caught:
    setup(hardware(**changes))
  assert all(word in str(caught.value) for word in words)


@pytest.mark.parametrize(
  ("error", "said"),
  [(AssertionError(), ""), (RuntimeError("Unable to initialize: no driver."), " .Unable to .*no driver.")],
)
def test_platforms_that_jax_has_not_are_one_sentence(
  error: Exception, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
  monkeypatch.setenv("JAX_PLATFORMS", "cuda")
  monkeypatch.setattr("jax.local_devices", Mock(side_effect=error))
  with pytest.raises(HardwareError, match=f"JAX finds no device of JAX_PLATFORMS=cuda{said}: .*hardware=cpu"):
    setup(hardware())


def test_flags_that_this_jax_has_no_more_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setenv("XLA_FLAGS", "--xla_exported=1")
  own = "--xla_cpu_use_fusion_emitters=false --xla_given=2 --xla_exported=2"  # an exported one wins
  config = hardware(xla_flags=own, devices=99)
  jax.local_devices()
  with pytest.raises(HardwareError), pytest.warns(UserWarning, match="xla_flags=.* does not act: JAX has started"):
    setup(config)
  assert os.environ["XLA_FLAGS"] == "--xla_exported=1", "processes started from here would read others"
  monkeypatch.setattr("jax._src.xla_bridge.backends_are_initialized", lambda: False)
  for version, flags in (((0, 11, 2), []), ((0, 10, 2), ["--xla_cpu_use_fusion_emitters=false"])):
    monkeypatch.setattr("jax.__version_info__", version)
    with pytest.raises(HardwareError), warnings.catch_warnings(action="error"):
      setup(config)
    assert os.environ["XLA_FLAGS"].split() == ["--xla_exported=1", "--xla_given=2", *flags]


@pytest.mark.parametrize("exported", [None, *MEMORY_VARIABLES])
def test_an_exported_share_of_memory_wins(exported: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
  for name in MEMORY_VARIABLES:
    monkeypatch.setenv(name, "0.5")  # so that it is put back, whatever `setup` sets
    if name != exported:
      monkeypatch.delenv(name)
  with pytest.raises(HardwareError):
    setup(hardware(memory_fraction=0.25, devices=99))
  there = {name: os.environ[name] for name in MEMORY_VARIABLES if name in os.environ}
  assert there == ({exported: "0.5"} if exported else {"XLA_CLIENT_MEM_FRACTION": "0.25"})


@pytest.mark.parametrize("preset", [name for name in options("hardware") if "_x" in name])
def test_presets_are_named_after_their_devices(preset: str) -> None:
  kind, _, count = preset.rpartition("_x")
  file = yaml.safe_load((config_roots()[0] / f"hardware/{preset}.yaml").read_text())  # test_config.py composes it
  assert file["devices"] == int(count)
  assert file.get("kind", "GPU").replace(" ", "").lower() == kind


def test_more_than_there_are_is_one_sentence() -> None:
  command = [sys.executable, "-m", "playground.cli.run", "hardware=gpu_x2", "hardware.platform=auto", "debug=fast"]
  env = os.environ | WITHOUT_WARP | {"JAX_PLATFORMS": "cpu"}
  done = subprocess.run(command, capture_output=True, text=True, env=env, timeout=120)
  assert done.returncode == 2
  assert done.stderr.splitlines()[-1] == (
    "error: hardware.devices=2, but this machine has 1 (cpu): JAX_NUM_CPU_DEVICES=2 divides the CPU."
  )


@pytest.mark.parametrize(
  "code",
  [
    pytest.param('NAMES = ("ppo",)' + TWO_DEVICES, id="parameters are equal, environments apart"),
    pytest.param('NAMES = ("fast_td3", "fast_sac", "sac")' + TWO_DEVICES, id="also off policy", marks=pytest.mark.slow),
    pytest.param(AGENTS, id="agents end as they do alone", marks=pytest.mark.slow),
  ],
)
def test_training_over_two_devices(code: str) -> None:
  simulated = {"JAX_NUM_CPU_DEVICES": "2", "JAX_PLATFORMS": "cpu"}
  done = subprocess.run(
    [sys.executable, "-c", code],
    cwd=ROOT,
    env=os.environ | WITHOUT_WARP | simulated,
    capture_output=True,
    text=True,
    timeout=300,
  )
  assert done.returncode == 0, done.stderr[-2000:]
