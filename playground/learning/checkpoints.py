"""Checkpoints: the whole training state, written atomically by Orbax and verified when read.

A checkpoint has three items: `policy` (normaliser and networks: what evaluation, export and `init_from` need), `state`
(the rest of the training state) and `meta` (step, return, task, config, name and shape of every array, and
checksums of all items, itself included). The newest may have a fourth, `replay`: the replay buffer, which is too large
to keep more than once.

Beside the newest, a run keeps the checkpoint with the highest return; `checkpoints/best` is a link to it.

Reading deletes nothing. A checkpoint is damaged only if its bytes are readable but differ from the saved ones: a
resumed run moves it to `checkpoints/damaged_<step>`. Reads that fail in the operating system are retried, then raise.
"""

import contextlib
import errno
import hashlib
import json
import logging
import math
import os
import re
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import NoneType
from typing import TypeVar

import jax
import numpy as np
import orbax.checkpoint as ocp
import tensorstore as ts

from playground.errors import CheckpointError
from playground.files import numbered
from playground.pytree import PyTree
from playground.settings import Plain, Section
from playground.text import first_line

FORMAT = "playground-run/1"
BEST = "best"
_META_TYPES: dict[str, type | tuple[type, ...]] = {
  "step": int,
  "update": int,
  "wall_clock_s": (int, float),
  "env": str,
  "config": dict,
  "leaves": dict,
  "sha256": dict,
  "return": (int, float, NoneType),
  "columns": (list, NoneType),  # earlier versions wrote none of these
  "settings": (dict, NoneType),
}
_ABOUT_FILES = (None, errno.ENOENT, errno.ENOTDIR, errno.EISDIR)  # errors about the files; others may be temporary
_TRANSIENT = ("RESOURCE_EXHAUSTED", "UNAVAILABLE", "PERMISSION_DENIED", "DEADLINE_EXCEEDED", "ABORTED", "CANCELLED")
_RETRY_AFTER_S = (0.1, 0.5, 2.0)
_PLAIN_PATH = re.compile(r"[\w/.,+=@ -]*")
_NO_BEST = (-math.inf, -1)  # return and step
_BY_BYTE = {"id": "blosc", "cname": "zstd", "clevel": 9, "shuffle": 1}  # a compressor of Zarr
_NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.ENOSYS)  # errors of file systems without links
logging.getLogger("absl").setLevel(logging.CRITICAL)  # Orbax warns about its own defaults, and raises its errors
Arrays = list[np.ndarray]
Leaf = list[Plain]  # name, shape and dtype
T = TypeVar("T")


class NoCheckpointError(CheckpointError):
  """A run that has no checkpoint yet."""


class DamagedCheckpointError(CheckpointError):
  """A checkpoint whose bytes differ from the saved ones, or that holds NaN or infinite values."""


_quiet: list[set[threading.Thread]] = []  # for each block of `_quiet_threads`, the threads that were there before it
_quiet_lock = threading.Lock()


@contextlib.contextmanager
def _quiet_threads() -> Iterator[None]:
  """Silences Orbax's threads, whose first error Orbax raises, until they have ended; blocks may overlap."""
  global _hook
  before = set(threading.enumerate())
  with _quiet_lock:
    if not _quiet:
      _hook, threading.excepthook = threading.excepthook, _report_others
    _quiet.append(before)
  try:
    yield
  except Exception:
    for thread in set(threading.enumerate()) - before:
      thread.join(10)
    raise
  finally:
    with _quiet_lock:
      _quiet.remove(before)
      if not _quiet:
        threading.excepthook = _hook


_hook = threading.excepthook  # that of the process


def _report_others(args: threading.ExceptHookArgs) -> None:
  if all(args.thread in before for before in _quiet):
    _hook(args)


def _ignore_late_results() -> None:
  """Silences TensorStore's threads about reads that were pending when another one failed."""
  hook = sys.unraisablehook
  sys.unraisablehook = lambda args: None if str(args.exc_value) == "Event loop is closed" else hook(args)


