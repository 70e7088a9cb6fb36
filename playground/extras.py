"""Optional parts: the extra that each needs, and the error without it."""

import importlib.util

from playground.errors import ConfigError


def install_command(extra: str) -> str:
  """Returns how to install an extra: this package lies in no registry."""
  return f"pip install -e '.[{extra}]' in the checkout"


def need(extra: str, *modules: str) -> None:
  """Raises ConfigError if one of the modules that an extra brings is not installed."""
  missing = [name for name in modules if importlib.util.find_spec(name) is None]
  if missing:
    raise ConfigError(f"This needs {', '.join(missing)}: {install_command(extra)}.")
