"""Finds the files of configs/, ours and those of outside packages, and the options that they define."""

import functools
import importlib.metadata
import re
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import yaml

from playground.config.definitions import defined
from playground.settings import Plain
from playground.text import first_line
from playground.trust import ENTRY_POINTS

DELTAS = ("experiment", "tuned", "debug")  # groups that change keys of others, and define none
_EXPERIMENTS = {  # shorter names than the rule gives
  "AeroCubeRotateZAxis": "aero_rotate",
  "AlohaHandOver": "aloha_handover",
  "AlohaSinglePegInsertion": "aloha_peg_insertion",
  "CartpoleBalanceVision": "cartpole_pixels",
  "LeapCubeReorient": "leap_reorient",
  "LeapCubeRotateZAxis": "leap_rotate",
}


def shipped(folder: str) -> Path:
  """Returns a folder at the top of the checkout; in the wheel it is inside the package."""
  package = Path(__file__).parents[1]
  inside = package / folder
  return (inside if inside.is_dir() else package.parent / folder).resolve()


def config_roots(config_dir: Path | None = None) -> list[Path]:
  """Returns the folders of groups: ours, then those of outside packages."""
  return [config_dir.resolve() if config_dir else shipped("configs"), *_outside_roots()]


def groups(roots: Iterable[Path]) -> list[str]:
  """Returns the names of all groups, sorted."""
  return sorted({folder.name for root in roots for folder in root.iterdir() if folder.is_dir()} | set(defined()))


def options(group: str, roots: Iterable[Path] | None = None) -> list[str]:
  """Returns a group's options, sorted: those of classes, files, and an experiment for each task.

  Files whose name begins with an underscore are parts that options share.
  """
  roots = config_roots() if roots is None else list(roots)
  folders = [root / group for root in roots]
  files = [(path, folder) for folder in folders for path in folder.rglob("*.yaml") if not path.stem.startswith("_")]
  named = task_experiments(roots) if group == "experiment" else defined().get(group, ())
  return sorted({path.relative_to(folder).with_suffix("").as_posix() for path, folder in files} | set(named))


def experiment_name(task: str) -> str:
  """Returns the name of the experiment that only chooses a task: Go1JoystickRoughTerrain is go1_joystick_rough."""
  words = task.replace("FlatTerrain", "").replace("RoughTerrain", "Rough")
  return _EXPERIMENTS.get(task) or re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", words).lower()


def task_experiments(roots: Sequence[Path]) -> dict[str, str]:
  """Returns the task of each experiment that only chooses one, and which therefore has no file."""
  named = {experiment_name(task): task for task in task_names(roots)}
  return {name: task for name, task in named.items() if find_file("experiment", name, roots) is None}


def lineage(group: str, option: str, roots: Iterable[Path]) -> list[str]:
  """Returns the option and those that its file is built on (the first of each defaults list), nearest first."""
  defaults = read(group, option, roots).get("defaults", [])
  named = [entry.removeprefix(f"/{group}/").partition("@")[0] for entry in defaults if isinstance(entry, str)]
  bases = [name for name in named if name != "_self_"]
  return [option, *(lineage(group, bases[0], roots) if bases else [])]


class Delta(NamedTuple):
  """The changes of an option's file: the sections whose keys it sets, and the groups that it overrides.

  `is_known` is false for a file whose changes are only known after composition.
  """

  sections: frozenset[str] = frozenset()
  groups: frozenset[str] = frozenset()
  is_known: bool = True

  def __or__(self, other: "Delta") -> "Delta":
    return Delta(self.sections | other.sections, self.groups | other.groups, self.is_known and other.is_known)


def delta(group: str, option: str, roots: Sequence[Path]) -> Delta:
  """Returns the changes of an option of a group in `DELTAS`, including the options that its file is built on."""
  file = find_file(group, option, roots)
  if file is None:
    return Delta(is_known=group == "experiment" and option in task_experiments(roots))
  content = read(group, option, roots)
  known = "# @package _global_" in file.read_text().splitlines()[:1]
  found = Delta(frozenset(map(str, content)) - {"defaults"}, frozenset(), known)
  for entry in content.get("defaults", []):
    if isinstance(entry, str):
      base = entry.removeprefix(f"/{group}/") if entry.startswith("/") else f"{option.rpartition('/')[0]}/{entry}"
      found |= delta(group, base.lstrip("/"), roots) if entry != "_self_" else Delta()
    else:
      (name,) = entry
      found |= Delta(groups=frozenset({name.removeprefix("override /")}), is_known=name.startswith("override /"))
  return found


def task_names(roots: Iterable[Path] | None = None) -> list[str]:
  """Returns the options of env that are tasks, in CamelCase; the others need a robot."""
  return [name for name in options("env", roots) if name[0].isupper()]


def listed_options(group: str, roots: Iterable[Path]) -> list[str]:
  """Returns the options to list for a group: of env only the tasks."""
  return task_names(roots) if group == "env" else options(group, roots)


def search_path_override(roots: Sequence[Path]) -> list[str]:
  """Returns the override that adds outside packages' folders to Hydra's search path."""
  quoted = ", ".join("'" + f"file://{root}".replace("'", "\\'") + "'" for root in roots[1:])
  return [f"hydra.searchpath=[{quoted}]"] if quoted else []


def find_file(group: str, option: str, roots: Iterable[Path]) -> Path | None:
  """Returns the file of an option, None if it has none."""
  return next((path for root in roots if (path := root / group / f"{option}.yaml").is_file()), None)


def read(group: str, option: str, roots: Iterable[Path]) -> dict[str, Plain]:
  """Returns the content of an option's file; empty for an option without one, and for a file that is no mapping."""
  file = find_file(group, option, roots)
  content = yaml.safe_load(file.read_text(encoding="utf-8")) if file else None
  return content if isinstance(content, dict) else {}


@functools.cache
def _outside_roots() -> tuple[Path, ...]:
  """Returns the folders of outside packages, by entry point; a broken one is skipped with one warning."""
  roots = []
  for point in importlib.metadata.entry_points(group=ENTRY_POINTS):
    try:
      target = point.load()
      root = Path(str(target() if callable(target) else target))
      if root.suffix == ".yaml":  # <root>/env/<Task>.yaml
        root = root.parent.parent
      names = [path.relative_to(root) for path in sorted(root.glob("*/**/*.yaml"))]
      if not names:
        raise FileNotFoundError(f"{root} holds no file such as env/<TaskName>.yaml or robot/<name>.yaml")
      taken = [name for name in names for above in (shipped("configs"), *roots) if (above / name).is_file()]
      if taken and root.resolve() not in roots:
        unused = f"{taken[0]} is not used, since another package has a file of this name: give it another name"
        warnings.warn(f"Entry point {point.name!r} of {ENTRY_POINTS}: {unused}.", stacklevel=2)
      roots.append(root.resolve())
    except Exception as error:  # an error of an outside package must not break our options
      warnings.warn(f"Entry point {point.name!r} of {ENTRY_POINTS} is skipped: {first_line(error)}", stacklevel=2)
  return tuple(dict.fromkeys(roots))