_ignore_late_results()


class CheckpointStore:
  """The `checkpoints/` folder of one run. One save runs at a time, on a thread of its own."""

  def __init__(self, folder: str | Path, keep: int = 3, continued: int | None = None):
    """Opens (and makes) the folder.

    Args:
      folder: of the checkpoints.
      keep: number of newest checkpoints to keep, beside the one with the highest return (of equal ones the newest).
      continued: the step that the run continues from. Later checkpoints were found damaged, and the run will make
        them again: they are moved to `damaged_<step>`.

    Raises:
      CheckpointError: reading a checkpoint failed, though it is not damaged.
    """
    self._folder, self._keep = Path(folder).absolute(), keep
    self._folder.mkdir(parents=True, exist_ok=True)  # Orbax does not in single-process mode
    self._handle = os.open(self._folder, os.O_RDONLY)  # the folder itself, even if it is replaced
    there = _by_step(self._folder)
    damaged = {step for step in there if continued is not None and step > continued}
    returns = {step: _return_of(path) for step, path in there.items() if step not in damaged}
    self._best = max(((value, step) for step, value in returns.items() if value is not None), default=_NO_BEST)
    self._link_best()  # before others are moved: it always points to a complete checkpoint
    for step in damaged:
      there[step].rename(numbered(there[step].with_name(f"damaged_{there[step].name}")))
    self._alias = _Alias(self._folder)
    options = ocp.CheckpointManagerOptions(
      create=False,
      step_format_fixed_length=12,
      enable_async_checkpointing=False,
      cleanup_tmp_directories=True,
      multiprocessing_options=_alone(),
    )
    self._manager = ocp.CheckpointManager(self._alias.path, options=options)
    self._thread = ThreadPoolExecutor(1, thread_name_prefix="checkpoint")
    self._pending: Future[None] | None = None

  def save(
    self,
    step: int,
    policy: PyTree,
    state: PyTree,
    meta: Section,
    replay: np.ndarray | None = None,
    episode_return: float | None = None,
  ) -> None:
    """Starts saving. The arrays must not be donated or deleted meanwhile. Raises an earlier failure.

    Args:
      step: control steps trained.
      policy: the item of that name.
      state: the item of that name.
      meta: further entries of the item of that name.
      replay: that item, None without one. Older checkpoints lose theirs.
      episode_return: of the policy, if it has been evaluated; a non-finite one counts as none.
    """
    self.wait()
    noted = episode_return if episode_return is not None and math.isfinite(episode_return) else None
    self._pending = self._thread.submit(self._write, step, policy, state, {**meta, "return": noted}, replay)

  def check(self) -> None:
    """Raises the error of a save that has failed."""
    if self._pending is not None and self._pending.done():
      self.wait()

  def wait(self) -> None:
    """Blocks until the save is on disk; raises its error."""
    if self._pending is not None:
      pending, self._pending = self._pending, None
      pending.result()

  def close(self) -> None:
    """Waits for the save, and frees what the store holds; raises the error of a save that has failed."""
    try:
      self.wait()
    finally:
      self._thread.shutdown()
      self._manager.close()
      self._alias.remove()
      os.close(self._handle)

  def _write(self, step: int, policy: PyTree, state: PyTree, meta: dict[str, Plain], replay: np.ndarray | None) -> None:
    trees = {"policy": policy, "state": state} | ({} if replay is None else {"replay": replay})
    arrays = {name: [np.asarray(x) for x in jax.tree.leaves(tree)] for name, tree in trees.items()}
    meta |= {
      "format": FORMAT,
      "step": step,
      "leaves": {name: describe(tree) for name, tree in trees.items()},
      "sha256": {name: checksum(values) for name, values in arrays.items()},
    }
    if any(_first_nonfinite(meta["leaves"][name], values) is not None for name, values in arrays.items()):
      meta["return"] = None  # a removed one is never the best
    meta["meta_sha256"] = _meta_checksum(meta)
    items = {name: ocp.args.StandardSave(_numbered(values)) for name, values in arrays.items()}  # pyright: ignore[reportCallIssue]
    try:
      self._save(step, ocp.args.Composite(**items, meta=ocp.args.JsonSave(meta)))  # pyright: ignore[reportCallIssue]
    except Exception as error:
      for half in self._folder.glob(f"{step:012d}.*"):  # frees the space that the final records need
        shutil.rmtree(half, ignore_errors=True)
      reason = _not_about_files(error) or (str(error) if isinstance(error, OSError) else "")
      if not reason:
        raise
      way_on = f"resume={self._folder.parent} goes on from what is saved"
      raise CheckpointError(f"{self._folder} cannot be written: {reason}. {way_on}.") from error
    if meta["return"] is not None:
      self._best = max(self._best, (meta["return"], step))
    # Orbax's own policies would remove the old best before the link points to the new one.
    self._link_best()
    for old in sorted(self._manager.all_steps())[: -self._keep]:
      if old != self._best[1]:
        self._manager.delete(old)
    for other, path in _by_step(self._folder).items():
      if other != step and (path / "replay").is_dir():
        shutil.rmtree(path / "replay")

  def _save(self, step: int, items: ocp.args.CheckpointArgs) -> None:
    self._must_be_there()
    with _quiet_threads():
      self._manager.save(step, args=items, force=True)
    self._must_be_there()

  def _must_be_there(self) -> None:
    """Raises FileNotFoundError if the folder was removed; Orbax would make a new empty one."""
    with contextlib.suppress(OSError):
      if os.path.samestat(os.fstat(self._handle), os.stat(self._folder)):
        return
    shutil.rmtree(self._folder, ignore_errors=True)
    with contextlib.suppress(OSError):
      self._folder.parent.rmdir()
    raise FileNotFoundError("it was removed")

  def _link_best(self) -> None:
    """Atomically links `best` to the best checkpoint, if there is one and the file system has links."""
    link, temporary = self._folder / BEST, self._folder / f".{BEST}"
    temporary.unlink(missing_ok=True)  # left by a run that was killed on the next lines
    if link.is_dir() and not link.is_symlink():
      shutil.rmtree(link)  # a copy of the checkpoint: the run was copied with links followed
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
  """One checkpoint on disk; its meta data are verified."""

  def __init__(self, folder: str | Path):
    """Reads and checks the meta data.

    Raises:
      DamagedCheckpointError: they differ from the saved ones.
      CheckpointError: no checkpoint, one of another program or a newer version, or reading it failed.
    """
    self.path = Path(folder).absolute()
    if not self.path.is_dir():
      raise CheckpointError(f"No checkpoint at {folder}: there is no such folder.")
    self.meta: dict[str, Plain] = self._read_meta()

  @property
  def step(self) -> int:
    return self.meta["step"]

  def has(self, item: str) -> bool:
    """Whether the checkpoint has an item."""
    return (self.path / item).is_dir()

  def restore(self, item: str, template: PyTree) -> PyTree:
    """Returns the tree of item 'policy', 'state' or 'replay' as host arrays.

    Args:
      item: name of the item.
      template: a tree with the expected structure, shapes and dtypes (`jax.eval_shape`'s result will do).

    Raises:
      DamagedCheckpointError: its bytes differ from the saved ones, or hold NaN or infinite values.
      CheckpointError: reading it failed, or it was made for other shapes (another task, network or number of
        environments).
    """
    found = self.meta["leaves"].get(item)
    if found is None:
      raise DamagedCheckpointError(f"{self.path} is damaged: its meta data describe no {item!r}.")
    expected = describe(template)
    if expected != found:
      raise CheckpointError(f"{self.path} does not fit this run: {_first_difference(expected, found)}.")
    leaves = self.arrays(item)
    return jax.tree.unflatten(jax.tree.structure(template), leaves)

  def arrays(self, item: str) -> list[np.ndarray]:
    """Returns the arrays of an item in the order of the meta data's `leaves`. Raises what `restore` does for damage."""
    found = self.meta["leaves"][item]
    numbered = self._read(item, lambda: self._read_arrays(item))
    leaves = [np.asarray(numbered.get(_number(i), np.zeros(shape, dtype))) for i, (_, shape, dtype) in enumerate(found)]
    if checksum(leaves) != self.meta["sha256"].get(item):
      raise DamagedCheckpointError(f"{self.path} is damaged: the checksum of its {item!r} does not match.")
    if (broken := _first_nonfinite(found, leaves)) is not None:
      raise DamagedCheckpointError(f"{self.path} cannot be used: its {item}{broken} holds NaN or infinite values.")
    return leaves

  def _read(self, item: str, read: Callable[[], T]) -> T:
    """Returns the result of reading an item; distinguishes damage from errors of the operating system."""
    for pause in (*_RETRY_AFTER_S, None):
      try:
        return read()
      except Exception as error:
        reason = _not_about_files(error) or self._unreadable(item)
        if reason is None:
          raise DamagedCheckpointError(f"{self.path} is damaged: its {item!r} cannot be read.") from error
        if pause is None:
          raise CheckpointError(f"{self.path} cannot be read now, which need not be damage: {reason}.") from error
        time.sleep(pause)
    raise AssertionError("unreachable")

  def _unreadable(self, item: str) -> str | None:
    """Returns the error of reading the files of an item; None if all are readable."""
    try:
      for folder, _, names in os.walk(self.path / item, onerror=_raise):
        for name in names:
          with open(os.path.join(folder, name), "rb") as file:
            while file.read(1 << 24):
              pass
    except OSError as error:
      return _not_about_files(error)
    return None

  @_quiet_threads()
  def _read_arrays(self, item: str) -> dict[str, np.ndarray]:
    options = ocp.CheckpointManagerOptions(
      read_only=True, step_format_fixed_length=12, multiprocessing_options=_alone()
    )
    alias = _Alias(self.path.parent)
    manager = ocp.CheckpointManager(alias.path, options=options)
    args = ocp.args.Composite(**{item: ocp.args.StandardRestore()})  # pyright: ignore[reportCallIssue]
    try:
      return manager.restore(int(self.path.name), args=args)[item]
    finally:
      manager.close()
      alias.remove()

  def _read_meta(self) -> dict[str, Plain]:
    # As Orbax writes it; read without Orbax, whose errors do not tell the cause.
    file = self.path / "meta" / "metadata"
    if not file.exists() and not any((self.path / item).is_dir() for item in ("meta", "policy", "state")):
      raise DamagedCheckpointError(f"{self.path} is not a checkpoint of playground-run.")  # or half deleted
    meta = self._read("meta", lambda: json.loads(file.read_bytes()))
    written_as = meta.get("format") if isinstance(meta, dict) else None
    if _version(written_as) > _version(FORMAT):
      raise CheckpointError(
        f"{self.path} was written by a newer version of playground-run (its format is {written_as}, this version reads "
        f"{FORMAT}): update playground-run."
      )
    if isinstance(meta, dict) and written_as != FORMAT:
      raise CheckpointError(f"{self.path} is not a checkpoint of playground-run ({FORMAT}).")
    if why := _meta_damage(meta):
      raise DamagedCheckpointError(f"{self.path} is damaged: its meta data {why}.")
    if meta["step"] != int(self.path.name):
      raise CheckpointError(f"{self.path} holds step {meta['step']}: rename the folder to {meta['step']:012d}.")
    return meta


