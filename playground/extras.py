"""Optional parts: what they need besides the package, said in one sentence where it is not installed."""

import importlib.util

from playground.errors import ConfigError


def need(extra: str, *modules: str) -> None:
  """Raises ConfigError if one of the modules that `pip install 'playground-run[<extra>]'` brings is not installed."""
  missing = [name for name in modules if importlib.util.find_spec(name) is None]
  if missing:
    raise ConfigError(f"This needs {', '.join(missing)}: pip install 'playground-run[{extra}]'.")
