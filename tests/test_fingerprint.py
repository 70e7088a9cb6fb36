"""Fingerprints: what changes a program changes them, in every process the same."""

import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import playground
from playground import fingerprint
from playground.fingerprint import NoFingerprintError, of_code, of_machine, of_values
from playground.hardware.mesh import make_mesh

MODEL = "<mujoco><worldbody><body><joint type='slide'/><geom size='{}'/></body></worldbody></mujoco>"


class Thing:
  def __init__(self, **values: Any):
    vars(self).update(values)


def closing_over(value: Any) -> Any:
  return lambda: value


def model(size: float) -> mujoco.MjModel:
  return mujoco.MjModel.from_xml_string(MODEL.format(size))


@pytest.mark.parametrize(
  ("one", "other"),
  [
    (1.0, 2.0),
    (1, 1.0),
    ("ab", "b"),
    (["a", "b"], ["ab"]),
    (np.zeros(3), np.zeros((1, 3))),
    (jnp.zeros(3), jnp.array([0.0, 0.0, 1e-9])),
    ({"a": 1}, {"b": 1}),
    (closing_over(1), closing_over(2)),
    (closing_over(np.arange(3)), closing_over(np.arange(1, 4))),
    (lambda x: x + 1, lambda x: x - 1),
    (lambda x=1: x, lambda x=2: x),
    (jax.jit(closing_over(1)), jax.jit(closing_over(2))),
    (Thing(a=Thing(b=1)), Thing(a=Thing(b=2))),
    (model(0.1), model(0.2)),
    (frozenset("ab"), frozenset("ac")),
  ],
)
def test_other_values_are_another_fingerprint(one: Any, other: Any):
  assert of_values(Thing(held=one)) != of_values(Thing(held=other))


def test_the_same_values_are_the_same_fingerprint():
  make = lambda: Thing(a=1, b={"c": [np.arange(3)]}, model=model(0.1), call=jax.jit(closing_over(jnp.ones(2))))
  assert of_values(make()) == of_values(make())


def test_what_is_left_out_does_not_count():
  of = lambda thing: of_values(thing, without=[thing.config])
  assert of(Thing(a="x", config=[1])) == of(Thing(a="x", config=[2])) != of(Thing(a="y", config=[1]))


def test_an_edited_plug_in_is_other_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
  monkeypatch.syspath_prepend(tmp_path)
  package = tmp_path / "fingerprinted"
  package.mkdir()
  (package / "__init__.py").touch()
  (package / "task.py").write_text("x = 1")
  before = of_code()
  __import__("fingerprinted")
  imported = of_code()
  (package / "task.py").write_text("x = 2")
  edited = of_code()
  (package / "motion.npz").write_bytes(b"1")
  assert len({before, imported, edited, of_code()}) == 4


def test_our_own_code_and_the_libraries_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
  copied = types.SimpleNamespace(__file__=str(tmp_path / "__init__.py"))
  monkeypatch.setattr(fingerprint, "playground", copied)
  monkeypatch.setattr(fingerprint, "LIBRARIES", (*fingerprint.LIBRARIES, str(Path(playground.__file__).parents[1])))
  (tmp_path / "ppo.py").write_text("clip = 1")
  found = {of_code()}
  (tmp_path / "ppo.py").write_text("clip = 2")
  found.add(of_code())
  site = tmp_path.parent / "site"
  (site / "jax-1.0.dist-info").mkdir(parents=True)
  monkeypatch.setattr(fingerprint, "LIBRARIES", (*fingerprint.LIBRARIES, str(site)))
  found.add(of_code())
  (site / "jax-1.0.dist-info").rename(site / "jax-1.1.dist-info")
  assert len({*found, of_code()}) == 4


def test_a_notebook_has_no_fingerprint(monkeypatch: pytest.MonkeyPatch):
  main = types.ModuleType("__main__")
  monkeypatch.setitem(sys.modules, "__main__", main)
  of_code()
  exec("def reward(): ...", vars(main))
  with pytest.raises(NoFingerprintError):
    of_code()


def test_flags_and_precision_count(monkeypatch: pytest.MonkeyPatch):
  mesh = make_mesh(1)
  before = of_machine(mesh)
  monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "/elsewhere")
  assert of_machine(mesh) == before
  monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
  flagged = of_machine(mesh)
  with jax.default_matmul_precision("float32"):
    jax.config.update("jax_debug_nans", True)
    precise = of_machine(mesh)
    jax.config.update("jax_debug_nans", False)
  assert before != flagged != precise


@pytest.mark.slow
def test_another_process_has_the_same():
  code = (
    "from playground import fingerprint, registry\n"
    "env = registry.load('Go1JoystickFlatTerrain')\n"
    "print(fingerprint.of_values(env, without=[env.config]), fingerprint.of_code())"
  )
  printed = [subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout for _ in range(2)]
  assert printed[0] == printed[1] != b""