def find_checkpoints(path: str | Path) -> list[Path]:
  """Returns the checkpoints at `path`, newest first: those of a run directory, or `path` itself.

  Of a chain's directory they are those of the last stage that has any; of `checkpoints/best` the one it links to.

  Raises:
    CheckpointError: there is no checkpoint.
  """
  path = Path(os.path.expanduser(path))
  if "checkpoints" in Path.cwd().parts:  # a checkpoint may be named from inside its run's folder
    path = Path(os.path.abspath(path))
  if path.name == BEST and path.parent.name == "checkpoints" and path.parent.is_dir():
    return [_linked(path)]
  if not path.exists():
    raise CheckpointError(f"{path} does not exist: give a run directory or one of its checkpoints.")
  if path.name.isdecimal() and path.parent.name == "checkpoints":
    return [path]
  folder = path if path.name == "checkpoints" else path / "checkpoints"
  if not folder.is_dir() and (stages := find_stages(path)):
    folder = stages[-1] / "checkpoints"
  found = _by_step(folder)
  if not found:
    folders = [*path.glob("*/"), *path.glob("jobs/*/")]  # `path` may be that of a sweep
    if runs := sorted(run for run in folders if (run / "checkpoints").is_dir() or find_stages(run)):
      raise NoCheckpointError(f"{path} is a folder of runs: name one, such as the newest, {runs[-1]}.")
    if path.suffix == ".onnx" or (path / "policy.onnx").is_file():
      what = "holds no checkpoint, but an exported policy, which only `playground play` takes"
      raise NoCheckpointError(f"{path} {what}: give the run that it came from.")
    raise NoCheckpointError(f"{path} holds no checkpoint: give a run directory, or a folder under its checkpoints/.")
  return [found[step] for step in sorted(found, reverse=True)]


