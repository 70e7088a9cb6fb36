"""`playground doctor`: checks this machine, and prints how to install missing packages."""

import contextlib
import importlib
import io
import os
import shutil
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from rich.console import Console
from rich.table import Table
from rich.text import Text

from playground.extras import install_command
from playground.files import unwritable
from playground.hardware.gpus import query_gpus
from playground.rendering.gl import NO_GL_REMEDY, find_gl
from playground.runs.provenance import package_version
from playground.runs.wandb_tracker import logged_in
from playground.text import first_line

REQUIRED = {  # distribution -> module whose import proves that it works
  "jax": "jax",
  "jaxlib": "jaxlib",
  "mujoco": "mujoco",
  "mujoco-mjx": "mujoco.mjx",
  "brax": "brax",
  "flax": "flax",
  "optax": "optax",
  "orbax-checkpoint": "orbax.checkpoint",
  "hydra-core": "hydra",
}

_MARKS = {True: Text("✓", "green"), None: Text("!", "yellow"), False: Text("✗", "red")}


@dataclass(frozen=True)
class Finding:
  """One row: `ok` is True (fine), None (works, but could be better) or False (training cannot work)."""

  name: str
  value: str
  ok: bool | None = True
  remedy: str = ""


def doctor(console: Console | None = None) -> int:
  """Prints the state of this machine; returns 0 if training works here at least on the CPU, else 1."""
  # Querying the devices must not take the memory of a run that trains on them.
  os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
  findings = [*_packages(), *_devices(), *_rendering(), *_caches(), *_machine(), *_tracking()]
  table = Table("", "what", "found", "to do")
  for f in findings:
    # Text, because rich would read the [cuda13] of a remedy as its own markup.
    table.add_row(_MARKS[f.ok], *map(Text, (f.name, f.value, f.remedy)))
  console = console or Console()
  console.print(table)
  broken = [f.name for f in findings if f.ok is False]
  console.print(f"Training does not work here yet: see {', '.join(broken)}." if broken else "Training works here.")
  return 1 if broken else 0


def _packages() -> Iterator[Finding]:
  python = ".".join(map(str, sys.version_info[:3]))
  yield Finding("playground-run", package_version("playground-run") or "a checkout that is not installed")
  yield Finding("python", python, sys.version_info >= (3, 11), "" if sys.version_info >= (3, 11) else "Python ≥ 3.11")
  supported = _requirements()
  for name, module in REQUIRED.items():
    version, wanted = package_version(name), supported.get(name, Requirement(name)).specifier
    get = f'pip install "{name}{wanted}"'
    if version is None:
      yield Finding(name, "missing", False, get)
    elif not wanted.contains(version, prereleases=True):
      yield Finding(name, f"{version}, supported is {wanted}", False, get)
    else:
      error = _import_error(module)
      yield Finding(name, version if not error else f"{version}, {error}", not error, get if error else "")
  warp = package_version("warp-lang")
  yield Finding("warp-lang", warp or "not installed (needed on NVIDIA GPUs only)")


def _requirements() -> dict[str, Requirement]:
  """Returns the version requirement of each distribution, from our metadata or, if not installed, the checkout."""
  try:
    lines = metadata.requires("playground-run") or []
  except metadata.PackageNotFoundError:
    lines = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]["dependencies"]
  requirements = [Requirement(line) for line in lines]
  return {r.name: r for r in requirements if r.marker is None}


def _import_error(module: str) -> str:
  try:
    # mujoco.mjx prints "Failed to import warp: …" where Warp is not installed.
    with contextlib.redirect_stdout(io.StringIO()):
      importlib.import_module(module)
  except Exception as error:  # a broken installation raises any type of error
    return f"import fails: {first_line(error)}"
  return ""


def _devices() -> Iterator[Finding]:
  gpu, driver = _nvidia()
  try:
    import jax

    devices = jax.devices()
    jax.block_until_ready(jax.jit(lambda x: x @ x)(jax.numpy.ones((8, 8))))
  except Exception as error:
    found = first_line(error) if str(error) else f"no device of JAX_PLATFORMS={os.environ.get('JAX_PLATFORMS', '')}"
    yield Finding("JAX backend", found, False, "unset JAX_PLATFORMS, or set it to cpu")
    return
  kinds = ", ".join(sorted({d.device_kind for d in devices}))
  yield Finding("JAX backend", f"{jax.default_backend()}, {len(devices)} x {kinds}")
  if gpu:
    unused = jax.default_backend() == "cpu"
    cuda = 13 if driver.partition(".")[0].isdecimal() and int(driver.partition(".")[0]) >= 580 else 12
    missing = unused or package_version("warp-lang") is None
    remedy = install_command(f"cuda{cuda}") if missing else ""
    value = f"{gpu}, driver {driver}{', not used by JAX' if unused else ''}"
    yield Finding("GPU", value, None if missing else True, remedy)
  else:
    yield Finding("GPU", "no NVIDIA driver (training runs on the CPU)")
  precision = jax.config.jax_default_matmul_precision
  found = precision or "JAX's default, TF32 on NVIDIA GPUs"
  yield Finding("matmul precision", f"{found}; a run sets its own, hardware.matmul_precision")


def _nvidia() -> tuple[str, str]:
  """Returns the GPUs' names and the driver's version, or empty strings."""
  rows = [line.rpartition(", ")[::2] for line in query_gpus("name,driver_version")]
  if not rows:
    return "", ""
  return f"{len(rows)} x {rows[0][0]}", rows[0][1]


def _rendering() -> Iterator[Finding]:
  backend = find_gl()
  yield Finding("OpenGL", backend or "none (no videos)", True if backend else None, "" if backend else NO_GL_REMEDY)


def _caches() -> Iterator[Finding]:
  # The default of hardware/setup.py, which cannot be imported here: it needs a JAX that works.
  home = Path("~/.cache/playground").expanduser()
  yield _cache("XLA cache", "JAX_COMPILATION_CACHE_DIR", home / "xla")
  if package_version("warp-lang"):
    yield _cache("Warp cache", "WARP_CACHE_PATH", home / "warp")


def _cache(name: str, variable: str, default: Path) -> Finding:
  folder = Path(os.environ.get(variable) or default)
  if why := unwritable(folder):
    return Finding(name, why, None, f"set {variable} to one")
  return Finding(name, f"{folder}, {_size(folder) if folder.is_dir() else 'empty'}")


def _size(folder: Path) -> str:
  total = 0
  for path in folder.rglob("*"):
    with contextlib.suppress(OSError):  # another process may be cleaning up
      total += path.stat().st_size if path.is_file() else 0
  return f"{total / 2**20:.0f} MiB"


def _machine() -> Iterator[Finding]:
  yield Finding("CPU cores", str(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()))
  page = os.sysconf("SC_PAGE_SIZE") / 2**30
  total, free = (os.sysconf(key) * page for key in ("SC_PHYS_PAGES", "SC_AVPHYS_PAGES"))
  disk = shutil.disk_usage(Path.cwd()).free / 2**30
  yield Finding("memory", f"{total:.0f} GiB, {free:.0f} GiB free; {disk:.0f} GiB of disk free here")


def _tracking() -> Iterator[Finding]:
  if package_version("wandb") is None:
    yield Finding("W&B", "not installed", None, "pip install wandb")
  else:
    yield Finding("W&B", "logged in" if logged_in() else "offline (`wandb login` to go online)")
