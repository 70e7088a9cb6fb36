"""Which modules may import which; imports inside functions count, those for type checkers do not."""

import ast
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "playground"
FILES = {".".join(("playground", *f.relative_to(PACKAGE).with_suffix("").parts)): f for f in PACKAGE.rglob("*.py")}
MODULES = {name.removesuffix(".__init__"): file for name, file in FILES.items()}


def imports(node: ast.AST) -> Iterator[str]:
  """The modules of this package that code imports."""
  for child in ast.iter_child_nodes(node):
    if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
      continue
    if isinstance(child, ast.Import):
      yield from (alias.name for alias in child.names if alias.name in MODULES)
    elif isinstance(child, ast.ImportFrom) and child.module in MODULES:
      names = (f"{child.module}.{alias.name}" for alias in child.names)
      yield from (name if name in MODULES else child.module for name in names)
    yield from imports(child)


GRAPH = {name: set(imports(ast.parse(file.read_text()))) - {name} for name, file in MODULES.items()}


def circle(names: set[str]) -> list[str]:
  """Modules among `names` of which each imports another one of them; none if there is no circle."""
  left = dict.fromkeys(names)
  while free := [name for name in left if not GRAPH[name] & left.keys()]:
    for name in free:
      del left[name]
  return sorted(left)


def test_the_product_does_not_import_the_benchmark() -> None:
  allowed = ("playground.benchmark", "playground.cli.bench")
  product = [name for name in GRAPH if not name.startswith(allowed)]
  assert not [name for name in product if any(other.startswith(allowed) for other in GRAPH[name])]


def test_modules_of_sweeps_and_benchmarks_form_no_circle() -> None:
  parts = ("playground.sweep", "playground.reporting", "playground.benchmark")
  assert circle({name for name in GRAPH if name.startswith(parts)}) == []
