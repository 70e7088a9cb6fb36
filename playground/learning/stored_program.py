"""Stores lowered functions on disk: a later start traces nothing, and finds their executables in JAX's cache."""

import contextlib
import dataclasses
import hashlib
import os
import pickle
import stat
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import jax
from jax import export
from jax.sharding import Mesh
from jax.stages import Compiled, Traced, Wrapped

from playground.files import replacing
from playground.pytree import PyTree
from playground.text import first_line

KEPT = 64  # programs in a folder: the last used ones


class UnusableProgramError(Exception):
  """A file is damaged, or JAX refuses it."""


@dataclasses.dataclass(frozen=True)
class LoweredFunction:
  """A jitted function as StableHLO.

  Attributes:
    module: JAX's serialised export of it, with flat arguments and results.
    in_tree: structure of the arguments.
    out_tree: structure of the results.
    donated: positions of the arguments whose buffers the result takes over.
  """

  module: bytes
  in_tree: Any  # a PyTreeDef, which is no type to JAX's stubs
  out_tree: Any
  donated: tuple[int, ...]

  @classmethod
  def of(cls, function: Wrapped, traced: Traced, *args: PyTree) -> Self:
    """Lowers a function that was traced with `args`.

    Raises:
      ValueError, NotImplementedError: it calls code that JAX does not serialise.
    """
    exported = export.export(function)(*args)
    flat = lambda leaves: tuple(0 for _ in leaves)
    trees = {
      "in_tree": jax.tree.structure((flat(exported.in_avals), {})),
      "out_tree": jax.tree.structure(flat(exported.out_avals)),
    }
    infos = [jax.tree.leaves(info) for info in traced.args_info[0]]
    donated = tuple(i for i, leaves in enumerate(infos) if leaves and all(info.donated for info in leaves))
    module = dataclasses.replace(exported, **trees).serialize()
    return cls(bytes(module), exported.in_tree, exported.out_tree, donated)

  def compile(self, mesh: Mesh, options: Mapping[str, str]) -> Compiled:
    """Compiles the function for the devices that it was lowered for, with XLA's `options`."""
    exported = export.deserialize(bytearray(self.module))
    args, _ = self.in_tree.unflatten([jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in exported.in_avals])
    shardings, _ = self.in_tree.unflatten(exported.in_shardings_jax(mesh))

    def call(*args: PyTree) -> PyTree:
      return self.out_tree.unflatten(exported.call(*jax.tree.leaves(args)))

    call.__name__ = exported.fun_name  # its name in XLA and the profiler
    jitted = jax.jit(
      call,
      in_shardings=shardings,
      out_shardings=self.out_tree.unflatten(exported.out_shardings_jax(mesh)),
      donate_argnums=self.donated,
    )
    return jitted.lower(*args).compile(dict(options))


@dataclasses.dataclass(frozen=True)
class StoredProgram:
  """The lowered functions of one program, by name, in a file named by the hash of everything that determines them.

  Nothing is read from a folder that others may write to.

  Attributes:
    path: of the file, which need not exist.
  """

  path: Path

  def load(self) -> dict[str, LoweredFunction] | None:
    """Returns the functions; None if there are none.

    Raises:
      UnusableProgramError: the file is damaged, and was removed.
    """
    if not self.path.exists() or not _is_private(self.path.parent):
      return None
    try:
      content = self.path.read_bytes()
      if hashlib.sha256(content[32:]).digest() != content[:32]:
        raise UnusableProgramError("it is damaged")
      functions = pickle.loads(zlib.decompress(content[32:]))
      os.utime(self.path)
    except Exception as error:  # any error: tracing replaces the file
      raise self.discard(error) from error
    return functions

  def discard(self, error: Exception) -> UnusableProgramError:
    """Removes the file; returns an error with the reason."""
    self.path.unlink(missing_ok=True)
    return UnusableProgramError(
      f"The stored program {self.path} was removed: {first_line(error)}. The program is traced again."
    )

  def save(self, functions: Mapping[str, LoweredFunction]) -> None:
    """Writes the functions, and removes the programs that have not been used for longest. Raises OSError."""
    body = zlib.compress(pickle.dumps(dict(functions)), 1)
    folder = self.path.parent
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not _is_private(folder):
      return
    with replacing(self.path) as temporary:
      temporary.write_bytes(hashlib.sha256(body).digest() + body)
    with contextlib.suppress(FileNotFoundError):  # another process has removed one
      programs = sorted(folder.glob(f"*{self.path.suffix}"), key=lambda path: path.stat().st_mtime, reverse=True)
      for path in programs[KEPT:]:
        path.unlink(missing_ok=True)


def _is_private(folder: Path) -> bool:
  """Whether only this user can write to a folder."""
  found = folder.stat()
  return found.st_uid == os.geteuid() and not found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
