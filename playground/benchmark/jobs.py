"""Runs measurements as jobs of the sweep's runner, each in its own process; rows are written at once."""

import contextlib
import dataclasses
import datetime
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from playground.benchmark.schema import Table, commit_of
from playground.benchmark.worker import ROW
from playground.config.sweep_options import LocalConfig
from playground.errors import ConfigError, HardwareError
from playground.hardware.gpus import query_gpus
from playground.interpreter import PYTHON
from playground.limits import count, counts, positive
from playground.runs.provenance import git_state
from playground.sweep.folder import FAILED, Job, JobState, SweepDirectory
from playground.sweep.local import ALL, LocalLauncher, Slot
from playground.sweep.runner import Runner
from playground.sweep.view import View

WORKER = (*PYTHON, "-W", "ignore", "-m", "playground.benchmark.worker")
GRACE_S = 40  # s between SIGTERM and SIGKILL: a training run saves first
TAIL = 30  # shown lines of a failed process

Row = dict[str, Any]
Add = Callable[["Measurement", Row], None]  # takes a row of a measurement


@dataclasses.dataclass(frozen=True)
class Measurement:
  """A call of a function of `measures`, and the rows that it emits.

  Attributes:
    measure: the function, `module:function`; without a function, `measure` of the module.
    arguments: arguments of that function; `seeds`, if present, shrinks to those not measured yet.
    columns: columns of all rows (benchmark, task, agent, who, setting).
    last: columns of the last row, which is emitted for each seed if there are seeds.
  """

  measure: str
  arguments: Mapping[str, Any]
  columns: Mapping[str, str]
  last: Mapping[str, str]

  def left(self, table: Table, device: str) -> "Measurement | None":
    """Returns the part that the table lacks for this device; None if the table has all of it."""
    row = {"device": device, **self.columns, **self.last}
    if "seeds" not in self.arguments:
      return None if table.has(row) else self
    seeds = [seed for seed in self.arguments["seeds"] if not table.has(row | {"seed": seed})]
    return dataclasses.replace(self, arguments={**self.arguments, "seeds": seeds}) if seeds else None

  def __str__(self) -> str:
    return " ".join(self.columns[name] for name in ("task", "agent", "who", "setting") if self.columns[name])


@dataclasses.dataclass(frozen=True)
class Plan:
  """Settings of running measurements."""

  rerun: Annotated[bool, "repeat measurements that the CSV has already"] = False
  minutes: Annotated[float | None, positive(), "stop after this long; the same command again measures the rest"] = None
  workers: Annotated[int, count(1), "processes at once: they compile side by side, a device times one at a time"] = 1
  gpus: Annotated[Sequence[int], counts(0), "GPUs that the processes are spread over; none is all of them to each"] = ()
  cache: Annotated[bool, "reuse compiled programs; compile and start times are then not those of a cold start"] = False
  commit: Annotated[str | None, "commit to record without git"] = None
  note: Annotated[str, "added to the conditions of every row"] = ""


class _RowView(View):
  """Adds each row to the table as soon as its measurement prints it, and prints the reasons of failures."""

  def __init__(self, sweep: SweepDirectory, measurements: Sequence[Measurement], add: Add):
    super().__init__(sweep)
    self.again = "the same command measures the rest"
    self._measurements = dict(zip((job.name for job in sweep.jobs), measurements, strict=True))
    self._add = add
    self._read = dict.fromkeys(self._measurements, 0)  # bytes of each log
    self.reasons: dict[str, str] = {}
    self.states: Mapping[str, JobState] = {}

  def begin(self, states: Mapping[str, JobState], at_work: int, trials: int | None = None) -> None:
    """Prints nothing: measurements of an earlier start are in the table."""

  def update(self, states: Mapping[str, JobState], now: bool = False) -> None:
    self.states = dict(states)
    for job in self._sweep.jobs:
      measurement, log = self._measurements[job.name], self._sweep.folder(job).log
      new = b""
      if log.is_file():
        with log.open("rb") as file:
          file.seek(self._read[job.name])
          new = file.read().rpartition(b"\n")[0]
      self._read[job.name] += len(new)
      for line in new.decode(errors="replace").splitlines():
        if line.startswith(ROW):
          self._add(measurement, json.loads(line.removeprefix(ROW)))
      if states[job.name].status in FAILED and job.name not in self.reasons:
        self.reasons[job.name] = self._why(job, states[job.name])
        print(f"{measurement}: {self.reasons[job.name]}", file=sys.stderr, flush=True)

  def _why(self, job: Job, state: JobState) -> str:
    """Returns the reason of a failure, with the end of the log if the process gave no reason."""
    folder = self._sweep.folder(job)
    if folder.run.status.get("reason"):
      return state.reason
    lines = folder.log.read_text(encoding="utf-8", errors="replace").splitlines()[1:]  # the first is the worker's
    return "\n".join([state.reason, *[line for line in lines if line.strip() and not line.startswith(ROW)][-TAIL:]])


