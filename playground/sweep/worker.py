"""Runs a job, or several that train together: starts or resumes it, watches it, records its end.

Launchers start a worker on any machine; it needs only the sweep's folder. The worker holds the job's lock, so that no
other worker runs the same job.
"""

import argparse
import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from playground.config import parse_with_hydra
from playground.errors import CheckpointError
from playground.interpreter import PYTHON, environment_elsewhere
from playground.runs.interrupts import on_signals
from playground.runs.run_dir import now
from playground.settings import Plain
from playground.sweep.folder import STOP_FILE, JobFolder, SweepDirectory
from playground.text import quoted

COMMAND = (*PYTHON, "-m", "playground.cli.run")
POLL_S = 0.2
_JAX_REMARK = "For simplicity, JAX has removed its internal frames"  # below a traceback and a line of dashes


def job_command(trusted: Sequence[str] = (), lines: Sequence[str] = ()) -> tuple[str, ...]:
  """Returns the command of jobs, with trusted packages and the overrides that sweep.yaml omits (`is_of_command`).

  Jobs start in the folder that sweep.yaml names, so a relative `hardware.cache_dir` becomes absolute here.
  """
  return (*COMMAND, *([f"trust=[{','.join(trusted)}]"] if trusted else []), *map(_from_here, lines))


def _from_here(line: str) -> str:
  key, folder = line.partition("=")[0], parse_with_hydra(line).value()
  if not key.endswith("hardware.cache_dir") or not isinstance(folder, str) or not folder or "${" in folder:
    return line
  return f"{key}={quoted(Path(folder).expanduser().absolute())}"


class Worker:
  """Runs one job, or several in one process. `stop` may be called by a signal handler or another thread."""

  def __init__(
    self,
    folders: Sequence[Path],
    command: Sequence[str] = COMMAND,
    timeout: float | None = None,
    grace: float = 60.0,
  ):
    """Args:
    folders: of the jobs of one sweep, `<sweep>/jobs/<job>`.
    command: program that gets the jobs' overrides, with `--` between two jobs.
    timeout: seconds until the job is asked to stop.
    grace: seconds from then until it is killed.
    """
    self._folders = [JobFolder(Path(folder).absolute()) for folder in folders]
    self._command = tuple(command)
    self._timeout = timeout
    self._grace = grace
    self._stopping = False
    self._sweep_path = self._folders[0].path.parents[1]
    self._child: subprocess.Popen[bytes] | None = None
    self._records: dict[JobFolder, dict[str, object]] = {}  # of the jobs that this worker has claimed
    self._before: dict[JobFolder, dict[str, Plain]] = {}  # the status of each run before this start

  def stop(self) -> None:
    """Asks the job to save and exit."""
    self._stopping = True

  def run(self, where: str = "", **fields: object) -> int:
    """Runs the jobs to their end and returns the exit code; 0 if other workers run or finished them.

    Args:
      where: the machine or devices, to show to users.
      **fields: entries that the launcher adds to job.json.
    """
    sweep = SweepDirectory.open(self._sweep_path)
    overrides = {job.name: job.overrides for job in sweep.jobs}
    with contextlib.ExitStack() as stack:
      locks: list[int] = []
      for folder in self._folders:
        lock = stack.enter_context(folder.claim())
        if lock is None:
          continue
        started = {"attempt": folder.record.get("attempt", 0) + 1, "host": socket.gethostname(), "started": now()}
        self._records[folder] = {**started, "where": where, "pid": os.getpid(), **fields}
        try:
          self._before[folder] = folder.run.status
        except CheckpointError as error:  # status.json is damaged
          self._write(folder, "failed", str(error))
          del self._records[folder]
          continue
        if self._before[folder].get("status") == "finished":  # another worker had the lock while this one started
          self._write(folder, "finished")
          del self._records[folder]
        else:
          locks.append(lock)
      if not self._records:
        return 0
      if sweep.stop_file.exists():
        self._write_all("preempted", "stopped before it began")
        return 128 + signal.SIGTERM
      self._child = self._start(sweep, overrides, locks)
      for record in self._records.values():
        record["job_pid"] = self._child.pid
      self._write_all("running")
      code, why = self._watch(self._child)
      for folder in self._records:
        with contextlib.suppress(OSError):  # a full disk; the others still get their record
          self._write(folder, *self._outcome(folder, code, why))
    return code

  def interrupt(self, reason: str) -> None:
    """Stops and saves the jobs, and records the reason; for signal handlers that do not return to `run`."""
    self.stop()
    if self._child is not None:
      self._watch(self._child)
    self._write_all("preempted", reason)

  def _write_all(self, status: str, reason: str = "") -> None:
    for folder in self._records or self._folders:
      self._write(folder, status, reason)

  def _write(self, folder: JobFolder, status: str, reason: str = "") -> None:
    ended = {} if self._child is None or self._child.returncode is None else {"exit_code": self._child.returncode}
    ended |= {} if status == "running" else {"ended": now()}
    folder.write(status=status, reason=reason, **self._records.get(folder, {}), **ended)

  def _start(
    self, sweep: SweepDirectory, overrides: Mapping[str, Sequence[str]], locks: Sequence[int]
  ) -> "subprocess.Popen[bytes]":
    args: list[str] = []
    for folder in self._records:
      path = quoted(folder.path)
      args += ["--"] * bool(args)
      args += [f"resume={path}"] if folder.begun else [*overrides[folder.path.name], f"run_dir={path}"]
    first, *others = self._records
    for folder in others:
      with folder.log.open("a") as log:
        log.write(f"--- {now()}: trained together with {first.path.name}, which has the log\n")
    # Some Slurms send submitit's signal to all processes of a job, which would end them.
    with first.log.open("ab") as log, blocked(signal.SIGUSR2):
      start = self._records[first]["attempt"]
      log.write(f"--- start {start}, {now()}, {socket.gethostname()}: {' '.join(args)}\n".encode())
      log.flush()
      return subprocess.Popen(
        [*self._command, *args],
        cwd=sweep.cwd if sweep.cwd.is_dir() else None,
        env={"WANDB_RUN_GROUP": sweep.group} | environment_elsewhere() | {"PYTHONUNBUFFERED": "1"},
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=subprocess.STDOUT,
        start_new_session=True,  # so that killing it also kills its children
        pass_fds=locks,
      )

  def _watch(self, child: "subprocess.Popen[bytes]") -> tuple[int, str]:
    """Waits for the job's end; returns its exit code and the reason of a stop, '' without a stop."""
    stop_file = self._sweep_path / STOP_FILE
    began, asked_at, why = time.monotonic(), 0.0, ""
    while child.poll() is None:
      time.sleep(POLL_S)
      passed = time.monotonic() - began
      if not why:
        out_of_time = self._timeout is not None and passed > self._timeout
        why = "timeout" if out_of_time else "stopped" if self._stopping or stop_file.exists() else ""
        if why:
          asked_at = passed
          _signal(child, signal.SIGTERM, group=False)
      elif passed - asked_at > self._grace:
        _signal(child, signal.SIGKILL, group=True)
    _signal(child, signal.SIGKILL, group=True)  # its children
    return child.returncode, why

  def _outcome(self, folder: JobFolder, code: int, why: str) -> tuple[str, str]:
    """Returns a job's status and its reason, in words."""
    try:
      status = folder.run.status
    except CheckpointError as error:  # status.json is damaged
      return "failed", str(error)
    run = status if status != self._before[folder] else {}  # else of an earlier start
    if run.get("status") == "finished" or (code == 0 and len(self._records) == 1):
      return "finished", ""
    if run.get("status") == "failed" and run.get("reason"):  # before it was asked to stop, or while it saved
      return "failed", run["reason"]
    lines = _lines(next(iter(self._records)).log)
    own = f"{folder.path.name} failed: "
    if said := [line.removeprefix(own) for line in lines if line.startswith(own)]:  # of one run among several
      return "failed", said[-1]
    if why == "timeout":
      return "timeout", f"took longer than launcher.timeout={self._timeout:g} s"
    if why == "stopped" or run.get("status") == "preempted":
      killed = code == -signal.SIGKILL
      return "preempted", "killed before it could save" if killed else "stopped; the next start of the sweep resumes it"
    if code < 0:
      name = signal.Signals(-code).name
      return "killed", f"killed by {name}{', perhaps for want of memory' if code == -signal.SIGKILL else ''}"
    return "failed", f"exit code {code}: {lines[-1] if lines else 'no output'}"


