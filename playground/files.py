"""Files that are either complete or absent: whatever kills a run never leaves half of one under its real name.

And locks: files that say which process is at work on a run, a job or a sweep. And readers of files that another user
may have written.
"""

import csv
import errno
import fcntl
import io
import itertools
import json
import os
import shutil
import socket
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import yaml

from playground.errors import CheckpointError, ConfigError
from playground.settings import Plain, plain

_MOST_ALIASED = 10_000


def need_folder(folder: Path, option: str, within: Path | None = None) -> None:
  """Raises ConfigError, which names the option that it is of, where `unwritable` has a reason; makes no folder."""
  if (reason := unwritable(folder, within)) is not None:
    raise ConfigError(f"{option} cannot be written: {reason}.")


def unwritable(folder: Path, within: Path | None = None) -> str | None:
  """Returns why no folder can be there or be written to, None where one can; makes none.

  A folder `within` another one, such as a run of somebody else, must not be a link that leads out of it.
  """
  if within is not None and not folder.resolve().is_relative_to(within.resolve()):
    return f"{folder} is a link that leads out of {within}"
  folder = folder.absolute()
  there = next(path for path in (folder, *folder.parents) if os.path.exists(path))
  try:
    tempfile.TemporaryDirectory(dir=there).cleanup()  # permissions alone say yes to root, and of /proc
  except OSError:
    return f"{there} is not a folder that you may write to"
  return None


def check_links(folder: Path, depth: int) -> None:
  """Raises CheckpointError if a link in a folder, which another user may have made, leads out of it.

  What is written to the folder would be written there.

  Args:
    folder: the folder; it may be a link itself.
    depth: levels of folders to look at. Folders `wandb` are left out: W&B links to its own cache, and writes elsewhere.
  """
  root = folder.resolve()
  for path, folders, files in os.walk(root):
    for entry in (Path(path, name) for name in (*folders, *files)):
      if os.path.islink(entry) and not Path(os.path.realpath(entry)).is_relative_to(root):
        raise CheckpointError(f"{entry} is a link that leads out of {folder}: put what it stands for in its place.")
    deepest = len(Path(path).relative_to(root).parts) + 1 >= depth
    folders[:] = [name for name in folders if name != "wandb" and not deepest]


def need_file(path: Path, suffix: str, option: str) -> None:
  """Raises ConfigError, which names the option that it is of, where no file of that suffix can be; makes no folder."""
  if path.suffix != suffix or path.is_dir():
    raise ConfigError(f"{option} must be a file that ends in {suffix}.")
  need_folder(path.parent, option)


# Of the process, read once: to read it is to change it, for the files that other threads make meanwhile, too.
_UMASK = os.umask(0o077)
os.umask(_UMASK)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
  """Yields a temporary sibling of `path` (same suffix) that takes its place only if the block succeeds."""
  handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=path.suffix, dir=path.parent)
  os.close(handle)
  temporary = Path(name)
  try:
    yield temporary
    temporary.chmod(0o666 & ~_UMASK)  # mkstemp makes files private, and results are shared
    os.replace(temporary, path)
  except OSError as error:
    error.filename = error.filename or str(path)  # a write to a full disk names no file
    raise
  finally:
    temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
  """Writes `text` atomically and durably."""
  with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
    file.write(text)
    file.flush()
    os.fsync(file.fileno())


def write_json(path: Path, content: Mapping[str, object]) -> None:
  """Writes `content` atomically as strict JSON; NaN and infinity, which JSON has not, become null."""
  write_text(path, json.dumps(plain(content, finite=True), indent=2, allow_nan=False) + "\n")


_NO_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK, errno.EINVAL)  # what file systems say that have none


@contextmanager
def locking(path: Path, patience_s: float = 0.0) -> Iterator[int | None]:
  """Holds a lock while the block runs; yields its file descriptor, or None if another process holds it.

  Processes that inherit the descriptor hold the lock, too. The kernel releases it when the last of them has ended,
  however that was, so there is no stale one: the file stays and names the last holder. On a file system without locks
  everybody gets it.

  Args:
    path: the lock's file.
    patience_s: how long to wait for it.
  """
  handle = os.open(path, os.O_CREAT | os.O_RDWR, 0o666)
  try:
    until = time.monotonic() + patience_s
    while not (got := _try_lock(handle, fcntl.LOCK_EX)) and time.monotonic() < until:
      time.sleep(0.05)
    if got:
      os.ftruncate(handle, 0)
      os.pwrite(handle, json.dumps({"pid": os.getpid(), "host": socket.gethostname()}).encode(), 0)
    yield handle if got else None
  finally:
    os.close(handle)


