"""Which code a configuration may name: a task's class, `module:name`.

A configuration of a run, a policy or a sweep may come from another user. Importing a module runs it, so the module's
name is checked first. Trusted are the tasks and terms of this package, installed packages that register tasks (entry
points of the group `playground.tasks`), and packages that the user names on this command line (`trust=my_package`,
`--trust my_package`) or in Python (`trust("my_package")`).
"""

import importlib
import importlib.metadata
import traceback
from pathlib import Path
from types import ModuleType

from playground.errors import ConfigError, PlaygroundError, nearest
from playground.text import first_line

ENTRY_POINTS = "playground.tasks"
_THIS = "playground"
# Tasks and terms. Other functions of this package start programs and write files, with arguments that `params` may set.
_OWN = ("playground.envs", "playground.mdp")

_named: set[str] = set()  # by the user of this process


def trust(*packages: str) -> None:
  """Lets configurations name code of these packages, or modules, for the rest of this process.

  Raises:
    ConfigError: a name that no package can have.
  """
  for package in packages:
    if not isinstance(package, str) or not _is_dotted_name(package):
      raise ConfigError(f"trust={package} is not the name of a package, such as my_package or my_package.tasks.")
  _named.update(packages)


def trusted_object(key: str, spec: object) -> object:
  """Imports the class or function that a configuration names.

  Args:
    key: where the configuration names it, for errors.
    spec: the value, `module:name`.

  Raises:
    ConfigError: it is of another form, does not exist, or belongs to a package that is not trusted, which is then not
      imported.
  """
  module_name, _, name = str(spec).partition(":")
  if not _is_dotted_name(module_name) or not name.isidentifier():
    raise ConfigError(f"{key}={spec} is not of the form module:name.")
  if not _is_trusted(module_name):
    raise _untrusted(key, spec, module_name)
  module = named_module(key, spec, module_name)
  own = [n for n, value in vars(module).items() if getattr(value, "__module__", None) == module_name]
  if name not in vars(module):
    raise ConfigError(f"{key}={spec}: {module_name} has no {name}.{nearest(name, own)}")
  found = vars(module)[name]
  home = getattr(found, "__module__", None)
  if not isinstance(home, str) or not _is_trusted(home):  # what a trusted module imports is not its own
    raise _untrusted(key, spec, home or name)
  return found


def named_module(key: str, spec: object, name: str) -> ModuleType:
  """Imports the module `name` of `<key>=<spec>`; raises ConfigError if there is none, or importing it fails."""
  try:
    return importlib.import_module(name)
  except PlaygroundError:
    raise
  except Exception as error:  # of any type: it runs the module
    if isinstance(error, ModuleNotFoundError) and f"{name}.".startswith(f"{error.name}."):
      raise ConfigError(f"{key}={spec}: there is no module {error.name} (installed, or on PYTHONPATH).") from None
    frames = [(frame.filename, frame.lineno) for frame in traceback.extract_tb(error.__traceback__)]
    file, line = [frame for frame in frames if not frame[0].startswith("<frozen importlib")][-1]
    if isinstance(error, SyntaxError) and error.filename:
      file, line = error.filename, error.lineno
    why = f"{type(error).__name__}: {getattr(error, 'msg', None) or first_line(error)}"
    raise ConfigError(f"{key}={spec}: importing {name} fails in {Path(file).name}:{line}: {why}.") from error


def _untrusted(key: str, spec: object, module: str) -> ConfigError:
  package = module.partition(".")[0]
  if package == _THIS:
    own = ", ".join(sorted(name for name in _trusted() if name.partition(".")[0] == _THIS))
    return ConfigError(f"{key}={spec} is refused: of {_THIS}, a configuration may only name code of {own}.")
  known = ", ".join(sorted({name if name in _named else name.partition(".")[0] for name in _trusted()}))
  return ConfigError(
    f"{key}={spec} is refused: a configuration may only name code of {known}, which {package} is not. If you trust it, "
    f"add trust={package} (--trust {package} for commands other than playground-run)."
  )


def _is_trusted(module: str) -> bool:
  return any(f"{module}.".startswith(f"{package}.") for package in _trusted())


def _trusted() -> set[str]:
  modules = [point.module for point in importlib.metadata.entry_points(group=ENTRY_POINTS)]
  # Of this package, the module itself: another one is not a task because it lies beside it.
  registered = {module if module.startswith(f"{_THIS}.") else module.partition(".")[0] for module in modules}
  return {*_OWN} | registered | (_named - {_THIS})


def _is_dotted_name(text: str) -> bool:
  return all(part.isidentifier() for part in text.split("."))
