"""Hashes of what a compiled program is made from: code, versions, and the values that objects hold.

Two fingerprints that are the same promise the same program; more may be in one than a program depends on.
"""

import functools
import hashlib
import os
import platform
import sys
import sysconfig
import types
from collections.abc import Iterable, Iterator, Mapping, Set
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
from jax.sharding import Mesh

import playground

# Libraries that run while a program is traced: an edited file of theirs counts, too.
TRACED = ("jax", "jaxlib", "mujoco", "brax", "flax", "optax", "distrax")
VARIABLES = ("XLA_", "JAX_", "MJX_", "MUJOCO_", "TF_", "NVIDIA_", "CUDA_")  # of the environment, by how they begin
PATHS = ("compilation_cache", "persistent_cache")  # parts of JAX's settings on where programs are kept
LIBRARIES = tuple(dict.fromkeys(sysconfig.get_paths()[key] for key in ("stdlib", "platstdlib", "purelib", "platlib")))


class NoFingerprintError(Exception):
  """There is code that no file holds."""


def digest(parts: Mapping[str, object]) -> str:
  """Returns the hash of named values, by their `repr`."""
  return hashlib.sha256(repr(sorted(parts.items())).encode()).hexdigest()


def of_machine(mesh: Mesh) -> dict[str, object]:
  """Returns what a compiled program depends on besides code and configuration: devices, flags, JAX's settings."""
  device = mesh.devices.flat[0]
  settings = {k: v for k, v in jax.config.values.items() if not any(part in k for part in PATHS)}
  return {
    "devices": [(each.platform, each.device_kind, each.id, each.process_index) for each in mesh.devices.flat],
    "mesh": [*mesh.shape.items()],
    "runtime": device.client.platform_version,
    "capability": getattr(device, "compute_capability", None),
    "processor": _processor(),
    "python": sys.version,
    "jax": sorted((k, repr(v)) for k, v in settings.items()),
    "variables": sorted(
      (k, v) for k, v in os.environ.items() if k.startswith(VARIABLES) and not any(part in k.lower() for part in PATHS)
    ),
  }


def _processor() -> str:
  """The host's processor and its instructions, for which XLA compiles."""
  try:
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
  except OSError:
    return platform.processor()
  return "".join(sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))}))


def of_code() -> str:
  """Returns the hash of this package, of imported modules that are not installed, and of installed libraries.

  Code counts by its text; other files and the libraries by size and time of change.

  Raises:
    NoFingerprintError: `__main__` defines something, and is no file.
  """
  found = hashlib.sha256()
  for folder in LIBRARIES:
    if os.path.isdir(folder):
      names = (name for name in os.listdir(folder) if name.endswith((".dist-info", ".egg-info", ".pth", ".egg-link")))
      found.update(repr([(name, _stamp(os.path.join(folder, name))) for name in sorted(names)]).encode())
  for name in TRACED:
    if (module := sys.modules.get(name)) and module.__file__:
      found.update(repr([(path, _stamp(path)) for path in _files(Path(module.__file__).parent)]).encode())
  for source in sorted(_own_sources()):
    for path in _files(source) if os.path.isdir(source) else (source,):
      found.update(repr((path, None if path.endswith(".py") else _stamp(path))).encode())
      if path.endswith(".py"):
        found.update(hashlib.sha256(Path(path).read_bytes()).digest())
  return found.hexdigest()


def _own_sources() -> set[str]:
  """This package's folder, and packages' folders and single modules that were imported from outside the libraries."""
  own = os.path.dirname(playground.__file__)
  sources = {own}
  for name, module in list(sys.modules.items()):
    file = getattr(module, "__file__", None)
    if name == "__main__":
      if any(getattr(value, "__module__", None) == "__main__" for value in vars(module).values()):
        if not file:
          raise NoFingerprintError("__main__ defines something, and is no file")
        sources.add(os.path.abspath(file))
    elif file and not file.startswith((*(f"{folder}{os.sep}" for folder in LIBRARIES), own + os.sep)):
      parents = name.count(".") + (os.path.basename(file) == "__init__.py")
      sources.add(str(Path(os.path.abspath(file)).parents[parents - 1]) if parents else os.path.abspath(file))
  return {source for source in sources if source == own or not source.startswith(own + os.sep)}


