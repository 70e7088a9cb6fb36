"""Files that are either complete or absent: whatever kills a run never leaves half of one under its real name."""

import json
import math
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from playground.errors import ConfigError


def need_folder(folder: Path, option: str) -> None:
  """Raises ConfigError, which names the option that it is of, where no folder can be or be written to; makes none."""
  folder = folder.absolute()
  there = next(path for path in (folder, *folder.parents) if os.path.exists(path))
  if not (there.is_dir() and os.access(there, os.W_OK | os.X_OK)):
    raise ConfigError(f"{option} cannot be written: {there} is not a folder that you may write to.")


def need_file(path: Path, suffix: str, option: str) -> None:
  """Raises ConfigError, which names the option that it is of, where no file of that suffix can be; makes no folder."""
  if path.suffix != suffix or path.is_dir():
    raise ConfigError(f"{option} must be a file that ends in {suffix}.")
  need_folder(path.parent, option)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
  """Yields a temporary sibling of `path` (same suffix) that takes its place only if the block succeeds."""
  handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=path.suffix, dir=path.parent)
  os.close(handle)
  temporary = Path(name)
  try:
    yield temporary
    umask = os.umask(0)  # mkstemp makes files private; a shared results folder wants the user's own default
    os.umask(umask)
    temporary.chmod(0o666 & ~umask)
    os.replace(temporary, path)
  finally:
    temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
  """Writes `text` atomically and durably."""
  with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
    file.write(text)
    file.flush()
    os.fsync(file.fileno())


def write_json(path: Path, content: Mapping[str, Any]) -> None:
  """Writes `content` atomically as strict JSON; NaN and infinity, which JSON has not, become null."""
  write_text(path, json.dumps(plain(content, finite=True), indent=2, allow_nan=False) + "\n")


def read_json(path: Path) -> dict[str, Any]:
  """Returns the object in `path`, or {} if there is no such file."""
  return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def plain(value: Any, finite: bool = False) -> Any:
  """Returns `value` (ConfigDict, tuple, path, array, …) as the dicts, lists and scalars that YAML and JSON know."""
  if hasattr(value, "to_dict"):  # ml_collections.ConfigDict
    value = value.to_dict()
  if isinstance(value, Mapping):
    return {str(k): plain(v, finite) for k, v in value.items()}
  if isinstance(value, list | tuple | set):
    return [plain(v, finite) for v in value]
  if hasattr(value, "tolist"):  # NumPy and JAX arrays and scalars
    return plain(value.tolist(), finite)
  if isinstance(value, float):
    return None if finite and not math.isfinite(value) else value
  return value if value is None or isinstance(value, bool | int | str) else str(value)
