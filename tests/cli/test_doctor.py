import io
import os
import subprocess
import sys

import pytest
from rich.console import Console

from playground.cli import doctor as module
from playground.cli.doctor import doctor
from playground.rendering.gl import NO_GL_REMEDY


@pytest.fixture
def report(monkeypatch: pytest.MonkeyPatch):
  monkeypatch.setattr(module, "find_gl", lambda: "egl")

  def run() -> tuple[int, str]:
    out = io.StringIO()
    code = doctor(Console(file=out, width=300))
    return code, out.getvalue()

  return run


def row(text: str, name: str) -> str:
  return next(line for line in text.splitlines() if f" {name} " in line)


def test_this_machine_can_train():
  """In a process of its own, as users run it: nothing but the table may appear."""
  code = "import sys; from playground.cli.doctor import doctor; sys.exit(doctor())"
  environment = os.environ | {"MUJOCO_GL": "disable", "COLUMNS": "200", "JAX_PLATFORMS": "cpu"}
  done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120)
  assert done.returncode == 0, done.stdout + done.stderr
  assert done.stdout.startswith("┏") and done.stdout.endswith("Training works here.\n")
  for name in (*module.REQUIRED, "JAX backend", "OpenGL", "XLA cache", "CPU cores", "matmul precision", "W&B"):
    assert f" {name} " in done.stdout
  assert "libosmesa6" in done.stdout


def test_a_missing_package_is_named_with_its_remedy(report, monkeypatch: pytest.MonkeyPatch):
  monkeypatch.setattr(module, "package_version", lambda name: None if name == "brax" else "1.0")
  monkeypatch.setattr(module, "_requirements", lambda: {"brax": module.Requirement("brax>=0.14.2,<0.15")})
  code, text = report()
  assert code == 1 and "see brax" in text
  assert 'pip install "brax<0.15,>=0.14.2"' in row(text, "brax")


def test_an_unsupported_version_is_named(report, monkeypatch: pytest.MonkeyPatch):
  real = module.package_version
  monkeypatch.setattr(module, "package_version", lambda name: "0.1.0" if name == "jax" else real(name))
  code, text = report()
  assert code == 1 and "0.1.0, supported is" in row(text, "jax") and "see jax." in text


@pytest.mark.parametrize(("driver", "extra"), [("580.82", "cuda13"), ("550.54", "cuda12")])
def test_a_gpu_that_jax_does_not_use(report, monkeypatch: pytest.MonkeyPatch, driver: str, extra: str):
  monkeypatch.setattr(module, "_nvidia", lambda: ("1 x NVIDIA H200", driver))
  code, text = report()
  assert code == 0  # the CPU still trains
  assert "not used by JAX" in row(text, "GPU") and f"pip install -e '.[{extra}]'" in row(text, "GPU")


def test_a_cache_that_cannot_be_written_is_named(report, monkeypatch: pytest.MonkeyPatch):
  monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", f"{__file__}/xla")
  code, text = report()
  assert code == 0 and "test_doctor.py is not a folder that you may write to" in row(text, "XLA cache")
  assert "set JAX_COMPILATION_CACHE_DIR to one" in row(text, "XLA cache")


def test_a_platform_that_jax_lacks_is_named():
  environment = os.environ | {"JAX_PLATFORMS": "cuda", "COLUMNS": "200", "CUDA_VISIBLE_DEVICES": ""}
  code = "import sys; from playground.cli.doctor import doctor; sys.exit(doctor())"
  done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120)
  assert done.returncode == 1 and "AssertionError" not in row(done.stdout, "JAX backend")


def test_no_gl_says_how_to_get_it(report, monkeypatch: pytest.MonkeyPatch):
  monkeypatch.setattr(module, "find_gl", lambda: None)
  code, text = report()
  assert code == 0 and NO_GL_REMEDY[:40] in row(text, "OpenGL")
