"""Where the files of configs/ and sweeps/ lie, ours and those of outside packages, and which options they make."""

import functools
import importlib.metadata
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path

import yaml

from playground.config.definitions import defined
from playground.config.text import first_line

ENTRY_POINTS = "playground.tasks"
DELTAS = ("experiment", "tuned", "debug")  # groups that change what the others define, and define nothing


def shipped(folder: str) -> Path:
  """A folder that stands at the top of the checkout; in the wheel it lies inside the package."""
  package = Path(__file__).parents[1]
  inside = package / folder
  return (inside if inside.is_dir() else package.parent / folder).resolve()


def config_roots(config_dir: Path | None = None) -> list[Path]:
  """Folders that hold groups: ours, then outside packages'."""
  return [config_dir.resolve() if config_dir else shipped("configs"), *_outside_roots()]


def groups(roots: Iterable[Path]) -> list[str]:
  """Names of all groups, sorted."""
  return sorted({folder.name for root in roots for folder in root.iterdir() if folder.is_dir()} | set(defined()))


def options(group: str, roots: Iterable[Path] | None = None) -> list[str]:
  """Names of a group's options, sorted: those that a class defines, and files.

  Files whose name begins with an underscore are parts that options share.
  """
  folders = [root / group for root in (config_roots() if roots is None else roots)]
  files = [(path, folder) for folder in folders for path in folder.rglob("*.yaml") if not path.stem.startswith("_")]
  return sorted(
    {path.relative_to(folder).with_suffix("").as_posix() for path, folder in files} | set(defined().get(group, ()))
  )


def lineage(group: str, option: str, roots: Iterable[Path]) -> list[str]:
  """The option and the options its file is built on (the first of its defaults list, and so on), nearest first."""
  file = next((path for root in roots if (path := root / group / f"{option}.yaml").is_file()), None)
  defaults = (yaml.safe_load(file.read_text()) or {}).get("defaults", []) if file else []
  named = [entry.removeprefix(f"/{group}/").partition("@")[0] for entry in defaults if isinstance(entry, str)]
  bases = [name for name in named if name != "_self_"]
  return [option, *(lineage(group, bases[0], roots) if bases else [])]


def task_names(roots: Iterable[Path] | None = None) -> list[str]:
  """Options of env that are tasks, in CamelCase; the others need a robot to become one."""
  return [name for name in options("env", roots) if name[0].isupper()]


def listed_options(group: str, roots: Iterable[Path]) -> list[str]:
  """Options that one chooses from when nothing else is said: of env those that are tasks."""
  return task_names(roots) if group == "env" else options(group, roots)


def search_path_override(roots: Sequence[Path]) -> list[str]:
  """The override that makes Hydra look into outside packages' folders too."""
  quoted = ", ".join("'" + f"file://{root}".replace("'", "\\'") + "'" for root in roots[1:])
  return [f"hydra.searchpath=[{quoted}]"] if quoted else []


@functools.cache
def _outside_roots() -> tuple[Path, ...]:
  """Folders of outside packages, by entry point; one that is broken is skipped with a warning, once."""
  roots = []
  for point in importlib.metadata.entry_points(group=ENTRY_POINTS):
    try:
      target = point.load()
      root = Path(str(target() if callable(target) else target))
      if root.suffix == ".yaml":  # <root>/env/<Task>.yaml
        root = root.parent.parent
      if not any(root.glob("*/**/*.yaml")):
        raise FileNotFoundError(f"{root} holds no file such as env/<TaskName>.yaml or robot/<name>.yaml")
      roots.append(root.resolve())
    except Exception as error:  # whatever an outside package does wrong, ours go on working
      warnings.warn(f"Entry point {point.name!r} of {ENTRY_POINTS} is skipped: {first_line(error)}", stacklevel=2)
  return tuple(dict.fromkeys(roots))