def find_stages(chain: Path) -> list[Path]:
  """Returns the stages in a chain's directory that have a checkpoint, in order; none in a folder of a sweep's jobs."""
  if not (chain / "config.yaml").is_file():
    return []
  number = lambda stage: stage.name.partition("_")[0]
  stages = [stage for stage in chain.glob("*_*/") if number(stage).isdecimal() and _by_step(stage / "checkpoints")]
  return sorted(stages, key=lambda stage: int(number(stage)))


def _by_step(folder: Path) -> dict[int, Path]:
  """Returns the checkpoints in a folder by step; raises CheckpointError if listing it fails."""
  try:
    return {int(path.name): path for path in folder.iterdir() if path.name.isdecimal() and path.is_dir()}
  except (FileNotFoundError, NotADirectoryError):
    return {}
  except OSError as error:
    raise CheckpointError(f"{folder} cannot be read: {error.strerror}.") from error


def _linked(best: Path) -> Path:
  """Returns the checkpoint that a link points to; raises CheckpointError if there is none."""
  if not best.is_symlink():
    raise CheckpointError(
      f"{best} is no link to a checkpoint: the run has not saved one with a return, or was copied without its links."
    )
  path = best.parent / best.readlink()
  if not path.is_dir():
    raise CheckpointError(f"{best} points to {path.name}, which is not there.")
  return path