def _run(measurements: Sequence[Measurement], add: Add, plan: Plan) -> tuple[int, _RowView]:
  """Runs measurements; returns the runner's exit code and the view with their states."""
  gpus = list(map(str, plan.gpus)) or [ALL]
  slots = [Slot(number, gpus[number % len(gpus)], ()) for number in range(plan.workers)]
  with tempfile.TemporaryDirectory() as temporary:
    folder = Path(temporary).resolve()
    payload = {"cache": plan.cache, "shares": plan.workers > len(gpus)}
    jobs = []
    for number, each in enumerate(measurements):
      name = f"{number:03d}"
      payload |= {"measure": each.measure, "arguments": dict(each.arguments), "folder": str(folder / "jobs" / name)}
      jobs.append(Job(name, [json.dumps(payload)], {}))
    sweep = SweepDirectory.create(folder, "benchmark", [], [], [], jobs)
    rows = _RowView(sweep, measurements, add)
    launch = LocalLauncher(sweep, LocalConfig(grace=GRACE_S), WORKER, slots)
    with contextlib.closing(launch) as launcher:
      code = Runner(sweep, launcher, rows, seconds=plan.minutes and 60 * plan.minutes).run()
    return code, rows


def probe(overrides: Sequence[str], gpus: Sequence[int]) -> tuple[int, dict[str, str]]:
  """Returns the number of devices of a run with these overrides, and its columns `device` and `versions`.

  A child process queries the devices, so that this process holds none.

  Raises:
    ConfigError: the machine has no such GPU.
    HardwareError: the device does not work.
  """
  known = query_gpus("index") if gpus else []
  if any(str(gpu) not in known for gpu in gpus):
    raise ConfigError(f"gpus={list(gpus)}: this machine has {'the GPUs ' * bool(known)}{', '.join(known) or 'no GPU'}.")
  found: list[Row] = []
  columns: dict[str, str] = dict.fromkeys(("task", "agent", "who", "setting"), "")
  machine = Measurement("machine", {"overrides": list(overrides)}, columns, {})
  code, rows = _run([machine], lambda _, row: found.append(row), Plan(gpus=tuple(gpus[:1]), cache=True))
  if code >= 128:  # interrupted
    sys.exit(code)
  if code:
    raise HardwareError(rows.reasons["000"])
  return int(found[0]["value"]), {name: found[0][name] for name in ("device", "versions")}


def run_jobs(measurements: Sequence[Measurement], table: Table, machine: Mapping[str, str], plan: Plan) -> int:
  """Runs the measurements that the table lacks.

  Returns:
    0 when the table is complete, 1 after a failure, 3 if the time was up, 128 plus the signal's number when
    interrupted.
  """
  todo = [left for each in measurements if (left := each if plan.rerun else each.left(table, machine["device"]))]
  if len(todo) < len(measurements):
    there = len(measurements) - len(todo)
    print(f"{there} of {len(measurements)} are in {table.path} already (rerun=true measures them again).")
  remarks = [f"{plan.workers} processes at once, one timed at a time on a device"] if plan.workers > 1 else []
  remarks += ["caches of earlier runs" if plan.cache else "cold caches", " ".join(plan.note.split())]
  shared = {**machine, "commit": plan.commit or commit_of(git_state())}

  def add(measurement: Measurement, row: Row) -> None:
    conditions = "; ".join(part for part in (row.get("conditions", ""), *remarks) if part)
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    full = {**shared, **measurement.columns, **row, "conditions": conditions}
    if plan.rerun or not table.has(full):  # every start reads a chain that another machine finished
      table.add({**full, "date": now})
    where = [row["setting"]] if "setting" in row else []
    where += [f"seed {row['seed']}"] if "seed" in row else []
    print(f"{measurement}: {row['quantity']} {row['value']:,} {row['unit']} {' '.join(where)}".rstrip(), flush=True)

  code, rows = _run(todo, add, plan)
  counts = Counter(state.status for state in rows.states.values())
  failed = sum(counts[status] for status in FAILED)
  left = len(todo) - counts["finished"] - failed
  print(f"{counts['finished']} measured, {failed} failed, {left} left: {table.path}")
  if code >= 128:
    return code
  if left:
    rest = "name what is left in tasks=, because rerun=true starts over" if plan.rerun else rows.again
    print(f"The time was up: {rest}.")
  return 1 if failed else 3 if left else 0
