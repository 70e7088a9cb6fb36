"""Which modules may import which; imports inside functions count, and so do those for type checkers."""

import ast
import re
from collections.abc import Callable, Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "playground"
FILES = {".".join(("playground", *f.relative_to(PACKAGE).with_suffix("").parts)): f for f in PACKAGE.rglob("*.py")}
MODULES = {name.removesuffix(".__init__"): file for name, file in FILES.items()}


def imports(module: str, node: ast.AST) -> Iterator[str]:
  """The modules of this package that code of `module` imports."""
  for child in ast.iter_child_nodes(node):
    # A term gets the task as an argument, so it names the task's type. It neither makes nor imports a task.
    if (
      module.startswith("playground.mdp.") and isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING"
    ):
      continue
    if isinstance(child, ast.Import):
      yield from (alias.name for alias in child.names if alias.name in MODULES)
    elif isinstance(child, ast.ImportFrom) and child.module in MODULES:
      names = (f"{child.module}.{alias.name}" for alias in child.names)
      yield from (name if name in MODULES else child.module for name in names)
    yield from imports(module, child)


GRAPH = {name: set(imports(name, ast.parse(file.read_text()))) for name, file in MODULES.items()}


def folder(name: str) -> str:
  """The folder that a module lies in; a module of the package's top folder stands for itself."""
  file = MODULES[name]
  return name if file.parent == PACKAGE else str(file.parent.relative_to(PACKAGE))


def top_folder(name: str) -> str:
  """The folder or module of the package's top folder that has a module."""
  return name.split(".")[1] if "." in name else name


def circle(part: Callable[[str], str]) -> list[str]:
  """Parts of the package that lie on circles of imports, or between two of them."""
  left = {part(name): set() for name in GRAPH}
  for name, imported in GRAPH.items():
    left[part(name)] |= {part(other) for other in imported} - {part(name)}
  while free := [name for name in left if not left[name] & left.keys()]:
    for name in free:
      del left[name]
  while free := [name for name in left if not any(name in imported for imported in left.values())]:
    for name in free:
      del left[name]
  return sorted(left)


def test_the_product_does_not_import_the_benchmark() -> None:
  allowed = ("playground.benchmark", "playground.cli.bench")
  product = [name for name in GRAPH if not name.startswith(allowed)]
  assert not [name for name in product if any(other.startswith(allowed) for other in GRAPH[name])]


def test_nothing_names_the_package_of_0_2_0() -> None:
  """Deleting playground/compat020 and its entry point deletes the feature and nothing else."""
  files = [*PACKAGE.rglob("*.py"), *PACKAGE.rglob("*.yaml"), *(PACKAGE.parent / "configs").rglob("*.yaml")]
  rest = [file for file in files if PACKAGE / "compat020" not in file.parents]
  assert len(rest) < len(files)
  assert [file for file in rest if "compat020" in file.read_text(encoding="utf-8")] == []


def test_imports_between_files_form_no_circle() -> None:
  assert circle(str) == []


def test_imports_between_folders_form_no_circle() -> None:
  assert circle(top_folder) == []
  assert circle(folder) == []


def test_only_the_parser_of_its_flags_is_a_private_part_of_hydra() -> None:
  private = {
    f"{node.module}.{alias.name}"
    for file in MODULES.values()
    for node in ast.walk(ast.parse(file.read_text()))
    if isinstance(node, ast.ImportFrom) and re.match(r"(hydra|omegaconf)(\.\w+)*\._", node.module or "")
    for alias in node.names
  }
  assert private == {"hydra._internal.utils.get_args_parser"}


def test_few_lines_hide_a_type_behind_any() -> None:
  lines = [line for file in MODULES.values() for line in file.read_text().splitlines() if re.search(r"\bAny\b", line)]
  assert len(lines) < 300