def _return_of(folder: Path) -> float | None:
  """Returns the return of a checkpoint; None of a damaged one."""
  try:
    return Checkpoint(folder).meta.get("return")
  except DamagedCheckpointError:
    return None


def of_a_better_one(named: str | Path, newest: Checkpoint) -> list[str]:
  """Returns a sentence if `named` is a run whose newest return is over a tenth below its best, else nothing.

  Args:
    named: what the user gave, see `find_checkpoints`.
    newest: the first of those checkpoints.
  """
  best = newest.path.parent / BEST
  if Path(named).name in (BEST, newest.path.name):
    return []
  try:
    reached, now = _return_of(_linked(best)), newest.meta.get("return")
  except CheckpointError:  # no best, or one that cannot be read
    return []
  if reached is None or now is None or reached - now <= 0.1 * abs(reached):
    return []
  return [f"The newest checkpoint returned {now:.4g} in training, {best} {reached:.4g}: name that one to take it."]


def round_policy(folder: str | Path, bits: Callable[[str], int | None]) -> None:
  """Rounds arrays of a checkpoint's item 'policy' to fewer significant bits, and removes the paths of its run.

  The dtype stays. The files are compressed: those of arrays of 3 bits take about a fifth of the space.

  Args:
    folder: the checkpoint.
    bits: returns how many significant bits of 24 stay of the array of a name, such as
      `.params.value['params']['hidden_0']['kernel']`; None keeps it as it is.

  Raises:
    CheckpointError: as `Checkpoint` does.
  """
  checkpoint = Checkpoint(folder)
  arrays, meta = checkpoint.arrays("policy"), checkpoint.meta
  for i, (name, _, dtype) in enumerate(meta["leaves"]["policy"]):
    if kept := bits(name):
      mantissa, exponent = np.frexp(arrays[i].astype(np.float64))
      arrays[i] = np.ldexp(np.round(mantissa * 2**kept) / 2**kept, exponent).astype(dtype)
  with _quiet_threads(), ocp.StandardCheckpointer() as checkpointer:
    checkpointer.save(checkpoint.path / "policy", _numbered(arrays), force=True)
  compress(checkpoint.path / "policy")
  meta["sha256"]["policy"] = checksum(arrays)
  meta["config"].update(run_dir=None, resume=None)
  meta["meta_sha256"] = _meta_checksum(meta)
  (checkpoint.path / "meta" / "metadata").write_text(json.dumps(meta))


