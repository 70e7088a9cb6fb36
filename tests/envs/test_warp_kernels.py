"""Kernels compiled ahead: all that a step needs are there, once, and a failure is told and harms nothing."""

import os
import subprocess
import sys

import mujoco
import pytest

from playground import registry
from playground.config import compose
from playground.envs import warp_kernels
from playground.envs.physics import Physics
from playground.runs.train import train
from tests.runs.helpers import TASK

ROUGH = "Go1JoystickRoughTerrain"  # a height field, contacts, sensors

# Prints which modules are in Warp's cache after compiling ahead, and which a step has added to them.
SCRIPT = """
import os, sys
import jax
from playground import registry
from playground.envs.warp_kernels import Building
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


def test_kernels_are_compiled_once(model):
  building = warp_kernels.Building(model, 6)
  building.stop()
  building._marker.unlink(missing_ok=True)  # of an earlier session of tests
  for compiled_before in (False, True):
    building = warp_kernels.Building(model, 6)
    assert (building._process is None) == compiled_before
    assert building.wait() is None


def test_what_went_wrong_is_said(model, monkeypatch, tmp_path):
  monkeypatch.setattr(warp_kernels.sys, "executable", "false")
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
    monkeypatch.setattr(warp_kernels.sys, "executable", "false")
    made.append(warp_kernels.Building(physics.mj_model, 9))
    return made[0]

  monkeypatch.setattr(Physics, "compile_ahead", compile_ahead)
  assert train(compose([*TASK, "video.enable=false", f"run_dir={tmp_path}/run"])) == 0
  assert "were not compiled ahead" in capsys.readouterr().out
  assert not os.path.exists(made[0]._folder.name)


def test_the_cpu_and_mjx_alone_compile_nothing_ahead():
  for impl in ("jax", "warp"):
    assert registry.load("CartpoleBalance", overrides={"impl": impl}).physics.compile_ahead() is None
