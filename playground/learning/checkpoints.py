"""Checkpoints: the whole training state, written atomically by Orbax and verified when read.

A checkpoint has three items: `policy` (normaliser and networks: what evaluation, export and `init_from` need), `state`
(the rest of what training goes on from) and `meta` (step, return, task, config, name and shape of every array, a
checksum). The newest may have a fourth, `replay`: experience, which is too large to keep more than once.

Beside the newest, a run keeps the checkpoint with the highest return; `checkpoints/best` is a link to it.
"""

import errno
import hashlib
import logging
import math
import os
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
BEST = "best"
_NO_BEST = (-math.inf, -1)  # return and step
_NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.ENOSYS)  # what file systems say that have none
logging.getLogger("absl").setLevel(logging.ERROR)  # Orbax warns of its own defaults at every save and read
Arrays = list[np.ndarray]
Fetch = Callable[[], np.ndarray | None]


class CheckpointStore:
  """The `checkpoints/` folder of one run. Saving happens on a thread of its own; one save at a time."""

  def __init__(self, folder: str | Path, keep: int = 3, continued: int | None = None):
    """Opens (and makes) the folder.

    Args:
      folder: where to.
      keep: how many are kept, the newest; the one with the highest return (of several, the newest) is kept besides.
      continued: the step that the run goes on from. Checkpoints after it are removed: they were found damaged, and the
        run is about to make them again.
    """
    self._folder, self._keep = Path(folder).absolute(), keep
    self._folder.mkdir(parents=True, exist_ok=True)  # Orbax does not where it is told to work alone
    there = _by_step(self._folder)
    gone = {step for step in there if continued is not None and step > continued}
    returns = {step: _return_of(path) for step, path in there.items() if step not in gone}
    self._best = max(((value, step) for step, value in returns.items() if value is not None), default=_NO_BEST)
    self._link_best()  # before others are removed: what it points to is always whole
    for step in gone:
      shutil.rmtree(there[step])
    options = ocp.CheckpointManagerOptions(
      create=False,
      step_format_fixed_length=12,
      enable_async_checkpointing=False,
      cleanup_tmp_directories=True,
      multiprocessing_options=_alone(),
    )
    self._manager = ocp.CheckpointManager(self._folder, options=options)
    self._thread = ThreadPoolExecutor(1, thread_name_prefix="checkpoint")
    self._pending: Future[None] | None = None

  def save(
    self,
    step: int,
    policy: Any,
    state: Any,
    meta: Mapping[str, Any],
    replay: Fetch | None = None,
    episode_return: float | None = None,
  ) -> None:
    """Starts saving. The trees' arrays must not be donated or deleted meanwhile; an earlier failure is raised here.

    Args:
      step: control steps trained.
      policy: the item of that name, and
      state: so too.
      meta: what else to note.
      replay: fetches that item, if there is one, on the saving thread. Older checkpoints lose theirs.
      episode_return: the policy's, if it has been evaluated; one that is not finite counts as none.
    """
    self.wait()
    noted = episode_return if episode_return is not None and math.isfinite(episode_return) else None
    self._pending = self._thread.submit(self._write, step, policy, state, {**meta, "return": noted}, replay)

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
    if meta["return"] is not None:
      self._best = max(self._best, (meta["return"], step))
    # Orbax's own policies would remove the old best before the link has gone over to the new one.
    self._link_best()
    for old in sorted(self._manager.all_steps())[: -self._keep]:
      if old != self._best[1]:
        self._manager.delete(old)
    for other, path in _by_step(self._folder).items():
      if other != step and (path / "replay").is_dir():
        shutil.rmtree(path / "replay")

  def _link_best(self) -> None:
    """Lets `best` point to the best checkpoint, in one go; without one, or without links, there is no `best`."""
    link, temporary = self._folder / BEST, self._folder / f".{BEST}"
    temporary.unlink(missing_ok=True)  # which a run killed on the next lines has left
    if link.is_dir() and not link.is_symlink():
      shutil.rmtree(link)  # the checkpoint once more: the run was copied by something that follows links
    if self._best == _NO_BEST:
      link.unlink(missing_ok=True)
      return
    try:
      temporary.symlink_to(f"{self._best[1]:012d}")
    except OSError as error:
      if error.errno not in _NO_LINKS:
        raise
      return
    os.replace(temporary, link)


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

  Of a chain's directory they are those of the last stage that has any; of `checkpoints/best` the one it links to.

  Raises:
    CheckpointError: there is none.
  """
  path = Path(path).expanduser()
  if path.name == BEST and path.parent.name == "checkpoints" and path.parent.is_dir():
    return [_linked(path)]
  if not path.exists():
    raise CheckpointError(f"{path} does not exist: give a run directory or one of its checkpoints.")
  if path.name.isdigit() and path.parent.name == "checkpoints":
    return [path]
  folder = path if path.name == "checkpoints" else path / "checkpoints"
  if not folder.is_dir() and (stages := find_stages(path)):
    folder = stages[-1] / "checkpoints"
  found = _by_step(folder)
  if not found:
    raise CheckpointError(f"{path} holds no checkpoint: give a run directory, or a folder under its checkpoints/.")
  return [found[step] for step in sorted(found, reverse=True)]


def find_stages(chain: Path) -> list[Path]:
  """The stages in a chain's directory that have a checkpoint, the last one last."""
  number = lambda stage: stage.name.partition("_")[0]
  stages = [stage for stage in chain.glob("*_*/") if number(stage).isdigit() and _by_step(stage / "checkpoints")]
  return sorted(stages, key=lambda stage: int(number(stage)))


def _by_step(folder: Path) -> dict[int, Path]:
  """The checkpoints in a folder, by what their names say."""
  return {int(path.name): path for path in folder.glob("*") if path.name.isdigit() and path.is_dir()}


def _linked(best: Path) -> Path:
  """The checkpoint that a link points to; raises CheckpointError if there is none."""
  if not best.is_symlink():
    raise CheckpointError(
      f"{best} is no link to a checkpoint: the run has not saved one with a return, or was copied without its links."
    )
  path = best.parent / best.readlink()
  if not path.is_dir():
    raise CheckpointError(f"{best} points to {path.name}, which is not there.")
  return path


def _return_of(folder: Path) -> float | None:
  """The return that a checkpoint notes; one that is damaged has none."""
  try:
    return Checkpoint(folder).meta.get("return")
  except CheckpointError:
    return None


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
