"""Runs measurements, each in a process of its own, and adds their rows to the table as they come."""

import contextlib
import dataclasses
import datetime
import json
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from playground.benchmark.schema import Table, commit_of
from playground.benchmark.worker import ERROR, ROW
from playground.errors import HardwareError
from playground.interpreter import PYTHON
from playground.runs.provenance import git_state

WORKER = (*PYTHON, "-W", "ignore", "-m", "playground.benchmark.worker")
GRACE_S = 40.0  # between asking a process to end and ending it: a training run saves first
CACHES = ("JAX_COMPILATION_CACHE_DIR", "WARP_CACHE_PATH", "CUDA_CACHE_PATH")
TAIL = 30  # lines of a failed process that are shown


@dataclasses.dataclass(frozen=True)
class Job:
  """One measurement.

  Attributes:
    measure: a module of `measures`.
    arguments: of its `measure` function; `seeds`, where it takes them, shrinks to those not measured yet.
    columns: of its rows (benchmark, task, agent, who, setting).
    last: columns of the row that shows that it is done; there is one for each seed if it takes seeds.
  """

  measure: str
  arguments: Mapping[str, Any]
  columns: Mapping[str, Any]
  last: Mapping[str, Any]

  def left(self, table: Table, facts: Mapping[str, Any]) -> "Job | None":
    """The part that the table does not have for this device yet; None if there is none."""
    row = {"device": facts["device"], **self.columns, **self.last}
    if "seeds" not in self.arguments:
      return None if table.has(row) else self
    seeds = [seed for seed in self.arguments["seeds"] if not table.has(row | {"seed": seed})]
    return dataclasses.replace(self, arguments={**self.arguments, "seeds": seeds}) if seeds else None

  def __str__(self) -> str:
    return " ".join(str(self.columns[name]) for name in ("task", "agent", "who", "setting") if self.columns[name])


@dataclasses.dataclass(frozen=True)
class Plan:
  """How jobs are run; see `commands.Measuring`."""

  rerun: bool
  minutes: float | None
  workers: int
  gpus: tuple[int, ...]
  cache: bool
  commit: str | None
  note: str


def probe(overrides: Sequence[str], gpus: Sequence[int]) -> dict[str, Any]:
  """What the jobs will run on, asked of a process of its own: this one must not hold a device.

  Raises:
    HardwareError: the device cannot be used.
  """
  rows: list[dict[str, Any]] = []
  reason = _run("machine", {"overrides": list(overrides)}, _environment(gpus[:1]), rows.append, None)
  if reason:
    raise HardwareError(reason)
  return {"devices": int(rows[0]["value"]), "device": rows[0]["device"], "versions": rows[0]["versions"]}


