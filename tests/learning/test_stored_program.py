"""Functions on disk: they compute the same, and what is damaged or not the user's own is not read."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec as P
from jax.stages import Wrapped

from playground.hardware.mesh import AXIS, jit_on_mesh, make_mesh
from playground.learning import stored_program
from playground.learning.stored_program import LoweredFunction, StoredProgram, UnusableProgramError
from tests.processes import ROOT, WITHOUT_WARP

MESH = make_mesh(1)
ARGUMENTS = ({"x": jnp.arange(4.0), "empty": {}}, jnp.float32(3))


def scaled() -> Wrapped:
  """Takes the first argument's buffers over."""

  def scale(tree: dict[str, jax.Array], factor: jax.Array) -> tuple[dict[str, jax.Array], jax.Array]:
    return tree | {"x": jnp.sin(tree["x"]) * factor}, jax.lax.psum(tree["x"].sum(), AXIS)

  return jit_on_mesh(scale, MESH, (P(AXIS), None), (P(AXIS), P()), donate_argnums=0)


def lowered() -> LoweredFunction:
  function = scaled()
  return LoweredFunction.of(function, function.trace(*ARGUMENTS), *ARGUMENTS)


@pytest.fixture
def stored(tmp_path: Path) -> StoredProgram:
  program = StoredProgram(tmp_path / "programs/one.program")
  assert program.load() is None
  program.save({"scale": lowered()})
  return program


def test_what_is_loaded_computes_the_same_and_takes_buffers_over(stored: StoredProgram):
  loaded = stored.load()
  assert loaded is not None
  copied = lambda: jax.tree.map(jnp.copy, ARGUMENTS)
  given = copied()
  ours, theirs = loaded["scale"].compile(MESH, {})(*given), scaled()(*copied())
  assert jax.tree.structure(ours) == jax.tree.structure(theirs)
  jax.tree.map(np.testing.assert_array_equal, ours, theirs)
  assert given[0]["x"].is_deleted() and not given[1].is_deleted()


def test_it_is_compiled_with_xlas_options():
  with pytest.raises(Exception, match="no_such_option"):
    lowered().compile(MESH, {"no_such_option": "1"})


@pytest.mark.parametrize("damage", [lambda content: content[:-1], lambda content: b"", lambda content: content[::-1]])
def test_a_damaged_file_is_removed_and_said(stored: StoredProgram, damage: Callable[[bytes], bytes]):
  stored.path.write_bytes(damage(stored.path.read_bytes()))
  with pytest.raises(UnusableProgramError, match=r"one\.program was removed: .*\. The program is traced again\.$"):
    stored.load()
  assert stored.load() is None and not stored.path.exists()


@pytest.mark.parametrize("mode", [0o770, 0o707])
def test_a_folder_that_others_write_to_is_not_read_nor_written(stored: StoredProgram, mode: int):
  stored.path.parent.chmod(mode)
  assert stored.load() is None
  stored.path.unlink()
  stored.save({"scale": lowered()})
  assert not stored.path.exists()


def test_the_folder_is_private(stored: StoredProgram):
  assert stored.path.parent.stat().st_mode & 0o777 == 0o700


def test_programs_that_were_not_used_for_longest_go(stored: StoredProgram, monkeypatch: pytest.MonkeyPatch):
  monkeypatch.setattr(stored_program, "KEPT", 2)
  paths = [stored.path, *(stored.path.with_name(f"{name}.program") for name in ("two", "three"))]
  os.utime(stored.path, (0, 0))
  StoredProgram(paths[1]).save({})
  os.utime(paths[1], (1, 1))
  stored.load()
  StoredProgram(paths[2]).save({})
  assert [path.exists() for path in paths] == [True, False, True]


TWO_DEVICES = """
import jax.numpy as jnp, numpy as np
from jax.sharding import PartitionSpec as P
from playground.hardware.mesh import AXIS, jit_on_mesh, make_mesh, put
from playground.learning.stored_program import LoweredFunction

mesh, tree = make_mesh(2), {"x": jnp.arange(4.0), "empty": jnp.zeros((4, 0))}
function = jit_on_mesh(lambda tree: tree | {"x": 2 * tree["x"]}, mesh, (P(AXIS),), P(AXIS), donate_argnums=0)
stored = LoweredFunction.of(function, function.trace(tree), tree).compile(mesh, {})
result = stored(stored(put(tree, mesh, P(AXIS))))
np.testing.assert_array_equal(result["x"], 4 * np.arange(4.0))
assert result["empty"].shape == (4, 0) and result["empty"].sharding.spec == P(AXIS)
"""


def test_a_program_that_another_process_removes_meanwhile_is_no_error(stored: StoredProgram):
  stored.path.with_name("gone.program").symlink_to("nowhere")  # it is listed, and is not there
  stored.save({"scale": lowered()})


def test_over_several_devices_empty_arrays_stay_divided():
  env = os.environ | WITHOUT_WARP | {"JAX_NUM_CPU_DEVICES": "2", "JAX_PLATFORMS": "cpu"}
  done = subprocess.run([sys.executable, "-c", TWO_DEVICES], cwd=ROOT, env=env, capture_output=True, text=True)
  assert done.returncode == 0, done.stderr[-2000:]