def is_locked(path: Path) -> bool:
  """Whether a process holds a lock, on this machine or another that shares the file system."""
  try:
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # the folder may be another user's, the file even a pipe
  except FileNotFoundError:
    return False
  try:
    return not _try_lock(handle, fcntl.LOCK_SH)
  finally:
    os.close(handle)


def lock_holder(path: Path) -> str:
  """The process that took a lock last, in words."""
  try:
    holder = json.loads(path.read_bytes())
    return f"process {holder['pid']} on {holder['host']}"
  except (OSError, ValueError, KeyError, TypeError):
    return "another process"


def _try_lock(handle: int, kind: int) -> bool:
  try:
    fcntl.flock(handle, kind | fcntl.LOCK_NB)
  except OSError as error:
    return error.errno in _NO_LOCKS
  return True


def read_csv(path: Path) -> list[dict[str, str]]:
  """Returns the rows of a CSV by column."""
  with path.open(encoding="utf-8", newline="") as file:
    return list(csv.DictReader(file))


def csv_text(columns: Sequence[str], rows: Iterable[Mapping[str, object]], header: bool = False) -> str:
  """Returns lines of CSV: a missing cell is empty, cells of other columns are left out."""
  text = io.StringIO()
  writer = csv.DictWriter(text, columns, restval="", extrasaction="ignore", lineterminator="\n")
  if header:
    writer.writeheader()
  writer.writerows(rows)
  return text.getvalue()


def numbered(path: Path) -> Path:
  """The first of `<stem><suffix>`, `<stem>_2<suffix>`, `<stem>_3<suffix>`, ... that is not there."""
  number, free = 1, path
  while free.exists():
    number += 1
    free = path.with_name(f"{path.stem}_{number}{path.suffix}")
  return free


def make_numbered(path: Path) -> Path:
  """Makes the folder that `numbered` names; the operating system lets only one process make it."""
  path.parent.mkdir(parents=True, exist_ok=True)
  while True:
    folder = numbered(path)
    with suppress(FileExistsError):
      folder.mkdir()
      return folder


def keep_copy(path: Path, stem: str) -> Path:
  """Copies a file to a sibling `<stem><suffix>`, numbered if that is there already; returns the copy."""
  return Path(shutil.copy2(path, numbered(path.with_name(f"{stem}{path.suffix}"))))


def read_json(path: Path, **kinds: type | tuple[type, ...]) -> dict[str, Plain]:
  """Returns the object in `path`, or {} if there is no such file.

  Args:
    path: the file.
    **kinds: the types of those keys that the caller reads, as far as they are there.

  Raises:
    CheckpointError: the file is unreadable, is not JSON or has a value of another type.
  """
  if not path.is_file():
    return {}
  try:
    content = json.loads(path.read_text(encoding="utf-8"))
  except OSError as error:
    raise CheckpointError(f"{path} cannot be read: {error.strerror}.") from error
  except (ValueError, RecursionError):
    content = None
  given = content if isinstance(content, dict) else {}
  wrong = [key for key, kind in kinds.items() if key in given and not isinstance(given[key], kind)]
  if not isinstance(content, dict) or wrong:
    why = f"its {wrong[0]!r} has the wrong type" if wrong else "it is no JSON object"
    raise CheckpointError(f"{path} is damaged ({why}): move it away to go on without it.")
  return content


def check_aliases(path: Path) -> yaml.Node | None:
  """Returns a YAML file's node.

  Raises:
    yaml.YAMLError: it is no YAML, or its aliases stand for so many values that reading them might take for ever.
  """
  sizes: dict[int, int] = {}  # values that a node stands for

  def size(node: yaml.Node) -> int:
    if id(node) not in sizes:
      sizes[id(node)] = sys.maxsize  # for an alias inside of what it stands for
      inner = itertools.chain(*node.value) if isinstance(node, yaml.MappingNode) else node.value
      sizes[id(node)] = 1 + (0 if isinstance(node, yaml.ScalarNode) else sum(map(size, inner)))
    return sizes[id(node)]

  with path.open(encoding="utf-8") as file:
    node = yaml.compose(file, yaml.SafeLoader)
  if node is not None and size(node) > len(sizes) + _MOST_ALIASED:
    raise yaml.YAMLError(f"its aliases stand for more than {_MOST_ALIASED:,} values")
  return node


def read_yaml(path: Path) -> Plain:
  """Reads a YAML file that another user may have written; raises as `check_aliases` does, OSError and ValueError."""
  node = check_aliases(path)
  return None if node is None else yaml.SafeLoader("").construct_document(node)
