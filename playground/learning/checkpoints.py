"""Checkpoints: the whole training state, written atomically by Orbax and verified when read.

A checkpoint has three items: `policy` (normaliser and networks: what evaluation, export and `init_from` need), `state`
(the rest of what training goes on from) and `meta` (step, task, config, the name and shape of every array, a checksum).
The newest may have a fourth, `replay`: experience, which is too large to keep more than once.
"""

import hashlib
import logging
import shutil
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from playground.errors import CheckpointError

FORMAT = "playground-run/1"
logging.getLogger("absl").setLevel(logging.ERROR)  # Orbax warns of its own defaults at every save and read
Arrays = list[np.ndarray]
Fetch = Callable[[], np.ndarray | None]


class CheckpointStore:
  """The `checkpoints/` folder of one run. Saving happens on a thread of its own; one save at a time."""

  def __init__(self, folder: str | Path, keep: int = 3, continued: int | None = None):
    """Opens (and makes) the folder.

    Args:
      folder: where to.
      keep: how many are kept, the newest.
      continued: the step that the run goes on from. Checkpoints after it are removed: they were found damaged, and the
        run is about to make them again.
    """
    if continued is not None:
      for path in Path(folder).glob("*"):
        if path.name.isdigit() and int(path.name) > continued:
          shutil.rmtree(path)
    Path(folder).mkdir(parents=True, exist_ok=True)  # Orbax does not where it is told to work alone
    options = ocp.CheckpointManagerOptions(
      create=False,
      max_to_keep=keep,
      step_format_fixed_length=12,
      enable_async_checkpointing=False,
      cleanup_tmp_directories=True,
      multiprocessing_options=_alone(),
    )
    self._manager = ocp.CheckpointManager(Path(folder).absolute(), options=options)
    self._thread = ThreadPoolExecutor(1, thread_name_prefix="checkpoint")
    self._pending: Future[None] | None = None

  def save(self, step: int, policy: Any, state: Any, meta: Mapping[str, Any], replay: Fetch | None = None) -> None:
    """Starts saving. The trees' arrays must not be donated or deleted meanwhile; an earlier failure is raised here.

    Args:
      step: control steps trained.
      policy: the item of that name, and
      state: so too.
      meta: what else to note.
      replay: fetches that item, if there is one, on the saving thread. Older checkpoints lose theirs.
    """
    self.wait()
    self._pending = self._thread.submit(self._write, step, policy, state, dict(meta), replay)

  def wait(self) -> None:
    """Returns when what was saved lies on disk; raises what went wrong with it."""
    if self._pending is not None:
      pending, self._pending = self._pending, None
      pending.result()

  def close(self) -> None:
    self.wait()
    self._thread.shutdown()
    self._manager.close()

  def _write(self, step: int, policy: Any, state: Any, meta: dict[str, Any], replay: Fetch | None) -> None:
    trees = {"policy": policy, "state": state}
    if replay and (experience := replay()) is not None:
      trees["replay"] = experience
    arrays = {name: [np.asarray(x) for x in jax.device_get(jax.tree.leaves(tree))] for name, tree in trees.items()}
    meta |= {
      "format": FORMAT,
      "step": step,
      "leaves": {name: describe(tree) for name, tree in trees.items()},
      "sha256": {name: checksum(values) for name, values in arrays.items()},
    }
    items = {name: ocp.args.StandardSave(_numbered(values)) for name, values in arrays.items()}  # pyright: ignore[reportCallIssue]
    self._manager.save(step, args=ocp.args.Composite(**items, meta=ocp.args.JsonSave(meta)), force=True)  # pyright: ignore[reportCallIssue]
    for path in Path(self._manager.directory).glob("*/replay"):
      if path.parent.name.isdigit() and int(path.parent.name) != step:
        shutil.rmtree(path)


