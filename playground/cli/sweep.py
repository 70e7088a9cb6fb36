"""`playground sweep status|collect|retry|stop <folder>`: commands that read only the files of a sweep."""

from collections.abc import Sequence

from playground.config import is_of_command
from playground.console import wide_console
from playground.sweep.folder import SweepDirectory
from playground.sweep.plan import settings_of
from playground.sweep.report import write_result
from playground.sweep.runner import run_sweep
from playground.sweep.view import status_table
from playground.sweep.worker import job_command


def status(folder: str) -> int:
  """Prints the status of every job."""
  sweep = SweepDirectory.open(folder)
  wide_console().print(status_table(sweep, sweep.states(), rows=None))
  return 0


def collect(folder: str) -> int:
  """Writes sweep.csv, groups.csv, the curves and report.html from the finished jobs."""
  sweep = SweepDirectory.open(folder)
  sweep.check_links()
  write_result(sweep)
  return 0


def retry(folder: str, *overrides: str, trust: Sequence[str] = ()) -> int:
  """Runs the missing jobs, failed ones included; returns how many failed again.

  Args:
    folder: the folder of the sweep.
    overrides: changed settings of the launcher, and the jobs' folder of compiled programs (`hardware.cache_dir`).
    trust: packages whose tasks jobs may name.
  """
  sweep = SweepDirectory.open(folder)
  lines = [text for text in overrides if is_of_command(text)]
  settings = settings_of(sweep, [text for text in overrides if text not in lines])
  return run_sweep(sweep, settings, job_command(trust, lines))


def stop(folder: str) -> int:
  """Asks all running jobs to save and exit, on any machine."""
  sweep = SweepDirectory.open(folder)
  sweep.check_links()
  sweep.stop_file.touch()
  print(f"Jobs of {sweep.path} are asked to stop; `playground sweep retry {sweep.path}` continues them.")
  return 0
