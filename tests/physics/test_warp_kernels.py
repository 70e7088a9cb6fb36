"""Kernels compiled ahead: all that a step needs are there, once, and a failure is told and harms nothing."""

import os
import subprocess
import sys
import types

import mujoco
import pytest

from playground import registry
from playground.config import compose
from playground.envs.options import impl_on_gpu
from playground.physics import warp_kernels
from playground.physics.backend import Physics
from playground.runs.train import train
from tests.runs.helpers import TASK

ROUGH = "Go1JoystickRoughTerrain"  # a height field, contacts, sensors

# Prints which modules are in Warp's cache after compiling ahead, and which a step has added to them.
SCRIPT = """
import os, sys
import jax
from playground import registry
from playground.physics.warp_kernels import Building
env = registry.load(sys.argv[1], overrides={"impl": "warp"})
building = Building(env.mj_model, env.physics._njmax)
assert building.wait() is None
import warp
modules = lambda: {name for name in os.listdir(warp.config.kernel_cache_dir) if name.startswith("wp_")}
before = modules()
again = Building(env.mj_model, env.physics._njmax)
assert again._process is None and again.wait() is None
state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 2))
state = jax.jit(jax.vmap(env.step))(state, jax.numpy.zeros((2, env.action_size)))
jax.block_until_ready(state.obs)
print(len(before), sorted(modules() - before))
"""


@pytest.mark.slow  # a minute: a cache of its own, all kernels
def test_a_step_needs_no_kernel_that_was_not_compiled_ahead(tmp_path):
  env = os.environ | {"WARP_CACHE_PATH": str(tmp_path)}
  done = subprocess.run([sys.executable, "-c", SCRIPT, ROUGH], capture_output=True, text=True, env=env)
  assert done.returncode == 0, done.stderr
  count, missed = done.stdout.splitlines()[-1].split(" ", 1)
  assert int(count) > 20
  assert missed == "[]"


@pytest.fixture
def model():
  body = "<body><freejoint/><geom size='1'/></body>"
  return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</worldbody></mujoco>")


def test_what_went_wrong_is_said(model, monkeypatch, tmp_path):
  monkeypatch.setattr(warp_kernels, "PYTHON", ("false",))
  building = warp_kernels.Building(model, 7)
  assert building.wait() == "Warp's kernels were not compiled ahead, they are at their first launch: exit code 1"
  assert not building._marker.exists()


def test_a_stopped_building_leaves_nothing(model):
  building = warp_kernels.Building(model, 8)
  building.stop()
  assert building._process is not None
  assert building._process.poll() is not None
  assert not os.path.exists(building._folder.name)


def test_a_run_waits_and_says_it(model, monkeypatch, tmp_path, capsys):
  """As on a GPU, with a process that fails at once."""
  made = []

  def compile_ahead(physics: Physics) -> warp_kernels.Building:
    monkeypatch.setattr(warp_kernels, "PYTHON", ("false",))
    made.append(warp_kernels.Building(physics.mj_model, 9))
    return made[0]

  monkeypatch.setattr(Physics, "compile_ahead", compile_ahead)
  assert train(compose([*TASK, "video.enable=false", f"run_dir={tmp_path}/run"])) == 0
  assert "were not compiled ahead" in capsys.readouterr().out
  assert not os.path.exists(made[0]._folder.name)


@pytest.fixture
def gpu(monkeypatch, tmp_path):
  """A machine whose driver has a GPU, for `stand_by`; what stands by is gone after the test."""
  (tmp_path / "nvidia-smi").write_text("#!/bin/sh\n")
  (tmp_path / "nvidia-smi").chmod(0o755)
  monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
  monkeypatch.delenv("JAX_PLATFORMS", raising=False)
  yield
  warp_kernels.dismiss()


def env_config(**changes):
  return {"impl": "auto", "cuda_impl": "warp", "vision": {"enable": False}} | changes


def test_a_building_takes_the_process_that_stands_by(gpu, model):
  warp_kernels.stand_by(impl_on_gpu(env_config()), "auto")
  warp_kernels.stand_by(impl_on_gpu(env_config()), "auto")  # once is enough
  (process,) = warp_kernels._standing_by
  stopped = warp_kernels.Building(model, 10)
  stopped.stop()
  assert stopped._process is process
  assert warp_kernels._standing_by == []


@pytest.mark.slow  # all kernels
def test_kernels_are_compiled_once(gpu, model, monkeypatch, tmp_path):
  import warp

  warp.init()
  cache = tmp_path / warp.config.version
  monkeypatch.setattr(warp.config, "kernel_cache_dir", str(cache))
  warp_kernels.stand_by(impl_on_gpu(env_config()), "auto")
  building = warp_kernels.Building(model, 11)
  assert building.wait() is None
  assert building._marker.exists()
  assert len(list(cache.glob("wp_*"))) > 10
  warp_kernels.stand_by(impl_on_gpu(env_config()), "auto")
  (process,) = warp_kernels._standing_by
  again = warp_kernels.Building(model, 11)
  assert again._process is None
  assert again.wait() is None
  assert process.poll() is not None  # nothing was left to do


@pytest.mark.parametrize(
  ("changes", "stands_by"),
  [
    ({"cuda_impl": "jax"}, False),
    ({"impl": "jax"}, False),
    ({"impl": "warp", "cuda_impl": "jax"}, True),
    ({"cuda_impl": "jax", "vision": {"enable": True}}, True),
  ],
)
def test_only_what_runs_on_warp_has_a_process_stand_by(gpu, changes, stands_by):
  warp_kernels.stand_by(impl_on_gpu(env_config(**changes)), "auto")
  assert bool(warp_kernels._standing_by) == stands_by


@pytest.mark.parametrize("without", ["platform", "JAX_PLATFORMS", "PATH"])
def test_nothing_stands_by_without_a_gpu(gpu, monkeypatch, tmp_path, without):
  if without == "PATH":
    (tmp_path / "nvidia-smi").unlink()
  elif without == "JAX_PLATFORMS":
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
  warp_kernels.stand_by(impl_on_gpu(env_config()), "cpu" if without == "platform" else "auto")
  assert warp_kernels._standing_by == []


def test_it_ends_with_the_process_that_started_it(gpu):
  warp_kernels.stand_by(impl_on_gpu(env_config()), "auto")
  (process,) = warp_kernels._standing_by
  assert process.stdin is not None
  process.stdin.close()  # as when that one ends
  assert process.wait(60) == 0


def test_the_longest_module_is_compiled_first(model, monkeypatch):
  import warp

  module = lambda name: types.SimpleNamespace(name=name)
  ccd = "ccd_kernel_builder__locals__ccd_kernel_460f0a45"
  launched = [(module("smooth"), None), (module(ccd), 64), (module("solver"), 32)]
  compiled = []
  monkeypatch.setattr(warp_kernels, "_launched", lambda *_: launched)
  monkeypatch.setattr(warp, "force_load", lambda _, modules, block_dim: compiled.append((modules[0].name, block_dim)))
  warp_kernels.compile_all(model, None, 1)
  assert compiled == [(ccd, 64), ("smooth", None), ("solver", 32)]


def test_the_cpu_and_mjx_alone_compile_nothing_ahead(gpu):
  for impl in ("jax", "warp"):
    warp_kernels.stand_by(impl_on_gpu(env_config()), "auto")
    assert registry.load("CartpoleBalance", overrides={"impl": impl}).physics.compile_ahead() is None
    assert warp_kernels._standing_by == []