def compress(item: Path) -> None:
  """Compresses the arrays of a checkpoint's item by their first bytes, their second bytes and so on.

  That takes a quarter less space where the last bits are zero. Orbax does not write such files, but reads them.
  """
  context = ts.Context()  # one for all arrays, which one transaction writes
  with tempfile.TemporaryDirectory(dir=item.parent) as folder:
    old, new = ({"driver": "ocdbt", "base": {"driver": "file", "path": f"{path}/"}} for path in (item, folder))
    with ts.Transaction(atomic=True) as transaction:  # else their number of files depends on timing
      for key in ts.KvStore.open(old).result().list().result():
        if key.endswith(b".zarray"):
          name = key.decode().removesuffix(".zarray")
          array = ts.open({"driver": "zarr", "kvstore": old, "path": name}).result()
          metadata = array.spec().to_json()["metadata"] | {"compressor": _BY_BYTE}
          spec = {"driver": "zarr", "kvstore": new, "path": name, "metadata": metadata}
          copy = ts.open(spec, create=True, transaction=transaction, context=context).result()
          copy.write(array.read().result()).result()
    (item / "manifest.ocdbt").unlink()
    for data in ("d", "ocdbt.process_0"):
      shutil.rmtree(item / data, ignore_errors=True)
    for part in Path(folder).iterdir():
      part.rename(item / part.name)


def describe(tree: PyTree) -> list[Leaf]:
  """Returns name, shape and dtype of every leaf."""
  flat, _ = jax.tree_util.tree_flatten_with_path(tree)
  return [[jax.tree_util.keystr(path), list(np.shape(leaf)), str(np.dtype(leaf.dtype))] for path, leaf in flat]


def checksum(leaves: Arrays) -> str:
  """Returns the SHA-256 of the bytes of all arrays."""
  digest = hashlib.sha256()
  for leaf in leaves:
    digest.update(np.ascontiguousarray(leaf).reshape(-1).view(np.uint8).data)
  return digest.hexdigest()


def _first_nonfinite(described: list[Leaf], leaves: Arrays) -> str | None:
  """Returns the name of the first leaf of the learned state with a NaN or infinite value.

  An environment may hold such values (`info["nonfinite_state"]`): the guard keeps them from the optimiser.
  """
  for (name, *_), leaf in zip(described, leaves, strict=True):
    floating = jax.numpy.issubdtype(leaf.dtype, np.floating)  # NumPy alone does not count bfloat16
    if floating and not name.startswith(".env_state") and not np.isfinite(leaf).all():
      return name
  return None


def _meta_checksum(meta: Section) -> str:
  """Returns the SHA-256 of the meta data as JSON, without this checksum itself."""
  rest = {key: value for key, value in meta.items() if key != "meta_sha256"}
  return hashlib.sha256(json.dumps(json.loads(json.dumps(rest)), sort_keys=True).encode()).hexdigest()


