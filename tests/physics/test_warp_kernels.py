"""Kernels compiled ahead: all that a step needs, once; a failure is reported and harms nothing."""

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
from playground.physics.warp_kernels import KernelBuild
env = registry.load(sys.argv[1], overrides={"impl": "warp"})
build = KernelBuild(env.mj_model, env.config.njmax)
assert build.wait() is None
import warp
modules = lambda: {name for name in os.listdir(warp.config.kernel_cache_dir) if name.startswith("wp_")}
before = modules()
again = KernelBuild(env.mj_model, env.config.njmax)
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


def test_a_failure_is_reported(model, monkeypatch, tmp_path):
  monkeypatch.setattr(warp_kernels, "PYTHON", ("false",))
  build = warp_kernels.KernelBuild(model, 7)
  assert build.wait() == "Warp's kernels were not compiled ahead; Warp compiles them at their first launch: exit code 1"
  assert not build._marker.exists()


def test_a_stopped_build_leaves_nothing(model):
  build = warp_kernels.KernelBuild(model, 8)
  build.stop()
  assert build._process is not None
  assert build._process.poll() is not None
  assert not os.path.exists(build._folder.name)


def test_a_run_waits_and_says_it(model, monkeypatch, tmp_path, capsys):
  """As on a GPU, with a process that fails at once."""
  made = []

  def compile_ahead(physics: Physics) -> warp_kernels.KernelBuild:
    monkeypatch.setattr(warp_kernels, "PYTHON", ("false",))
    made.append(warp_kernels.KernelBuild(physics.mj_model, 9))
    return made[0]

  monkeypatch.setattr(Physics, "compile_ahead", compile_ahead)
  assert train(compose([*TASK, "video.enable=false", f"run_dir={tmp_path}/run"])) == 0
  assert "were not compiled ahead" in capsys.readouterr().out
  assert not os.path.exists(made[0]._folder.name)


@pytest.fixture
def gpu(monkeypatch, tmp_path):
  """A machine whose driver has a GPU, for `prestart`; the process ends with the test."""
  (tmp_path / "nvidia-smi").write_text("#!/bin/sh\n")
  (tmp_path / "nvidia-smi").chmod(0o755)
  monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
  monkeypatch.delenv("JAX_PLATFORMS", raising=False)
  yield
  warp_kernels.cancel_prestart()


def env_config(**changes):
  return {"impl": "auto", "cuda_impl": "warp", "vision": {"enable": False}} | changes


def test_a_build_takes_the_prestarted_process(gpu, model):
  warp_kernels.prestart(impl_on_gpu(env_config()), "auto")
  warp_kernels.prestart(impl_on_gpu(env_config()), "auto")  # once is enough
  (process,) = warp_kernels._prestarted
  stopped = warp_kernels.KernelBuild(model, 10)
  stopped.stop()
  assert stopped._process is process
  assert warp_kernels._prestarted == []


@pytest.mark.slow  # all kernels
def test_kernels_are_compiled_once(gpu, model, monkeypatch, tmp_path):
  import warp

  warp.init()
  cache = tmp_path / warp.config.version
  monkeypatch.setattr(warp.config, "kernel_cache_dir", str(cache))
  warp_kernels.prestart(impl_on_gpu(env_config()), "auto")
  build = warp_kernels.KernelBuild(model, 11)
  assert build.wait() is None
  assert build._marker.exists()
  assert len(list(cache.glob("wp_*"))) > 10
  warp_kernels.prestart(impl_on_gpu(env_config()), "auto")
  (process,) = warp_kernels._prestarted
  again = warp_kernels.KernelBuild(model, 11)
  assert again._process is None
  assert again.wait() is None
  assert process.poll() is not None  # nothing was left to do


@pytest.mark.parametrize(
  ("changes", "prestarts"),
  [
    ({"cuda_impl": "jax"}, False),
    ({"impl": "jax"}, False),
    ({"impl": "warp", "cuda_impl": "jax"}, True),
    ({"cuda_impl": "jax", "vision": {"enable": True}}, True),
  ],
)
def test_only_tasks_on_warp_prestart(gpu, changes, prestarts):
  warp_kernels.prestart(impl_on_gpu(env_config(**changes)), "auto")
  assert bool(warp_kernels._prestarted) == prestarts


@pytest.mark.parametrize("without", ["platform", "JAX_PLATFORMS", "PATH"])
def test_nothing_is_prestarted_without_a_gpu(gpu, monkeypatch, tmp_path, without):
  if without == "PATH":
    (tmp_path / "nvidia-smi").unlink()
  elif without == "JAX_PLATFORMS":
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
  warp_kernels.prestart(impl_on_gpu(env_config()), "cpu" if without == "platform" else "auto")
  assert warp_kernels._prestarted == []


def test_it_ends_with_the_process_that_started_it(gpu):
  warp_kernels.prestart(impl_on_gpu(env_config()), "auto")
  (process,) = warp_kernels._prestarted
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
    warp_kernels.prestart(impl_on_gpu(env_config()), "auto")
    assert registry.load("CartpoleBalance", overrides={"impl": impl}).physics.compile_ahead() is None
    assert warp_kernels._prestarted == []
