"""`playground sweep status|collect|retry|stop <folder>`: from the files alone, whatever became of who started it."""

from rich.console import Console

from playground.sweep.folder import SweepDirectory
from playground.sweep.plan import settings_of
from playground.sweep.results import write_result
from playground.sweep.runner import run_sweep
from playground.sweep.view import status_table


def status(folder: str) -> int:
  """Prints how every job stands."""
  sweep = SweepDirectory.open(folder)
  Console().print(status_table(sweep, sweep.states(), rows=None))
  return 0


def collect(folder: str) -> int:
  """Writes sweep.csv, groups.csv, the curves and report.html from what is there."""
  write_result(SweepDirectory.open(folder))
  return 0


def retry(folder: str, *overrides: str) -> int:
  """Does what is missing, failed jobs included; returns how many failed again."""
  sweep = SweepDirectory.open(folder)
  return run_sweep(sweep, settings_of(sweep, overrides))


def stop(folder: str) -> int:
  """Asks the jobs that run to save and leave, wherever they are."""
  sweep = SweepDirectory.open(folder)
  sweep.stop_file.touch()
  print(f"Jobs of {sweep.path} are asked to stop; `playground sweep retry {sweep.path}` goes on.")
  return 0