def _meta_damage(meta: Plain) -> str:
  """Describes damage of meta data of our format, '' if there is none. Earlier versions wrote no checksum."""
  if not isinstance(meta, dict):
    return "are no mapping"
  for key, kind in _META_TYPES.items():
    if not isinstance(meta.get(key), kind):
      return f"have no valid {key!r}"
  for key in ("agent", "env"):
    if not isinstance(meta["config"].get(key, {}), dict):
      return f"have no valid {'config.' + key!r}"
  if meta["update"] < 0:
    return "have no valid 'update'"
  described = [leaf for leaves in meta["leaves"].values() for leaf in (leaves if isinstance(leaves, list) else [None])]
  if not all(isinstance(leaf, list) and list(map(type, leaf)) == [str, list, str] for leaf in described):
    return "have no valid 'leaves'"
  if "meta_sha256" in meta and _meta_checksum(meta) != meta["meta_sha256"]:
    return "do not match their checksum"
  return ""


def _version(written_as: object) -> int:
  """Returns the version number of our format, 0 for any other."""
  match = re.fullmatch(r"playground-run/(\d+)", str(written_as))
  return int(match[1]) if match else 0


def _not_about_files(error: BaseException | None) -> str | None:
  """Returns the error of the operating system (too many open files, permission, disk); None for other errors."""
  while error is not None:
    text = str(error)
    number = re.search(r"os_error_code='(\d+)'", text)  # of TensorStore, which raises ValueError for all
    if isinstance(error, OSError) and error.errno not in _ABOUT_FILES:
      return error.strerror
    if number and int(number[1]) not in _ABOUT_FILES:
      return os.strerror(int(number[1]))
    no_resource = isinstance(error, MemoryError | RuntimeError) and not isinstance(error, RecursionError)
    if no_resource or text.startswith(_TRANSIENT):
      return first_line(error)
    error = error.__cause__ or error.__context__
  return None


def _raise(error: OSError) -> None:
  raise error


class _Alias:
  """A path to a folder that Orbax can use.

  Orbax and TensorStore read `[`, `*` and `?` in a folder's path as patterns, a backslash as `/` and `:/` as a
  protocol. For a path with such characters, they get a link to it in the system's temporary folder.
  """

  def __init__(self, folder: Path):
    self.path, self._temporary = folder, None
    if not _PLAIN_PATH.fullmatch(str(folder)):
      self._temporary = tempfile.TemporaryDirectory(prefix="playground_", ignore_cleanup_errors=True)
      self.path = Path(self._temporary.name) / "checkpoints"
      self.path.symlink_to(folder, target_is_directory=True)

  def remove(self) -> None:
    if self._temporary:
      self._temporary.cleanup()


def _alone() -> ocp.options.MultiprocessingOptions:
  """Makes Orbax wait for no other process of the training: one writes, each reads for itself."""
  if jax.process_count() == 1:
    return ocp.options.MultiprocessingOptions()
  index = jax.process_index()
  return ocp.options.MultiprocessingOptions(index, {index}, barrier_sync_key_prefix=f"process{index}")


def _numbered(leaves: Arrays) -> dict[str, np.ndarray]:
  """Returns arrays by their index in the tree, without empty ones, which Orbax refuses."""
  return {_number(i): leaf for i, leaf in enumerate(leaves) if leaf.size}


def _number(i: int) -> str:
  return f"{i:05d}"


def _first_difference(expected: list[Leaf], found: list[Leaf]) -> str:
  theirs = {name: (tuple(shape), dtype) for name, shape, dtype in found}
  for name, shape, dtype in expected:
    if name not in theirs:
      return f"it has no {name}"
    if theirs[name] != (tuple(shape), dtype):
      return f"{name} is {theirs[name][1]}{list(theirs[name][0])} there and {dtype}{list(shape)} here"
  extra = set(theirs) - {name for name, *_ in expected}
  return f"it has {sorted(extra)[0]} besides" if extra else "the order of its arrays differs"
