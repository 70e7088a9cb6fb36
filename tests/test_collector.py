"""Python's garbage collector stays away where it is told to, and comes back."""

import gc
import subprocess
import sys

import pytest

from playground.collector import uncollected


@pytest.mark.parametrize("collecting", [True, False])
def test_it_is_as_it_was_afterwards(collecting):
  if not collecting:
    gc.disable()
  try:
    with pytest.raises(ValueError, match="within"), uncollected():
      assert not gc.isenabled()
      raise ValueError("within")
    assert gc.isenabled() == collecting
  finally:
    gc.enable()


def test_what_stays_is_never_looked_through_again():
  script = """
import gc
from playground.collector import uncollected
with uncollected():
  pass
assert not any(isinstance(x, dict) and x.get("kept") for x in gc.get_objects())
with uncollected(stays=True):
  made = {"kept": [1]}
assert gc.isenabled() and not any(x is made for x in gc.get_objects())
with uncollected(stays=True):
  later = {"kept": [2]}
assert any(x is later for x in gc.get_objects()), "once is enough"
"""
  subprocess.run([sys.executable, "-c", script], check=True)
