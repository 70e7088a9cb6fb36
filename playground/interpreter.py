"""How this package starts Python."""

import sys

# Never import from the current folder (-P), which may be another user's; PYTHONPATH holds.
PYTHON = (sys.executable, "-P")