def main(argv: Sequence[str] | None = None) -> int:
  """Runs `python -m playground.sweep.worker <job folder>... [options] [-- command]`."""
  parser = argparse.ArgumentParser(prog="playground.sweep.worker")
  parser.add_argument("folders", type=Path, nargs="+")
  parser.add_argument("--timeout", type=float)
  parser.add_argument("--grace", type=float, default=60.0)
  parser.add_argument("--where", default="")
  parser.add_argument("--slots", type=int, nargs="*", default=[])
  parser.add_argument("--cores", type=int, nargs="*", default=[])
  argv = list(sys.argv[1:] if argv is None else argv)
  cut = argv.index("--") if "--" in argv else len(argv)
  args = parser.parse_args(argv[:cut])
  if args.cores:
    os.sched_setaffinity(0, args.cores)
  worker = Worker(args.folders, argv[cut + 1 :] or COMMAND, args.timeout, args.grace)
  with on_signals(lambda *_: worker.stop()):
    return worker.run(args.where, slots=args.slots)


@contextlib.contextmanager
def blocked(signum: int) -> Iterator[None]:
  """Blocks a signal for processes started in the block; this process gets it when the block ends."""
  before = signal.pthread_sigmask(signal.SIG_BLOCK, {signum})
  try:
    yield
  finally:
    signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _signal(child: "subprocess.Popen[bytes]", signum: int, group: bool) -> None:
  with contextlib.suppress(ProcessLookupError):
    if group:
      os.killpg(child.pid, signum)
    else:
      child.send_signal(signum)


def _lines(log: Path) -> list[str]:
  """Returns the lines of a job's log since its last start; the last is mostly an error. A removed log has none."""
  try:
    text = log.read_text(encoding="utf-8", errors="replace")
  except OSError:
    return []
  lines = [line.strip()[:300] for line in text.splitlines() if line.strip()]
  if lines and lines[-1].startswith(_JAX_REMARK):
    lines = lines[:-2]
  starts = [i for i, line in enumerate(lines) if line.startswith("--- start ")]
  return lines[starts[-1] + 1 :] if starts else lines


if __name__ == "__main__":
  sys.exit(main())
