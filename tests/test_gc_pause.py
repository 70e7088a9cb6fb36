"""The garbage collector pauses in the context, and works again after it."""

import gc
import subprocess
import sys

import pytest

from playground.gc_pause import gc_paused


@pytest.mark.parametrize("collecting", [True, False])
def test_it_works_again_afterwards(collecting):
  if not collecting:
    gc.disable()
  try:
    with pytest.raises(ValueError, match="within"), gc_paused():
      assert not gc.isenabled()
      raise ValueError("within")
    assert gc.isenabled() == collecting
  finally:
    gc.enable()


def test_frozen_objects_are_ignored():
  script = """
import gc
from playground.gc_pause import gc_paused
with gc_paused():
  pass
assert not any(isinstance(x, dict) and x.get("kept") for x in gc.get_objects())
with gc_paused(stays=True):
  made = {"kept": [1]}
assert gc.isenabled() and not any(x is made for x in gc.get_objects())
with gc_paused(stays=True):
  later = {"kept": [2]}
assert any(x is later for x in gc.get_objects()), "once is enough"
"""
  subprocess.run([sys.executable, "-c", script], check=True)