class Checkpoint:
  """One checkpoint on disk, checked to be whole and ours."""

  def __init__(self, folder: str | Path):
    """Reads what the checkpoint says of itself.

    Raises:
      CheckpointError: no checkpoint there, or not one of ours.
    """
    self.path = Path(folder).absolute()
    if not self.path.is_dir():
      raise CheckpointError(f"No checkpoint at {folder}: there is no such folder.")
    try:
      self.meta: dict[str, Any] = self._read("meta", ocp.args.JsonRestore())  # pyright: ignore[reportCallIssue]
    except Exception as error:
      raise CheckpointError(f"{folder} is not a checkpoint of playground-run, or its meta data is damaged.") from error
    if not isinstance(self.meta, dict) or self.meta.get("format") != FORMAT:
      raise CheckpointError(f"{folder} is not a checkpoint of playground-run ({FORMAT}).")

  @property
  def step(self) -> int:
    return self.meta["step"]

  def has(self, item: str) -> bool:
    """Whether it holds an item."""
    return (self.path / item).is_dir()

  def restore(self, item: str, template: Any) -> Any:
    """Returns the tree of item 'policy', 'state' or 'replay' as host arrays.

    Args:
      item: which one.
      template: a tree with the expected structure, shapes and dtypes (`jax.eval_shape`'s result will do).

    Raises:
      CheckpointError: damaged, or made for other shapes (another task, network or number of environments).
    """
    expected, found = describe(template), self.meta["leaves"][item]
    if expected != found:
      raise CheckpointError(f"{self.path} does not fit this run: {_first_difference(expected, found)}.")
    try:
      numbered = self._read(item, ocp.args.StandardRestore())  # pyright: ignore[reportCallIssue]
      shapes = [(tuple(shape), dtype) for _, shape, dtype in found]
      leaves = [np.asarray(numbered.get(_number(i), np.zeros(*spec))) for i, spec in enumerate(shapes)]
      whole = checksum(leaves) == self.meta["sha256"][item]
    except Exception as error:
      raise CheckpointError(f"{self.path} is damaged: its {item!r} cannot be read.") from error
    if not whole:
      raise CheckpointError(f"{self.path} is damaged: the checksum of its {item!r} does not match.")
    return jax.tree.unflatten(jax.tree.structure(template), leaves)

  def _read(self, item: str, args: Any) -> Any:
    options = ocp.CheckpointManagerOptions(
      read_only=True, step_format_fixed_length=12, multiprocessing_options=_alone()
    )
    manager = ocp.CheckpointManager(self.path.parent, options=options)
    try:
      return manager.restore(int(self.path.name), args=ocp.args.Composite(**{item: args}))[item]
    finally:
      manager.close()


def find_checkpoints(path: str | Path) -> list[Path]:
  """The checkpoints at `path`, newest first: those of a run directory, or the one that `path` itself is.

  Of a chain's directory they are those of the last stage that has any.

  Raises:
    CheckpointError: there is none.
  """
  path = Path(path).expanduser()
  if not path.exists():
    raise CheckpointError(f"{path} does not exist: give a run directory or one of its checkpoints.")
  if path.name.isdigit() and path.parent.name == "checkpoints":
    return [path]
  folder = path if path.name == "checkpoints" else path / "checkpoints"
  if not folder.is_dir():
    number = lambda folder: folder.parent.name.partition("_")[0]
    stages = [p for p in path.glob("*_*/checkpoints/") if number(p).isdigit() and any(p.iterdir())]
    folder = max(stages, key=lambda p: int(number(p)), default=folder)
  found = sorted((p for p in folder.glob("*") if p.name.isdigit() and p.is_dir()), key=lambda p: int(p.name))
  if not found:
    raise CheckpointError(f"{path} holds no checkpoint: give a run directory, or a folder under its checkpoints/.")
  return found[::-1]


def describe(tree: Any) -> list[list[Any]]:
  """Name, shape and dtype of every leaf."""
  flat, _ = jax.tree_util.tree_flatten_with_path(tree)
  return [[jax.tree_util.keystr(path), list(np.shape(leaf)), str(np.dtype(leaf.dtype))] for path, leaf in flat]


def checksum(leaves: Arrays) -> str:
  """SHA-256 over the bytes of all arrays."""
  digest = hashlib.sha256()
  for leaf in leaves:
    digest.update(np.ascontiguousarray(leaf).reshape(-1).view(np.uint8).data)
  return digest.hexdigest()


def _alone() -> ocp.options.MultiprocessingOptions:
  """Orbax is to wait for no other process of this training: one writes, each reads for itself."""
  if jax.process_count() == 1:
    return ocp.options.MultiprocessingOptions()
  index = jax.process_index()
  return ocp.options.MultiprocessingOptions(index, {index}, barrier_sync_key_prefix=f"process{index}")


def _numbered(leaves: Arrays) -> dict[str, np.ndarray]:
  """Arrays by their place in the tree; Orbax refuses those without entries, which need no saving."""
  return {_number(i): leaf for i, leaf in enumerate(leaves) if leaf.size}


def _number(i: int) -> str:
  return f"{i:05d}"


def _first_difference(expected: list[list[Any]], found: list[list[Any]]) -> str:
  theirs = {name: (tuple(shape), dtype) for name, shape, dtype in found}
  for name, shape, dtype in expected:
    if name not in theirs:
      return f"it has no {name}"
    if theirs[name] != (tuple(shape), dtype):
      return f"{name} is {theirs[name][1]}{list(theirs[name][0])} there and {dtype}{list(shape)} here"
  extra = set(theirs) - {name for name, *_ in expected}
  return f"it has {sorted(extra)[0]} besides" if extra else "the order of its arrays differs"
