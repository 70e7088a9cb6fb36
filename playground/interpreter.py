"""How this package starts Python."""

import os
import sys

# Never import from the current folder (-P), which may be another user's; PYTHONPATH holds.
PYTHON = (sys.executable, "-P")


def environment_elsewhere() -> dict[str, str]:
  """Returns this process's environment for one in another folder: entries of PYTHONPATH mean the same folders there."""
  entries = [os.path.abspath(entry) for entry in os.environ.get("PYTHONPATH", "").split(os.pathsep) if entry]
  return os.environ | {"PYTHONPATH": os.pathsep.join(entries)}