def run_jobs(jobs: Sequence[Job], table: Table, facts: Mapping[str, Any], plan: Plan) -> int:
  """Runs what the table does not have yet.

  Returns:
    0 when all is there, 1 when something failed, 3 when the time was up before.
  """
  todo = [left for job in jobs if (left := job if plan.rerun else job.left(table, facts))]
  if len(todo) < len(jobs):
    print(f"{len(jobs) - len(todo)} of {len(jobs)} are in {table.path} already (rerun=true measures them again).")
  waiting: queue.SimpleQueue[Job] = queue.SimpleQueue()
  for job in todo:
    waiting.put(job)
  deadline = None if plan.minutes is None else time.monotonic() + 60 * plan.minutes
  reasons: list[str | None] = []  # of each job that was run, why it failed
  stop = threading.Event()
  commit, slots = plan.commit or commit_of(git_state()), plan.gpus or (None,)
  remarks = [f"{plan.workers} processes at once, one timed at a time on a device"] if plan.workers > 1 else []
  remarks += ["caches of earlier runs" if plan.cache else "cold caches", " ".join(plan.note.split())]

  def work(folder: str, slot: int) -> None:
    gpu = slots[slot % len(slots)]
    lock = f"{folder}/gpu{gpu}.lock" if plan.workers > len(slots) else None
    while not stop.is_set() and (deadline is None or time.monotonic() < deadline):
      try:
        job = waiting.get_nowait()
      except queue.Empty:
        return

      def add(row: Mapping[str, Any], job: Job = job) -> None:
        conditions = "; ".join(part for part in (row.get("conditions", ""), *remarks) if part)
        now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        here = {name: facts[name] for name in ("device", "versions")}
        table.add({**job.columns, **here, "commit": commit, **row, "conditions": conditions, "date": now})
        where = [row["setting"]] if "setting" in row else []
        where += [f"seed {row['seed']}"] if "seed" in row else []
        print(f"{job}: {row['quantity']} {row['value']:,} {row['unit']} {' '.join(where)}".rstrip(), flush=True)

      arguments = {**job.arguments, "lock": lock}
      with tempfile.TemporaryDirectory(dir=folder) as empty:
        env = _environment([] if gpu is None else [gpu], None if plan.cache else empty)
        reason = _run(job.measure, arguments, env, add, deadline)
      reasons.append(reason)
      if reason:
        print(f"{job}: {reason}", file=sys.stderr, flush=True)

  with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(plan.workers) as pool:
    try:
      for future in [pool.submit(work, folder, slot) for slot in range(plan.workers)]:
        future.result()
    except BaseException:  # interrupted: what we started must not go on without us
      stop.set()
      for process in list(_running):
        _signal(process, signal.SIGTERM)
      raise
  failed = sum(reason not in (None, OUT_OF_TIME) for reason in reasons)
  left = len(todo) - len(reasons) + reasons.count(OUT_OF_TIME)
  print(f"{reasons.count(None)} measured, {failed} failed, {left} left: {table.path}")
  if left:
    rest = (
      "name what is left in tasks=, for rerun=true begins anew" if plan.rerun else "the same command measures the rest"
    )
    print(f"The time was up: {rest}.")
  return 1 if failed else 3 if left else 0


_running: "set[subprocess.Popen[str]]" = set()
OUT_OF_TIME = "stopped, the time was up"


def _run(
  measure: str, arguments: Mapping[str, Any], env: dict[str, str], add: Any, deadline: float | None
) -> str | None:
  """Runs one worker and hands on its rows; returns why it failed, None if it did not."""
  command = [*WORKER, json.dumps({"measure": measure, "arguments": dict(arguments)})]
  process = subprocess.Popen(
    command,
    stdout=subprocess.PIPE,
    stderr=subprocess.STDOUT,
    text=True,
    errors="replace",
    env=env,
    start_new_session=True,
  )
  assert process.stdout is not None
  _running.add(process)
  timer = threading.Timer(max(0.0, deadline - time.monotonic()), _end, [process]) if deadline else None
  if timer:
    timer.daemon = True
    timer.start()
  tail: deque[str] = deque(maxlen=TAIL)
  error = None
  try:
    for line in process.stdout:
      if line.startswith(ROW):
        add(json.loads(line.removeprefix(ROW)))
      elif line.startswith(ERROR):
        error = line.removeprefix(ERROR).strip()
      elif line.strip():
        tail.append(line)
    code = process.wait()
  finally:
    if timer:
      timer.cancel()
    if process.poll() is None:
      _signal(process, signal.SIGTERM)
    _running.discard(process)
  if code == 0:
    return None
  if deadline is not None and time.monotonic() >= deadline:
    return OUT_OF_TIME
  return error or f"ended with code {code}\n{''.join(tail)}"


def _environment(gpus: Sequence[int], cache: str | None = None) -> dict[str, str]:
  """Of a worker: the GPUs that it sees, and the folder of its caches unless they are the user's."""
  env = {**os.environ, "PYTHONUNBUFFERED": "1"}
  if gpus:
    env["CUDA_VISIBLE_DEVICES"] = ",".join(map(str, gpus))
  return env | ({name: f"{cache}/{name}" for name in CACHES} if cache else {})


def _end(process: "subprocess.Popen[str]") -> None:
  """Asks a worker and what it started to end, and ends them if they do not."""
  _signal(process, signal.SIGTERM)
  try:
    process.wait(GRACE_S)
  except subprocess.TimeoutExpired:
    _signal(process, signal.SIGKILL)


def _signal(process: "subprocess.Popen[str]", number: int) -> None:
  with contextlib.suppress(ProcessLookupError):
    os.killpg(process.pid, number)
