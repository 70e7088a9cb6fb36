"""What crosses into a mesh of several devices."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from jax.sharding import Mesh

from playground.hardware.mesh import compiler_options, device_memory

EMPTY = """
import json
import jax, jax.numpy as jnp
from jax.sharding import PartitionSpec as P
from playground.hardware.mesh import AXIS, jit_on_mesh, make_mesh

def local(state, shift):
  seen.append({name: x.shape for name, x in state.items()})
  moved = {"pos": state["pos"] + shift["by"], "mocap": state["mocap"] * 2.0, "none": state["none"][:, :, :1]}
  return moved, {"sum": jax.lax.psum(state["pos"].sum(), AXIS), "empty": shift["empty"]}

seen = []
state = {"pos": jnp.arange(8.0).reshape(4, 2), "mocap": jnp.ones((4, 0, 3)), "none": jnp.ones((4, 0, 2), jnp.int32)}
function = jit_on_mesh(local, make_mesh(2), (P(AXIS), P()), (P(AXIS), P()), donate_argnums=0)
state, rest = function(state, {"by": jnp.ones(()), "empty": jnp.zeros((0,), bool)})
shapes = {name: [*x.shape, str(x.dtype)] for name, x in {**state, **rest}.items()}
print(json.dumps([seen, shapes, state["pos"].tolist(), float(rest["sum"])]))
"""


def test_arrays_of_no_elements_cross():
  """They take their shapes, a device's share inside, though they are filled on the way (a crash of JAX 0.11.2)."""
  env = os.environ | {"JAX_NUM_CPU_DEVICES": "2", "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(Path(__file__).parents[2])}
  done = subprocess.run([sys.executable, "-c", EMPTY], env=env, capture_output=True, text=True)
  assert done.returncode == 0, done.stderr[-2000:]
  seen, shapes, pos, total = json.loads(done.stdout.splitlines()[-1])
  assert seen == [{"pos": [2, 2], "mocap": [2, 0, 3], "none": [2, 0, 2]}]
  assert shapes == {
    "pos": [4, 2, "float32"], "mocap": [4, 0, 3, "float32"], "none": [4, 0, 1, "int32"],
    "sum": ["float32"], "empty": [0, "bool"],
  }  # fmt: skip
  assert pos == [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0], [7.0, 8.0]] and total == 28.0


CONCURRENT = {"xla_gpu_command_buffer_scheduling_mode": "CONCURRENT"}


@pytest.mark.parametrize(
  ("platform", "devices", "impl", "flags", "options"),
  [
    ("gpu", 1, "jax", "", CONCURRENT),
    ("gpu", 1, "jax", "--xla_gpu_deterministic_ops=true", CONCURRENT),
    ("gpu", 1, "jax", "--xla_gpu_command_buffer_scheduling_mode=SERIALIZE", {}),
    ("gpu", 1, "warp", "", {}),
    ("gpu", 2, "jax", "", {}),
    ("cpu", 1, "jax", "", {}),
  ],
)
def test_kernels_run_at_the_same_time_where_that_is_faster(
  monkeypatch: pytest.MonkeyPatch, platform: str, devices: int, impl: str, flags: str, options: dict[str, str]
):
  monkeypatch.setenv("XLA_FLAGS", flags)
  mesh = SimpleNamespace(size=devices, devices=np.array([SimpleNamespace(platform=platform)] * devices))
  assert compiler_options(cast(Mesh, mesh), impl) == options


@pytest.mark.parametrize(
  ("limits", "known"),
  [
    ([{"bytes_limit": 80}, {"bytes_limit": 40}], 40),
    ([{"bytes_limit": 80}, {"bytes_limit": 0}], None),  # as with XLA_PYTHON_CLIENT_ALLOCATOR=cuda_async
    ([{"bytes_limit": 80}, {}], None),
    ([None], None),
  ],
)
def test_memory_is_that_of_the_smallest_gpu_if_all_say(limits: list[dict[str, int] | None], known: int | None):
  gpus = [SimpleNamespace(platform="gpu", memory_stats=lambda stats=stats: stats) for stats in limits]
  assert device_memory(cast(Mesh, SimpleNamespace(devices=np.array(gpus)))) == known