def _files(folder: str | Path) -> Iterator[str]:
  for parent, folders, names in os.walk(folder):
    folders[:] = sorted(name for name in folders if not name.startswith((".", "__pycache__")))
    yield from (os.path.join(parent, name) for name in sorted(names))


def _stamp(path: str) -> tuple[int, int] | None:
  try:
    found = os.stat(path)
  except OSError:
    return None  # a link to nothing
  return found.st_size, found.st_mtime_ns


def of_values(*roots: object, without: Iterable[object] = ()) -> str:
  """Returns the hash of all values that are reached from objects: attributes, items, what functions close over.

  Classes count by name and functions by their code; what has no attributes (locks, devices) by its class.

  Args:
    roots: where to begin.
    without: objects that are left out.
  """
  walk = _Walk()
  for value in without:
    walk.skip(value)
  stack: list[Any] = [*reversed(roots)]
  while stack:
    stack.extend(reversed(walk.visit(stack.pop())))
  return walk.hash.hexdigest()


class _Walk:
  """Hashes values one by one, each once."""

  def __init__(self):
    self.hash = hashlib.sha256()
    self._seen: dict[int, int] = {}
    self._alive: list[object] = []  # an address is a name only as long as its object lives

  def skip(self, value: object) -> None:
    self._seen[id(value)] = len(self._seen)
    self._alive.append(value)

  def visit(self, value: Any) -> list[Any]:
    """Hashes a value; returns what it holds."""
    kind = type(value)
    self._add(kind.__module__, kind.__qualname__)
    if value is None or isinstance(value, bool | int | float | complex | str | bytes | np.generic):
      self._add(repr(value))
      return []
    if id(value) in self._seen:
      self._add(str(self._seen[id(value)]))
      return []
    self.skip(value)
    if isinstance(value, np.ndarray | jax.Array):
      return self._array(value)
    if isinstance(value, mujoco.MjModel):
      buffer = np.empty(mujoco.mj_sizeModel(value), np.uint8)
      mujoco.mj_saveModel(value, None, buffer)
      self.hash.update(buffer.data)
      return []
    if isinstance(value, type | types.ModuleType):
      self._add(getattr(value, "__module__", ""), getattr(value, "__qualname__", value.__name__))
      return []
    return _held(value)

  def _array(self, value: Any) -> list[Any]:
    if jax.dtypes.issubdtype(value.dtype, jax.dtypes.extended):  # random keys
      value = jax.random.key_data(value)
    array = np.asarray(value)
    self._add(str(array.dtype), str(array.shape))
    if array.dtype == object:
      return list(array.flat)
    self.hash.update(array.tobytes())
    return []

  def _add(self, *texts: str) -> None:
    for text in texts:
      self.hash.update(f"{len(text)}:{text}".encode())


def _held(value: Any) -> list[Any]:
  """What an object holds, in an order that is the same in every process."""
  if isinstance(value, Mapping):
    return [part for item in value.items() for part in item]
  if isinstance(value, Set):
    return sorted(value, key=repr)
  if isinstance(value, list | tuple):
    return [*value]
  if isinstance(value, types.FunctionType):
    cells = [cell.cell_contents for cell in value.__closure__ or () if _is_filled(cell)]
    named = [value.__globals__.get(name) for name in value.__code__.co_names]
    constants = [each for each in named if isinstance(each, bool | int | float | str | tuple | np.ndarray | jax.Array)]
    return [value.__module__, value.__code__, value.__defaults__, value.__kwdefaults__, *cells, *constants]
  if isinstance(value, types.CodeType):
    return [value.co_code, value.co_names, value.co_consts]
  if isinstance(value, types.MethodType):
    return [value.__func__, value.__self__]
  if isinstance(value, functools.partial):
    return [value.func, value.args, value.keywords]
  slots = [each.__dict__.get("__slots__", ()) for each in type(value).__mro__]
  names = [name for each in slots for name in ([each] if isinstance(each, str) else each)]
  held = [getattr(value, name) for name in names if name not in ("__dict__", "__weakref__") and hasattr(value, name)]
  return held + [part for item in sorted(getattr(value, "__dict__", {}).items()) for part in item]


def _is_filled(cell: types.CellType) -> bool:
  try:
    cell.cell_contents  # noqa: B018
  except ValueError:
    return False
  return True
